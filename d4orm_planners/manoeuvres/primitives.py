"""Motion primitives that follow each other exactly: each ends at the speeds and angles that the next begins with.

They are what a model does under controls held for some time steps, worked out once by its own integration. Where it
then stands, and how it faces, relative to where it began, does not depend on where that was: so that a sequence of
primitives is a sequence of controls, and there is nothing to repair.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from itertools import product
from math import ceil, sqrt
from typing import NamedTuple

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.core.goal_poses import MOST_TRAILERS
from d4orm_env.dynamics.robot_model import ACCELERATION, OWN_LIMITS, TURN_RATE
from d4orm_env.dynamics.unicycle2 import MAX_TURN_ACCELERATION
from d4orm_planners.manoeuvres.first_order_car_moves import first_order_car_moves
from d4orm_planners.manoeuvres.kinds import LENGTHS, MAX_STEPS, OPS, Kind, Mode, Move, held
from d4orm_planners.manoeuvres.sideways_moves import holonomic2d_jerk_moves, holonomic2d_moves, velocity2d_moves

POSE_SIZE = 3 + MOST_TRAILERS
"""Numbers of a pose: position, heading and hitch angles, zero for those that there are not."""
TURNS = (1, 2)  #: Sectors by which an arc turns, to either side
TURNS_ON_THE_SPOT = (1, 4)


class Primitives(NamedTuple):
    """The ``P`` primitives of a robot, as the search reads them, sorted by the mode that they begin in.

    A *mode* is what of the state is neither position nor heading: speeds, steering and hitch angles. ``S`` is the sum
    of all steps.
    """

    begin: IntArray  #: ``(M + 1,)`` where those of each mode begin
    mode: IntArray  #: ``(P,)`` mode that each ends in
    first: IntArray  #: ``(P + 1,)`` where its steps begin
    poses: Floats  #: ``(S, 6)`` position, heading and hitch angles after each step, from where it began
    speed: Floats  #: ``(S,)`` [m/s] after each step
    rests: BoolArray  #: ``(M,)`` whether the robot stands in a mode, so that it can wait
    reach: Floats  #: ``(P,)`` how far from where it began each leads [m]
    controls: FloatArray  #: ``(S, m)``


@cache
def primitives_of(kind: Kind) -> tuple[Primitives, Primitives, tuple[Mode, ...]]:
    """The primitives of a robot, the same backwards in time, and their modes; the first one is that of rest."""
    # Longer ones, of a robot that is next to unable to reverse or to turn, have no room in a search.
    moves = [move for own in kind.parts for move in MOVES[kind.name](own) if len(move[2]) <= MAX_STEPS]
    if kind.finest:
        moves = [move for move in moves if _stands(kind, move[0]) and _stands(kind, move[1])]
    modes = tuple(dict.fromkeys(mode for before, after, _ in moves for mode in (before, after)))
    modes = tuple(sorted(modes, key=lambda mode: sum(map(abs, mode))))
    driven = [drive(kind, before, controls) for before, _, controls in moves]
    ahead = [
        (modes.index(before), modes.index(after), poses[1:], speed[1:], controls)
        for (before, after, controls), (poses, speed) in zip(moves, driven, strict=True)
    ]
    back = [
        (modes.index(after), modes.index(before), seen_from_first(poses[::-1]), speed[-2::-1], controls)
        for (before, after, controls), (poses, speed) in zip(moves, driven, strict=True)
        if _is_shortest(moves, before, after, controls)
    ]
    rests = np.array([_stands(kind, mode) for mode in modes])
    return table(ahead, rests), table(back, rests), modes


def _stands(kind: Kind, mode: Mode) -> bool:
    """Check whether the robot stays where it is in a mode, so that it can wait."""
    poses = drive(kind, mode, np.zeros((1, kind.model.control_size), np.float32))[0]
    return bool((poses[1] == poses[0]).all())


def _is_shortest(moves: list[Move], before: Mode, after: Mode, controls: FloatArray) -> bool:
    """Check whether no shorter move has the same controls, which would lead as far if it is made several times."""
    return not any(
        (before, after) == own[:2] and len(own[2]) < len(controls) and (own[2] == controls[:1]).all() for own in moves
    )


def drive(kind: Kind, mode: Mode, controls: FloatArray) -> tuple[Floats, Floats]:
    """``(n + 1, 6)`` poses from the origin on, and ``(n + 1,)`` speeds."""
    model, hitches = kind.model, len(kind.model.trailers)
    turns = model.heading_index is not None
    states = kind.states((0.0, 0.0, *((0.0,) if turns else ()), *mode), controls)
    poses = np.zeros((len(states), POSE_SIZE))
    poses[:, : 2 + turns] = [state[: 2 + turns] for state in states]
    poses[:, 3 : 3 + hitches] = [state[3 : 3 + hitches] for state in states]
    acting = controls.astype(np.float64).tolist()
    velocities = [
        model.functions.velocity(state, tuple(control), kind.limits, OPS)
        for state, control in zip(states, [*acting, acting[-1]], strict=True)
    ]
    return poses, np.array([sqrt(velocity[0] ** 2 + velocity[1] ** 2) for velocity in velocities])


def seen_from_first(poses: Floats) -> Floats:
    """``(n, 6)`` all but the first of some poses, as seen from that one."""
    gap = poses[1:, :3] - poses[0, :3]
    sine, cosine = portable.sin_cos(-poses[:1, 2])
    x, y = cosine * gap[:, 0] - sine * gap[:, 1], sine * gap[:, 0] + cosine * gap[:, 1]
    return np.column_stack([x, y, gap[:, 2], poses[1:, 3:]])


def table(rows: list[tuple[int, int, Floats, Floats, FloatArray]], rests: BoolArray) -> Primitives:
    """Primitives by their modes before and after, poses, speeds and controls, and the modes in which a robot stands."""
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


def _most(kind: Kind, side: int) -> float:
    """Turn rate limit to the left (``side`` is 1) or to the right (-1)."""
    return kind.limits[TURN_RATE] if side > 0 else kind.lower[TURN_RATE]


def _turns(kind: Kind) -> Iterator[tuple[int, float]]:
    """Steps of turns on the spot, and their turn rates."""
    for sectors, side in product(TURNS_ON_THE_SPOT, (1, -1)):
        count = kind.steps(sectors * kind.sector, _most(kind, side))
        yield count, side * sectors * kind.sector / (count * kind.dt)


def _drives(kind: Kind, speed: float) -> Iterator[tuple[int, float]]:
    """Steps of drives at a speed, straight and in arcs, and their turn rates."""
    for length in LENGTHS:
        yield kind.steps(length * kind.cell, speed), 0.0
    for sectors, side in product(TURNS, (1, -1)):
        count = max(kind.steps(sectors * kind.sector, _most(kind, side)), kind.steps(LENGTHS[0] * kind.cell, speed))
        yield count, side * sectors * kind.sector / (count * kind.dt)


def _drives_both_ways(kind: Kind) -> Iterator[tuple[float, int, float]]:
    """Speeds, negative in reverse, steps and turn rates of drives at full speed."""
    for drives in zip(*(_drives(kind, kind.pace(way)) for way in (1, -1)), strict=True):
        for way, (count, rate) in zip((1, -1), drives, strict=True):
            yield way * kind.pace(way), count, rate


def _unicycle(kind: Kind) -> Iterator[Move]:
    for count, rate in _turns(kind):
        yield (), (), held(count, 0.0, rate)
    for speed, count, rate in _drives_both_ways(kind):
        yield (), (), held(count, speed, rate)


def _differential_drive(kind: Kind) -> Iterator[Move]:
    most = kind.limits[TURN_RATE]
    for count, rate in _turns(kind):
        yield (0.0,), (0.0,), held(count, rate, 0.0)
    turns = [0.0, *(side * sectors * kind.sector for sectors, side in product(TURNS, (1, -1)))]
    for way, turn in product((1, -1), turns):
        speed = kind.pace(way)
        count = max(kind.speeding_up(speed), kind.steps(abs(turn), most))
        push, rate = way * speed / (count * kind.dt), turn / (count * kind.dt)
        yield (0.0,), (way * speed,), held(count, rate, push)
        yield (way * speed,), (0.0,), held(count, rate, -push)
        for length in LENGTHS if turn == 0.0 else LENGTHS[:1]:
            count, peak = kind.hop(length * kind.cell, kind.limits[ACCELERATION])
            if peak <= speed and 2 * count >= kind.steps(abs(turn), most):
                rate, push = turn / (2 * count * kind.dt), way * peak / (count * kind.dt)
                yield (0.0,), (0.0,), np.concatenate([held(count, rate, push), held(count, rate, -push)])
    for speed, count, rate in _drives_both_ways(kind):
        yield (speed,), (speed,), held(count, rate, 0.0)


def _swing(kind: Kind, side: int, turn: float, least: int) -> tuple[int, float]:
    """Steps to turn faster, and as many to turn slower again, and the turn acceleration."""
    count = max(kind.hop(turn, kind.limits[MAX_TURN_ACCELERATION])[0], kind.steps(turn, _most(kind, side)), least)
    return count, side * turn / (count * kind.dt) ** 2


def _paced(kind: Kind, way: int, speed: float, turn: float) -> Iterator[Move]:
    """Speeding up, slowing down and going on, and from rest to rest, at a turn rate or steering angle that is held."""
    count, rest, going = kind.speeding_up(speed), (0.0, turn), (way * speed, turn)
    push = way * speed / (count * kind.dt)
    yield rest, going, held(count, push, 0.0)
    yield going, rest, held(count, -push, 0.0)
    for length in LENGTHS:
        yield going, going, held(kind.steps(length * kind.cell, speed), 0.0, 0.0)
        count, peak = kind.hop(length * kind.cell, kind.limits[ACCELERATION])
        if peak <= speed:
            push = way * peak / (count * kind.dt)
            yield rest, rest, np.concatenate([held(count, push, 0.0), held(count, -push, 0.0)])


def _held_turn(kind: Kind, side: int) -> tuple[float, int, int]:
    """A turn rate, steps of a sector at it, and steps to it, and from it, in which a robot turns by whole sectors."""
    count = kind.steps(kind.sector, _most(kind, side))
    rate = kind.sector / (count * kind.dt)
    return side * rate, count, 2 * count * kind.steps(rate / (2 * count), kind.limits[MAX_TURN_ACCELERATION])


def _unicycle2(kind: Kind) -> Iterator[Move]:
    rest = (0.0, 0.0)
    for sectors, side in product(TURNS_ON_THE_SPOT, (1, -1)):
        count, swing = _swing(kind, side, sectors * kind.sector, 1)
        yield rest, rest, np.concatenate([held(count, 0.0, swing), held(count, 0.0, -swing)])
    for way in (1, -1):
        speed = kind.pace(way)
        yield from _paced(kind, way, speed, 0.0)
        going = (way * speed, 0.0)
        for sectors, side in product(TURNS, (1, -1)):
            least = kind.steps(LENGTHS[0] * kind.cell / 2, speed)
            count, swing = _swing(kind, side, sectors * kind.sector, least)
            yield going, going, np.concatenate([held(count, 0.0, swing), held(count, 0.0, -swing)])
    for side, speed in product((1, -1), (0.0, kind.pace(1), -kind.pace(-1))):
        rate, sector, count = _held_turn(kind, side)
        straight, turning, swing = (speed, 0.0), (speed, rate), rate / (count * kind.dt)
        yield straight, turning, held(count, 0.0, swing)
        yield turning, straight, held(count, 0.0, -swing)
        yield turning, turning, held(sector, 0.0, 0.0)
        if speed:
            count = sector * ceil(kind.speeding_up(abs(speed)) / sector)
            push = speed / (count * kind.dt)
            yield (0.0, rate), turning, held(count, push, 0.0)
            yield turning, (0.0, rate), held(count, -push, 0.0)


def _car(kind: Kind) -> Iterator[Move]:
    most, quickest = kind.limits[OWN_LIMITS : OWN_LIMITS + 2]
    wheels = (-most, 0.0, most)
    swing = kind.steps(most, quickest)
    for old, new in ((0, 1), (1, 0), (1, 2), (2, 1)):
        rate = (wheels[new] - wheels[old]) / (swing * kind.dt)
        for pace in (0.0, kind.pace(1), -kind.pace(-1)):
            yield (pace, wheels[old]), (pace, wheels[new]), held(swing, 0.0, rate)
    for way, wheel in product((1, -1), wheels):
        yield from _paced(kind, way, kind.pace(way), wheel)


MOVES: dict[str, Callable[[Kind], Iterator[Move]]] = {
    "unicycle": _unicycle,
    "unicycle1": _unicycle,
    "unicycle2": _unicycle2,
    "differential_drive": _differential_drive,
    "car": _car,
    "velocity2d": velocity2d_moves,
    "holonomic2d": holonomic2d_moves,
    "holonomic2d_jerk": holonomic2d_jerk_moves,
    "car_with_1_trailer": first_order_car_moves,
    "car_with_2_trailers": first_order_car_moves,
    "car_with_3_trailers": first_order_car_moves,
    "car_first_order": first_order_car_moves,
}
"""Models that there are primitives for."""
