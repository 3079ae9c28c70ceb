"""Motion primitives of beam search: what a robot may do in a block of steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, FloatArray, Whole
from d4orm_env.dynamics.robot_model import SPEED, Model
from d4orm_env.engine.compiling import ONE, ZERO, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.stepping import Row

_FAR = np.float32(10)  #: Look-ahead of a robot that turns off, in seconds at full speed
_BESIDE = 0.8  #: Goal radii beside its goal to which a robot may head too: docked there it keeps clear of a neighbour
_ON_THE_SPOT = 0.001  #: Share of its speed with which a robot with a heading turns as if it stood


class Moves(NamedTuple):
    """The ``P`` moves of a robot in a block."""

    turns: FloatArray  #: ``(P, 3)`` directions, along that to the goal and two across
    homewards: BoolArray  #: ``(P,)`` whether it heads for the goal, or so many goal radii from there in the direction
    pace: FloatArray  #: ``(P,)`` share of the speed that it would have


@dataclass(frozen=True)
class MotionPrimitives:
    """Moves of robots that look for a path."""

    angles: tuple[float, ...]  #: By which a robot turns off its path to the goal [degrees]; in space up and down too
    paces: tuple[float, ...]  #: Shares of its speed with which it heads for its goal: waiting has no direction

    def moves(self, dimension: int, *, has_heading: bool) -> Moves:
        """The moves as arrays."""
        angle = np.radians(np.array(self.angles))
        # To the left and to the right; in space upwards and downwards too.
        across = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[: 2 * (dimension - 1)]
        sides = portable.sin(angle)[:, None, None] * across
        ahead = np.broadcast_to(portable.cos(angle)[:, None, None], (*sides.shape[:2], 1))
        turned = np.concatenate([ahead, sides], axis=2).reshape(-1, 3)
        home = np.zeros((1, 3))
        beside = np.column_stack([np.zeros(len(across)), _BESIDE * across])
        parts = [(home, True, pace) for pace in self.paces] + [(beside, True, 1.0), (turned, False, 1.0)]
        if has_heading:
            parts += [(home, True, _ON_THE_SPOT), (turned, False, _ON_THE_SPOT)]
        sizes = [len(turns) for turns, _, _ in parts]
        return Moves(
            np.concatenate([turns for turns, _, _ in parts]).astype(np.float32),
            np.repeat([homewards for _, homewards, _ in parts], sizes),
            np.repeat([pace for _, _, pace in parts], sizes).astype(np.float32),
        )


@compiled
def frame_at(position: FloatArray, goal: FloatArray) -> Row:
    """Unit vectors from a position to the goal, across in the plane, and upright to both, one after the other."""
    x, y, z = goal[0] - position[0], goal[1] - position[1], ZERO
    if goal.shape[0] == 3:
        z = goal[2] - position[2]
    length = np.sqrt(x * x + y * y + z * z)
    if length > ZERO:
        x, y, z = x / length, y / length, z / length
    else:
        x = ONE
    flat = np.sqrt(x * x + y * y)
    i, j = ZERO, ONE
    if flat > ZERO:
        i, j = -y / flat, x / flat
    return x, y, z, i, j, -z * j, z * i, x * j - y * i


@compiled
def _turned_2(position: Row, far: np.float32, turn: Row, frame: Row) -> Row:
    x, y, _, i, j, _, _, _ = frame
    return position[0] + far * (turn[0] * x + turn[1] * i), position[1] + far * (turn[0] * y + turn[1] * j)


@compiled
def _turned_3(position: Row, far: np.float32, turn: Row, frame: Row) -> Row:
    x, y, z, i, j, u, v, w = frame
    return (
        position[0] + far * (turn[0] * x + turn[1] * i + turn[2] * u),
        position[1] + far * (turn[0] * y + turn[1] * j + turn[2] * v),
        position[2] + far * (turn[0] * z + turn[2] * w),
    )


@compiled
def _slowed_2(v: Row, pace: np.float32) -> Row:
    return v[0] * pace, v[1] * pace


@compiled
def _slowed_3(v: Row, pace: np.float32) -> Row:
    return v[0] * pace, v[1] * pace, v[2] * pace


AimOf: TypeAlias = Callable[[Row, Row, Row, FloatArray, np.float32, Moves, Whole], Row]
SlowedTo: TypeAlias = Callable[[Row, np.float32], Row]


def aiming(model: Model) -> tuple[AimOf, SlowedTo]:
    """Compiled ``(frame, at, limits, goal, goal_radius, moves, number) -> aim``, the position that a robot of this
    model heads for in a move, and ``(velocity, pace) -> velocity`` at that share of it.

    ``frame`` is :func:`frame_at` the robot's position, with which ``at`` begins.
    """
    d = model.dimension
    turned, slowed = (_turned_2, _slowed_2) if d == 2 else (_turned_3, _slowed_3)

    @inlined
    def aim_of(
        frame: Row, at: Row, limits: Row, goal: FloatArray, goal_radius: np.float32, moves: Moves, number: Whole
    ) -> Row:
        turn = to_fixed_tuple(moves.turns[number], 3)
        if moves.homewards[number]:
            return turned(to_fixed_tuple(goal, d), goal_radius, turn, frame)
        return turned(at, _FAR * limits[SPEED], turn, frame)

    return aim_of, slowed
