"""Motion primitives that follow each other exactly: each ends at the speeds and angles that the next begins with.

They are what a model does under controls held for some time steps, worked out once by its own integration. Where it
then stands, and how it faces, relative to where it began, does not depend on where that was: so that a sequence of
primitives is a sequence of controls, and there is nothing to repair.
"""

from __future__ import annotations

from functools import cache
from math import sqrt
from typing import NamedTuple

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.core.problem_checks import MOST_TRAILERS
from d4orm_planners.manoeuvres.kinds import MAX_STEPS, OPS, Kind, Mode, Move
from d4orm_planners.manoeuvres.model_moves import MOVES

POSE_SIZE = 3 + MOST_TRAILERS
"""Numbers of a pose: position, heading and hitch angles, zero for those that there are not."""


class Primitives(NamedTuple):
    """The ``P`` primitives of a robot, as the search reads them, sorted by the mode that they begin in.

    A *mode* is what of the state is neither position nor heading: speeds, steering and hitch angles. ``S`` is the sum
    of all steps.

    Attributes:
        begin: ``(M + 1,)`` where those of each mode begin.
        mode: ``(P,)`` mode that each ends in.
        first: ``(P + 1,)`` where its steps begin.
        poses: ``(S, 6)`` position, heading and hitch angles after each step, from where it began.
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


@cache
def primitives_of(kind: Kind) -> tuple[Primitives, Primitives, tuple[Mode, ...]]:
    """The primitives of a robot, the same backwards in time, and their modes; the first one is that of rest."""
    # Longer ones, of a robot that is next to unable to reverse or to turn, have no room in a search.
    moves = [move for move in MOVES[kind.name](kind) if len(move[2]) <= MAX_STEPS]
    modes = tuple(dict.fromkeys(mode for before, after, _ in moves for mode in (before, after)))
    modes = tuple(sorted(modes, key=lambda mode: sum(map(abs, mode))))
    driven = [drive(kind, before, controls) for before, _, controls in moves]
    ahead = [
        (modes.index(before), modes.index(after), poses[1:], speed[1:], controls)
        for (before, after, controls), (poses, speed) in zip(moves, driven, strict=True)
    ]
    back = [
        (modes.index(after), modes.index(before), _backwards(poses), speed[-2::-1], controls)
        for (before, after, controls), (poses, speed) in zip(moves, driven, strict=True)
        if _is_shortest(moves, before, after, controls)
    ]
    speeds = kind.model.speed_indices
    rests = np.array([not any(mode[: len(speeds)]) for mode in modes])
    return _table(ahead, rests), _table(back, rests), modes


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


def _backwards(poses: Floats) -> Floats:
    """Poses ``(n, 6)`` after each step but the last, backwards, from that one."""
    gap = poses[-2::-1, :3] - poses[-1, :3]
    sine, cosine = portable.sin_cos(-poses[-1:, 2])
    x, y = cosine * gap[:, 0] - sine * gap[:, 1], sine * gap[:, 0] + cosine * gap[:, 1]
    return np.column_stack([x, y, gap[:, 2], poses[-2::-1, 3:]])


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
