"""Motion primitives that follow each other exactly: each ends at the speeds and angles that the next begins with.

They are what a model does under controls held for some time steps, worked out once by its own integration. Where it
then stands, and how it faces, relative to where it began, does not depend on where that was: so that a sequence of
primitives is a sequence of controls, and there is nothing to repair.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import product
from math import ceil, pi, sqrt
from typing import NamedTuple

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import ACCELERATION, OWN_LIMITS, PYTHON_OPS, SPEED, TURN_RATE, TimeStep

SECTORS = 32
"""Headings that are told apart."""
SECTOR = 2 * pi / SECTORS
TURNS = (1, 2)
"""Sectors by which an arc turns, to either side."""
TURNS_ON_THE_SPOT = (1, 4)
LENGTHS = (1.5, 6.0)
"""Lengths of straight primitives, in cells."""
DIRECTIONS = 8
"""Directions of a robot without a heading."""

OPS = PYTHON_OPS._replace(
    cos=lambda x: float(portable.cos(np.float64(x))),
    sin=lambda x: float(portable.sin(np.float64(x))),
)


class Primitives(NamedTuple):
    """The ``P`` primitives of a robot, as the search reads them, sorted by the mode that they begin in.

    A *mode* is what of the state is neither position nor heading: speeds and steering angles. ``S`` is the sum of all
    steps.

    Attributes:
        begin: ``(M + 1,)`` where those of each mode begin.
        mode: ``(P,)`` mode that each ends in.
        first: ``(P + 1,)`` where its steps begin.
        poses: ``(S, 3)`` position and heading after each step, from where it began.
        speed: ``(S,)`` [m/s] after each step.
        rests: ``(M,)`` whether the robot stands in a mode, so that it can wait.
        reach: ``(P,)`` how far from where it began each leads [m].
        controls: ``(S, m)``.
    """

    begin: IntArray
    mode: IntArray
    first: IntArray
    poses: Floats
    speed: Floats
    rests: BoolArray
    reach: Floats
    controls: FloatArray


@dataclass(frozen=True)
class Kind:
    """What primitives depend on.

    Attributes:
        model: The model's name.
        limits: Of the robot.
        dt: Time step [s].
        cell: Distance that should be told apart [m].
    """

    model: str
    limits: tuple[float, ...]
    dt: float
    cell: float

    def steps(self, amount: float, rate: float) -> int:
        """Steps that an amount takes at this rate, at least one."""
        return max(1, ceil(amount / (rate * self.dt) - 1e-6))

    def speeding_up(self, speed: float) -> int:
        """Steps from rest to a speed."""
        return self.steps(speed, self.limits[ACCELERATION])

    def hop(self, length: float) -> tuple[int, float]:
        """Steps to speed up, and as many to brake, so that a robot moves so far; and the speed in between."""
        count = max(1, ceil(sqrt(length / self.limits[ACCELERATION]) / self.dt - 1e-6))
        return count, length / (count * self.dt)


Mode = tuple[float, ...]
Move = tuple[Mode, Mode, FloatArray]
"""Mode before, mode after, and ``(n, m)`` controls."""


def _held(count: int, *control: float) -> FloatArray:
    return np.tile(np.array(control, np.float32), (count, 1))


def _turns(kind: Kind, most: float) -> Iterator[tuple[int, float]]:
    """Steps of turns on the spot, and their turn rates."""
    for sectors, side in product(TURNS_ON_THE_SPOT, (1, -1)):
        count = kind.steps(sectors * SECTOR, most)
        yield count, side * sectors * SECTOR / (count * kind.dt)


def _drives(kind: Kind) -> Iterator[tuple[int, float]]:
    """Steps of drives at full speed, straight and in arcs, and their turn rates."""
    most, rate = kind.limits[SPEED], kind.limits[TURN_RATE]
    for length in LENGTHS:
        yield kind.steps(length * kind.cell, most), 0.0
    for sectors, side in product(TURNS, (1, -1)):
        count = max(kind.steps(sectors * SECTOR, rate), kind.steps(LENGTHS[0] * kind.cell, most))
        yield count, side * sectors * SECTOR / (count * kind.dt)


def _unicycle(kind: Kind) -> Iterator[Move]:
    for count, rate in _turns(kind, kind.limits[TURN_RATE]):
        yield (), (), _held(count, 0.0, rate)
    for (count, rate), way in product(_drives(kind), (1, -1)):
        yield (), (), _held(count, way * kind.limits[SPEED], rate)


def _differential_drive(kind: Kind) -> Iterator[Move]:
    speed, most = kind.limits[SPEED], kind.limits[TURN_RATE]
    for count, rate in _turns(kind, most):
        yield (0.0,), (0.0,), _held(count, rate, 0.0)
    turns = [0.0, *(side * sectors * SECTOR for sectors, side in product(TURNS, (1, -1)))]
    for way, turn in product((1, -1), turns):
        count = max(kind.speeding_up(speed), kind.steps(abs(turn), most))
        push, rate = way * speed / (count * kind.dt), turn / (count * kind.dt)
        yield (0.0,), (way * speed,), _held(count, rate, push)
        yield (way * speed,), (0.0,), _held(count, rate, -push)
        for length in LENGTHS if turn == 0.0 else LENGTHS[:1]:
            count, peak = kind.hop(length * kind.cell)
            if peak <= speed and 2 * count >= kind.steps(abs(turn), most):
                rate, push = turn / (2 * count * kind.dt), way * peak / (count * kind.dt)
                yield (0.0,), (0.0,), np.concatenate([_held(count, rate, push), _held(count, rate, -push)])
    for (count, rate), way in product(_drives(kind), (1, -1)):
        yield (way * speed,), (way * speed,), _held(count, rate, 0.0)


def _car(kind: Kind) -> Iterator[Move]:
    speed, (most, quickest, _) = kind.limits[SPEED], kind.limits[OWN_LIMITS : OWN_LIMITS + 3]
    wheels = (-most, 0.0, most)
    swing = kind.steps(most, quickest)
    for old, new in ((0, 1), (1, 0), (1, 2), (2, 1)):
        rate = (wheels[new] - wheels[old]) / (swing * kind.dt)
        for pace in (0.0, speed, -speed):
            yield (pace, wheels[old]), (pace, wheels[new]), _held(swing, 0.0, rate)
    for way, wheel in product((1, -1), wheels):
        count, rest, going = kind.speeding_up(speed), (0.0, wheel), (way * speed, wheel)
        push = way * speed / (count * kind.dt)
        yield rest, going, _held(count, push, 0.0)
        yield going, rest, _held(count, -push, 0.0)
        for length in LENGTHS:
            yield going, going, _held(kind.steps(length * kind.cell, speed), 0.0, 0.0)
            count, peak = kind.hop(length * kind.cell)
            if peak <= speed:
                push = way * peak / (count * kind.dt)
                yield rest, rest, np.concatenate([_held(count, push, 0.0), _held(count, -push, 0.0)])


def _compass() -> Iterator[tuple[float, float]]:
    for number in range(DIRECTIONS):
        sine, cosine = portable.sin_cos(np.float64(number * 2 * pi / DIRECTIONS))
        yield float(cosine), float(sine)


def _velocity2d(kind: Kind) -> Iterator[Move]:
    most = kind.limits[SPEED]
    for (x, y), length in product(_compass(), LENGTHS):
        yield (), (), _held(kind.steps(length * kind.cell, most), most * x, most * y)


def _holonomic2d(kind: Kind) -> Iterator[Move]:
    most, ways, rest = kind.limits[SPEED], list(_compass()), (0.0, 0.0)
    for number, (x, y) in enumerate(ways):
        going, count = (most * x, most * y), kind.speeding_up(most)
        push = most / (count * kind.dt)
        yield rest, going, _held(count, push * x, push * y)
        yield going, rest, _held(count, -push * x, -push * y)
        for side in (1, -1):
            other = ways[(number + side) % DIRECTIONS]
            gap = (other[0] - x, other[1] - y)
            count = kind.speeding_up(most * sqrt(gap[0] ** 2 + gap[1] ** 2))
            push = most / (count * kind.dt)
            yield going, (most * other[0], most * other[1]), _held(count, push * gap[0], push * gap[1])
        for length in LENGTHS:
            yield going, going, _held(kind.steps(length * kind.cell, most), 0.0, 0.0)
        count, peak = kind.hop(LENGTHS[0] * kind.cell)
        if peak <= most:
            push = peak / (count * kind.dt)
            yield rest, rest, np.concatenate([_held(count, push * x, push * y), _held(count, -push * x, -push * y)])


MOVES: dict[str, Callable[[Kind], Iterator[Move]]] = {
    "unicycle": _unicycle,
    "differential_drive": _differential_drive,
    "car": _car,
    "velocity2d": _velocity2d,
    "holonomic2d": _holonomic2d,
}
"""Models that there are primitives for."""


@cache
def primitives_of(kind: Kind) -> tuple[Primitives, Primitives, tuple[Mode, ...]]:
    """The primitives of a robot, the same backwards in time, and their modes; the first one is that of rest."""
    moves = list(MOVES[kind.model](kind))
    modes = tuple(dict.fromkeys(mode for before, after, _ in moves for mode in (before, after)))
    modes = tuple(sorted(modes, key=lambda mode: sum(map(abs, mode))))
    driven = [_drive(kind, before, controls) for before, _, controls in moves]
    ahead = [
        (modes.index(before), modes.index(after), poses[1:], speed[1:], controls)
        for (before, after, controls), (poses, speed) in zip(moves, driven, strict=True)
    ]
    back = [
        (modes.index(after), modes.index(before), _backwards(poses), speed[-2::-1], controls)
        for (before, after, controls), (poses, speed) in zip(moves, driven, strict=True)
        if _is_shortest(moves, before, after, controls)
    ]
    speeds = MODELS[kind.model].speed_indices
    rests = np.array([not any(mode[: len(speeds)]) for mode in modes])
    return _table(ahead, rests), _table(back, rests), modes


def _is_shortest(moves: list[Move], before: Mode, after: Mode, controls: FloatArray) -> bool:
    """Check whether no shorter move is the same, held for fewer steps: that one, some times, leads as far."""
    return not any(
        (before, after) == own[:2] and len(own[2]) < len(controls) and (own[2] == controls[:1]).all() for own in moves
    )


def _drive(kind: Kind, mode: Mode, controls: FloatArray) -> tuple[Floats, Floats]:
    """``(n + 1, 3)`` poses from the origin on, and ``(n + 1,)`` speeds."""
    model, dt, limits = MODELS[kind.model], kind.dt, kind.limits
    h = TimeStep(dt, dt / 2, dt / 3, dt / 6)
    turns = model.heading_index is not None
    x = (0.0, 0.0, *((0.0,) if turns else ()), *mode)
    poses, speeds = [(0.0, 0.0, 0.0)], []
    for control in controls.astype(np.float64).tolist():
        velocity = model.functions.velocity(x, tuple(control), limits, OPS)
        speeds.append(sqrt(velocity[0] ** 2 + velocity[1] ** 2))
        x = model.functions.integrate(x, tuple(control), limits, h, OPS)
        poses.append((x[0], x[1], x[2] if turns else 0.0))
    velocity = model.functions.velocity(x, tuple(control), limits, OPS)
    return np.array(poses), np.array([speeds[0], *speeds[1:], sqrt(velocity[0] ** 2 + velocity[1] ** 2)])


def _backwards(poses: Floats) -> Floats:
    """Poses ``(n, 3)`` after each step but the last, backwards, from that one."""
    gap = poses[-2::-1] - poses[-1]
    sine, cosine = portable.sin_cos(-poses[-1:, 2])
    x, y = cosine * gap[:, 0] - sine * gap[:, 1], sine * gap[:, 0] + cosine * gap[:, 1]
    return np.stack([x, y, gap[:, 2]], axis=1)


def _table(rows: list[tuple[int, int, Floats, Floats, FloatArray]], rests: BoolArray) -> Primitives:
    rows = sorted(rows, key=lambda row: row[0])
    before = np.array([row[0] for row in rows])
    return Primitives(
        begin=np.searchsorted(before, np.arange(len(rests) + 1)),
        mode=np.array([row[1] for row in rows]),
        first=np.cumsum([0, *(len(row[2]) for row in rows)]),
        poses=np.ascontiguousarray(np.concatenate([row[2] for row in rows])),
        speed=np.concatenate([row[3] for row in rows]),
        rests=rests,
        reach=np.array([np.sqrt((row[2][:, :2] ** 2).sum(axis=1)).max() for row in rows]),
        controls=np.concatenate([row[4] for row in rows]),
    )
