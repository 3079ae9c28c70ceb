"""Motion primitives of beam search: what a robot may do in a block of steps, and drives for a block, many at once.

Compiled with numba. Paths are in the lanes of a workspace, as worlds are in a tile's (:mod:`d4orm_env.engine.tiles`): a
flat float32 array of rows, each a number per path, so that the compiler makes vector instructions of the loops.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, FloatArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.robot_model import SPEED, Model
from d4orm_env.engine.compiling import ONE, ZERO, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.obstacles import is_closed, touches_static
from d4orm_env.engine.simd import TILE, use_wide_registers
from d4orm_env.engine.stepping import PICK, READ, WRITE, Row, docking_of
from d4orm_planners.engine.path_index import is_unsure
from d4orm_planners.engine.path_table import BLOCK
from d4orm_planners.mapf.beam import Beam
from d4orm_planners.tracking.tracker import velocity_step

_FAR = np.float32(10)
"""Look-ahead of a robot that turns off, in seconds at full speed."""
_BESIDE = 0.8
"""Goal radii beside its goal to which a robot may head too: one that docks there keeps clear of a neighbour."""
_ON_THE_SPOT = 0.001
"""Share of its speed with which one that has a heading turns, to its goal or to one side, as if it stood."""


class Moves(NamedTuple):
    """The ``P`` moves of a robot in a block."""

    turns: FloatArray  #: ``(P, 3)`` directions, along that to the goal and two across
    homewards: BoolArray  #: ``(P,)`` whether it heads for the goal, or so many goal radii from there in the direction
    pace: FloatArray  #: ``(P,)`` share of the speed that it would have


@dataclass(frozen=True)
class MotionPrimitives:
    """Moves of robots that look for a path."""

    #: By which a robot turns off from the path to its goal [degrees]; in space up and down as well
    angles: tuple[float, ...]
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


_STATE, _CONTROL, _AIM, _PACE, _ARRIVED, _END, _POSITIONS = 0, 6, 10, 13, 14, 15, 16
"""First rows of the workspace; the positions of a block's steps are the last."""
LANES = (_POSITIONS + 3 * BLOCK) * TILE
"""Size of the workspace."""

_AHEAD = np.float32(0.5)
"""Distance ahead of a robot from which the rest of its path is measured [s]."""

_TOUCH = 100.0
"""Robots that are met rather than an obstacle touched for a step."""

BlockDriver: TypeAlias = Callable[[ProblemArrays, Whole, Moves, Beam, Whole, Whole, Whole, FloatArray], None]
"""``(arrays, robot, moves, beam, first, count, steps, lanes)`` drives the robot for so many steps along ``count`` of
the paths that go on from those in the beam by its moves, from number ``first`` on, which is in the first lane."""
PathReader: TypeAlias = Callable[[ProblemArrays, Whole, Whole, Whole, FloatArray], tuple[Row, Row, bool, float]]
"""``(arrays, robot, lane, first, lanes)`` gives state, velocity, arrival and cost [s] of a path whose block began at
step ``first``."""


def _lanes_driver(model: Model) -> Callable[[ProblemArrays, Whole, Whole, FloatArray], None]:
    """Function that drives the paths in all lanes for so many steps."""
    approach, step_towards, (_, slowed) = inlined(model.functions.approach), velocity_step(model), aiming(model)
    n, m, d, num_limits = model.state_size, model.control_size, model.dimension, len(model.limit_names)
    read_x, write_x, pick_x, read_position = READ[n], WRITE[n], PICK[n], READ[d]
    read_u, write_u, pick_u = READ[m], WRITE[m], PICK[m]

    @compiled
    def drive(arrays: ProblemArrays, robot: Whole, steps: Whole, w: FloatArray) -> None:
        use_wide_registers()
        dt, docking = arrays.time_step, docking_of(arrays, robot)
        h = transition.TimeStep(dt[0], dt[1], dt[2], dt[3])
        limits, at = to_fixed_tuple(arrays.limits[robot], num_limits), to_fixed_tuple(arrays.goal[robot], d)
        for t in range(steps):
            for s in range(TILE):
                absorbed = transition.absorbed(w[_ARRIVED * TILE + s] > ZERO, docking[2])
                x, aim = read_x(w, _STATE * TILE, s), read_position(w, _AIM * TILE, s)
                velocity = slowed(approach(x, aim, limits, h, OPS), w[_PACE * TILE + s])
                u, after, arrives = step_towards(x, velocity, limits, at, docking, h)
                after = pick_x(absorbed, x, after)
                write_u(w, _CONTROL * TILE, s, pick_u(absorbed, read_u(w, _CONTROL * TILE, s), u))
                write_x(w, _STATE * TILE, s, after)
                w[_ARRIVED * TILE + s] = ONE if absorbed | arrives else ZERO
                w[_END * TILE + s] = w[_END * TILE + s] if absorbed else np.float32(t)
            # Apart from the rest, because where these rows are is not known when that is compiled.
            for axis in range(d):
                for s in range(TILE):
                    w[(_POSITIONS + t * d + axis) * TILE + s] = w[(_STATE + axis) * TILE + s]

    return drive


