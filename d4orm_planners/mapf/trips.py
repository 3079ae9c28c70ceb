"""Straight drives of a robot whose path is planned: the steps that its turns take, whom it meets, and where a straight
line is free to take the place of a path. Compiled with numba.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import Floats, IntArray, Whole
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_env.paths.spaces import Space, is_free_line
from d4orm_planners.mapf.near_neighbours import squared_gap
from d4orm_planners.mapf.occupancy import BLOCK, Buckets, Others, bucket_of
from d4orm_planners.mapf.roadmap import Roadmap, RobotArrays
from d4orm_planners.tracking.pursuit import FACING


class Trip(NamedTuple):
    """Motion that a robot is taken to make when its path is planned."""

    stride: float  #: Distance that it drives in a step [m]
    launch: Whole  #: Steps that it loses whenever it sets out
    latest: int  #: Step by which it must have arrived
    dwell: Whole  #: Steps for which it stays at its goal; negative for ever
    turn: float = 0.0  #: Steps in which it turns by a radian on the spot; zero where turns do not count
    facing: tuple[float, float] = (1.0, 0.0)  #: Unit vector along its heading at the start


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


@compiled
def meeting(
    others: Others, i: Whole, tail: Floats, head: Floats, depart: Whole, arrive: Whole, first: Whole, last: Whole
) -> Whole:
    """The first of some steps of one block, ``last`` not among them, at which a robot that drives straight from one
    position to another is near robot ``i``; -1 if it is at none.
    """
    box, need = others.boxes[first // BLOCK, i], others.need[i]
    if (
        need <= 0.0
        or box[0] - need > max(tail[0], head[0])
        or box[3] + need < min(tail[0], head[0])
        or box[1] - need > max(tail[1], head[1])
        or box[4] + need < min(tail[1], head[1])
        or box[2] - need > max(tail[2], head[2])
        or box[5] + need < min(tail[2], head[2])
    ):
        return np.int64(-1)
    for step in range(first, last):
        share, position = (step - depart) / (arrive - depart), others.positions[i, step]
        dx = tail[0] + share * (head[0] - tail[0]) - position[0]
        dy = tail[1] + share * (head[1] - tail[1]) - position[1]
        dz = tail[2] + share * (head[2] - tail[2]) - position[2]
        if dx * dx + dy * dy + dz * dz < need * need:
            return np.int64(step)
    return np.int64(-1)


@compiled
def _is_line_free(others: Others, tail: Floats, head: Floats, depart: Whole, arrive: Whole) -> bool:
    """Check whether none is near a robot that drives straight from one position to another between two steps."""
    for block in range((depart + 1) // BLOCK, arrive // BLOCK + 1):
        first, last = max(depart + 1, block * BLOCK), min(arrive + 1, (block + 1) * BLOCK)
        for i in range(others.need.shape[0]):
            if meeting(others, i, tail, head, depart, arrive, first, last) >= 0:
                return False
    return True


@compiled
def first_meeting(
    others: Others, buckets: Buckets, tail: Floats, head: Floats, depart: Whole, arrive: Whole
) -> tuple[Whole, Whole]:
    """Somebody who is near a robot that drives along a short line between two steps, and when; -1 where nobody is."""
    for block in range((depart + 1) // BLOCK, arrive // BLOCK + 1):
        first, last = max(depart + 1, block * BLOCK), min(arrive + 1, (block + 1) * BLOCK)
        bucket = bucket_of(buckets, block, (tail[0] + head[0]) / 2, (tail[1] + head[1]) / 2)
        for number in range(buckets.first[bucket], buckets.first[bucket + 1]):
            i = np.int64(buckets.items[number])
            step = meeting(others, i, tail, head, depart, arrive, first, last)
            if step >= 0:
                return i, step
    return np.int64(-1), np.int64(-1)


@cached_kernel(variant="straighten", **OPTIONS)
def straighten(
    roadmap: Roadmap, bodies: RobotArrays, space: Space | None, others: Others, k: Whole, safety_distance: float,
    trip: Trip, path: IntArray,
) -> int:  # fmt: skip
    """Leave out nodes of a path where the straight line is free of obstacles and of others.

    Args:
        roadmap: The roadmap.
        bodies: The robots.
        space: The world; ``None`` where there are no obstacles.
        others: Their motions.
        k: The robot.
        safety_distance: Distance that it keeps from obstacles [m].
        trip: Its motion.
        path: ``(n, 3)`` of :func:`~d4orm_planners.mapf.replanning.find_path`, changed in place.

    Returns:
        How many are left.
    """
    nodes, goal, arrived, count, i = roadmap.nodes, bodies.goals[k], bodies.goal_radius + bodies.slack, 1, 0
    while i + 1 < path.shape[0]:
        j = i + 1
        depart, tail = path[j, 1], nodes[path[i, 0]]
        before = path[count - 2, 0] if count > 1 else np.int64(-1)
        while j + 1 < path.shape[0]:
            head = nodes[path[j + 1, 0]]
            near = squared_gap(nodes, goal, nodes, path[i, 0], nodes, path[j + 1, 0])
            if bodies.docks and path[j + 1, 0] != goal and near < arrived * arrived:
                break
            # Nested, because the compiler leaves out what is never reached.
            if space is not None:  # noqa: SIM102
                if not is_free_line(space, safety_distance, tail, head):
                    break
            first = depart + steps_to_turn(nodes, trip, before, path[i, 0], path[j + 1, 0])
            if first >= path[j + 1, 2] or not _is_line_free(others, tail, head, first, path[j + 1, 2]):
                break
            j += 1
        path[count, 0], path[count, 1], path[count, 2] = path[j, 0], depart, path[j, 2]
        count, i = count + 1, j
    return count
