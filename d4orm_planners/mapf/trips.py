"""Motion that a robot is taken to make when its path is planned, and the steps that its turns take."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import Floats, Whole
from d4orm_env.core.problem import Problem
from d4orm_env.engine.compiling import compiled
from d4orm_planners.tracking.pursuit import FACING


class Trip(NamedTuple):
    """Motion that a robot is taken to make when its path is planned.

    Attributes:
        stride: Distance that it drives in a step [m].
        launch: Steps that it loses whenever it sets out.
        latest: Step by which it must have arrived.
        dwell: Steps for which it stays at its goal; negative for ever.
        turn: Steps in which it turns by a radian on the spot; zero where turns do not count.
        facing: Unit vector along its heading at the start.
    """

    stride: float
    launch: Whole
    latest: int
    dwell: Whole
    turn: float = 0.0
    facing: tuple[float, float] = (1.0, 0.0)


TURNED_IN_DRIVING = float(np.sqrt(2.0 - 2.0 * float(FACING)))
"""Angle, about, by which robots turn as they drive [rad]."""


@compiled
def steps_to_turn(nodes: Floats, trip: Trip, before: Whole, node: Whole, head: Whole) -> Whole:
    """Steps that a robot loses at a node before it drives to the next one, come from another or, if that is -1, at its
    start: it brakes and turns where it would not face its way, see :data:`~d4orm_planners.tracking.pursuit.FACING`.
    """
    if trip.turn <= 0.0:
        return np.int64(0)
    x, y = nodes[head, 0] - nodes[node, 0], nodes[head, 1] - nodes[node, 1]
    from_x, from_y = trip.facing
    if before >= 0:
        from_x, from_y = nodes[node, 0] - nodes[before, 0], nodes[node, 1] - nodes[before, 1]
    lengths = np.sqrt((x * x + y * y) * (from_x * from_x + from_y * from_y))
    if x * from_x + y * from_y >= FACING * lengths:
        return np.int64(0)
    # An angle is about c + c^3 / 7 of its chord c: exactly half a turn, and otherwise a little too much.
    chord = np.sqrt(2.0 - 2.0 * (x * from_x + y * from_y) / lengths)
    braking = trip.launch if before >= 0 else np.int64(0)
    return np.int64(trip.turn * (chord * (1.0 + chord * chord / 7.0) - TURNED_IN_DRIVING) + 0.5) + braking


def turn_on_the_spot(problem: Problem, robot: int) -> tuple[float, tuple[float, float]]:
    """Steps in which a robot turns by a radian, zero if it need not or cannot, and where it faces at its start."""
    model = problem.team.robot_models[robot]
    if model.heading_index is None or not model.turns_in_place or model.dimension != 2:
        return 0.0, (1.0, 0.0)
    sine, cosine = portable.sin_cos_of(float(problem.start[robot, model.heading_index]))
    return 1 / (problem.dt * model.turn_rate(problem.team.limits[robot])), (float(cosine), float(sine))
