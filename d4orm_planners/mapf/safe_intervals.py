"""Reservations of all other robots for one robot's searches, compiled: safe intervals of a roadmap's nodes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core.arrays import IntArray, Ints, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_planners.mapf.occupancy import BLOCK, Buckets, Others, last_visit, sort_boxes
from d4orm_planners.mapf.roadmap import Roadmap, RobotArrays


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
def make_reservations(
    roadmap: Roadmap, bodies: RobotArrays, others: Others, k: Whole, latest: int, stays: bool
) -> Reservations:
    """The reservations for paths of a robot that end by a step, at a goal where it stays or not."""
    goal = bodies.goals[k]
    # Nobody may come near its goal once it stands there for good.
    dock = last_visit(others, goal) if stays else np.int64(-1)
    buckets = sort_boxes(others, roadmap.nodes, roadmap.lengths.max() / 2, latest // BLOCK + 1)
    safe = free_intervals(others, roadmap.starts[k], roadmap.nodes.shape[0], latest + 1)
    return Reservations(others, buckets, safe, dock)