def block_driver(model: Model) -> BlockDriver:
    """Function that drives paths for a block."""
    drive, (aim_of, _) = _lanes_driver(model), aiming(model)
    n, num_limits, no_control = model.state_size, len(model.limit_names), (ZERO,) * model.control_size
    write_x, write_u, write_position = WRITE[n], WRITE[model.control_size], WRITE[model.dimension]

    @compiled
    def drive_block(
        arrays: ProblemArrays, robot: Whole, moves: Moves, beam: Beam, first: Whole, count: Whole, steps: Whole,
        w: FloatArray,
    ) -> None:  # fmt: skip
        goal, limits = arrays.goal[robot], to_fixed_tuple(arrays.limits[robot], num_limits)
        goal_radius, frame = np.sqrt(arrays.squared_goal_radius), frame_at(beam.states[0], goal)
        for s in range(count):
            node, number = (first + s) // moves.pace.shape[0], (first + s) % moves.pace.shape[0]
            state = to_fixed_tuple(beam.states[node], n)
            if s == 0 or number == 0:
                frame = frame_at(beam.states[node], goal)
            write_x(w, _STATE * TILE, s, state)
            write_u(w, _CONTROL * TILE, s, no_control)
            write_position(w, _AIM * TILE, s, aim_of(frame, state, limits, goal, goal_radius, moves, number))
            w[_PACE * TILE + s], w[_ARRIVED * TILE + s], w[_END * TILE + s] = moves.pace[number], ZERO, ZERO
        drive(arrays, robot, steps, w)

    return drive_block


def path_reader(model: Model) -> PathReader:
    """Function that reads what has become of a path."""
    velocity_of, read_x, read_u = inlined(model.functions.velocity), READ[model.state_size], READ[model.control_size]
    d, num_limits = model.dimension, len(model.limit_names)

    @inlined
    def read_path(
        arrays: ProblemArrays, robot: Whole, s: Whole, first: Whole, w: FloatArray
    ) -> tuple[Row, Row, bool, float]:
        limits, goal = to_fixed_tuple(arrays.limits[robot], num_limits), arrays.goal[robot]
        state, at_goal = read_x(w, _STATE * TILE, s), w[_ARRIVED * TILE + s] > ZERO
        velocity = velocity_of(state, read_u(w, _CONTROL * TILE, s), limits, OPS)
        end = first + np.int64(w[_END * TILE + s])
        cost = end * arrays.time_step[0]
        if not at_goal:
            rest2 = 0.0
            for axis in range(d):
                gap = goal[axis] - (state[axis] + _AHEAD * velocity[axis])
                rest2 += gap * gap
            cost += max(np.sqrt(rest2) - np.sqrt(arrays.squared_goal_radius), ZERO) / limits[SPEED]
        return state, velocity, at_goal, cost

    return read_path


@compiled
def read_positions(s: Whole, steps: Whole, w: FloatArray, path: FloatArray) -> None:
    """Read where a path was at every step of a block; ``path`` ``(BLOCK, d)`` is output."""
    d = path.shape[1]
    for t in range(steps):
        for axis in range(d):
            path[t, axis] = w[(_POSITIONS + t * d + axis) * TILE + s]


@inlined
def end_of(s: Whole, w: FloatArray) -> Whole:
    """The last step of a block in which a path moves."""
    return np.int64(w[_END * TILE + s])


@compiled
def count_faults(arrays: ProblemArrays, robot: Whole, steps: Whole, end: Whole, path: FloatArray) -> float:
    """Count in robots met what a path ``(BLOCK, d)`` does wrong by itself in a block of so many steps, in which it
    moves until ``end``.
    """
    goal, safety_distance, faults = arrays.goal[robot], arrays.radius[robot] + arrays.margin, 0.0
    closed = is_closed(arrays)
    for t in range(steps):
        if t <= end and is_unsure(arrays, path[t], goal):
            faults += 1.0
        if closed and touches_static(arrays, safety_distance, path[t]):
            faults += _TOUCH
    return faults
