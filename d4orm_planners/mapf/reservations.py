"""Reservations: a robot's own motion and those of all others, as a search for its path asks for them, by numba.

Nodes of a roadmap are free of others in safe intervals. On a straight line the robot meets somebody or nobody, and
where a longer one is free it takes the place of a path. Turns take steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core import portable
from d4orm_env.core.arrays import Floats, IntArray, Ints, Whole
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_env.paths.spaces import Space, is_free_line
from d4orm_planners.mapf.near_neighbours import squared_gap
from d4orm_planners.mapf.occupancy import BLOCK, Buckets, Others, bucket_of, last_visit, sort_boxes
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
    release: Whole = 0  #: Step before which it does not set out


TURNED_IN_DRIVING = float(np.sqrt(2.0 - 2.0 * float(FACING)))  #: Angle, about, of turning while driving [rad]


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
        depart, tail, flat_tail = path[j, 1], nodes[path[i, 0]], roadmap.flat[path[i, 0]]
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
            if first >= path[j + 1, 2] or not _is_line_free(
                others, flat_tail, roadmap.flat[path[j + 1, 0]], first, path[j + 1, 2]
            ):
                break
            j += 1
        path[count, 0], path[count, 1], path[count, 2] = path[j, 0], depart, path[j, 2]
        count, i = count + 1, j
    return count


class Intervals(NamedTuple):
    """Intervals in which no robot is near a node, for each node."""

    first: IntArray  #: ``(N + 1,)`` int64 where the intervals of each node begin
    begins: IntArray  #: ``(I,)`` int64 their first steps, ascending per node ...
    ends: IntArray  #: ... and the steps after their last


@register_jitable(nogil=True, **OPTIONS)
def _chained(others: Others, num_nodes: Whole, steps: Whole) -> tuple[IntArray, Ints]:
    """All visits before a step: ``(V, 3)`` first step, step after the last, and another one to the same node; and
    ``(N,)`` int32 the last of each node. There is -1 for none.
    """
    used = 0
    for i in range(others.need.shape[0]):
        used += others.counts[i] if others.need[i] > 0 else 0
    visits, last, used = np.empty((used, 3), np.int64), np.full(num_nodes, -1, np.int32), 0
    for i in range(others.need.shape[0]):
        if others.need[i] > 0:
            for number in range(others.counts[i]):
                n, begin, end = others.visits[i, number]
                if begin < steps:
                    visits[used, 0], visits[used, 1], visits[used, 2], last[n] = begin, end, last[n], used
                    used += 1
    return visits[:used], last


@register_jitable(nogil=True, **OPTIONS)
def free_intervals(others: Others, start: Whole, num_nodes: Whole, steps: Whole) -> Intervals:
    """Return the intervals, in so many steps, in which none visits a node; at first a robot may be at its start."""
    visits, last = _chained(others, num_nodes, steps)
    most = num_nodes + visits.shape[0] + 1
    first, begins, ends = np.empty(num_nodes + 1, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    order, used = np.empty(visits.shape[0], np.int64), 0
    for n in range(num_nodes):
        first[n] = used
        # The few visits to a node by their first steps.
        own, visit = 0, np.int64(last[n])
        while visit >= 0:
            position = own
            while position > 0 and visits[order[position - 1], 0] > visits[visit, 0]:
                order[position] = order[position - 1]
                position -= 1
            order[position], own, visit = visit, own + 1, visits[visit, 2]
        if n == start and own > 0 and visits[order[0], 0] == 0:
            begins[used], ends[used] = 0, 1
            used += 1
        free = 0
        for number in range(own):
            begin, end = visits[order[number], 0], visits[order[number], 1]
            if begin > free:
                begins[used], ends[used] = free, begin
                used += 1
            free = max(free, end)
        if free < steps:
            begins[used], ends[used] = free, steps
            used += 1
    first[num_nodes] = used
    return Intervals(first, begins[:used], ends[:used])


@compiled
def interval_at(safe: Intervals, n: Whole, step: Whole) -> Whole:
    """The interval of a node that a step is in, or the next one; that of the next node where there is none."""
    low, high = safe.first[n], safe.first[n + 1]
    while low < high:
        middle = (low + high) // 2
        if safe.ends[middle] <= step:
            low = middle + 1
        else:
            high = middle
    return low


class Reservations(NamedTuple):
    """Reservations of all other robots, as searches for one robot's path read them."""

    others: Others  #: Their motions
    buckets: Buckets  #: The same by where edges near to them have their middles
    safe: Intervals  #: The safe intervals
    dock: Whole  #: Step until which the robot must not come to its goal for good; -1 for none


@cached_kernel(variant="reservations", **OPTIONS)
def _reserve(
    roadmap: Roadmap, bodies: RobotArrays, others: Others, k: Whole, latest: int, stays: bool
) -> tuple[Buckets, Intervals, Whole]:
    goal = bodies.goals[k]
    # Nobody may come near its goal once it stands there for good.
    dock = last_visit(others, goal) if stays else np.int64(-1)
    buckets = sort_boxes(others, roadmap.flat, roadmap.lengths.max() / 2, latest // BLOCK + 1)
    return buckets, free_intervals(others, roadmap.starts[k], roadmap.nodes.shape[0], latest + 1), dock


def make_reservations(
    roadmap: Roadmap, bodies: RobotArrays, others: Others, k: Whole, latest: int, stays: bool
) -> Reservations:
    """The reservations for paths of a robot that end by a step, at a goal where it stays or not."""
    return Reservations(others, *_reserve(roadmap, bodies, others, k, latest, stays))
