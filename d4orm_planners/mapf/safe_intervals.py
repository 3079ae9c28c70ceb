"""Safe intervals of a roadmap's nodes, compiled with numba; kept only where robots come by."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core.arrays import Floats, IntArray, Ints, Whole
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_planners.mapf.near_neighbours import Cells, cells_about, items_in


class Others(NamedTuple):
    """Positions of all robots at every step.

    Attributes:
        positions: ``(T + 1, K, 3)`` float64; afterwards they stay where they are [m].
        need: ``(K,)`` how far the robot that is replanned keeps from each [m].
    """

    positions: Floats
    need: Floats


class Intervals(NamedTuple):
    """Intervals in which no robot is near a node, for each node.

    Attributes:
        first: ``(N + 1,)`` int64 where the intervals of each node begin.
        begins: ``(I,)`` int64 their first steps, ascending per node ...
        ends: ... and the steps after their last.
    """

    first: IntArray
    begins: IntArray
    ends: IntArray


@register_jitable(nogil=True, **OPTIONS)
def find_visits(cells: Cells, others: Others, k: Whole, steps: Whole) -> tuple[IntArray, Ints]:
    """Stretches of steps for which a robot is near a node.

    Returns:
        ``(V, 3)`` first step, step after the last, and the visit before that to the same node; and ``(N,)`` int32 the
        last visit to each node, -1 for none.
    """
    nodes, rows, used = cells.points, others.positions.shape[0], 0
    visits, last = np.empty((1024, 3), np.int64), np.full(nodes.shape[0], -1, np.int32)
    for i in range(others.positions.shape[1]):
        need, step = others.need[i], 0
        while i != k and step < steps:
            place = others.positions[min(step, rows - 1), i]
            # Who stands still is looked at once.
            end = step + 1
            while end < steps:
                after = others.positions[min(end, rows - 1), i]
                if after[0] != place[0] or after[1] != place[1] or after[2] != place[2]:
                    break
                end += 1
            (low_i, high_i), (low_j, high_j), (low_k, high_k) = cells_about(cells, place, place, need)
            for ci in range(low_i, high_i):
                for cj in range(low_j, high_j):
                    first, after_last = items_in(cells, ci, cj, low_k, high_k)
                    for number in range(first, after_last):
                        n = cells.items[number]
                        dx, dy, dz = nodes[n, 0] - place[0], nodes[n, 1] - place[1], nodes[n, 2] - place[2]
                        if dx * dx + dy * dy + dz * dz >= need * need:
                            continue
                        v = last[n]
                        if v >= 0 and visits[v, 0] <= step <= visits[v, 1]:
                            visits[v, 1] = max(visits[v, 1], end)
                            continue
                        if used == visits.shape[0]:
                            visits = np.concatenate((visits, np.empty((used, 3), np.int64)))
                        visits[used, 0], visits[used, 1], visits[used, 2], last[n] = step, end, v, used
                        used += 1
            step = end
    return visits[:used], last


@register_jitable(nogil=True, **OPTIONS)
def free_intervals(visits: IntArray, last: Ints, start: Whole, steps: Whole) -> Intervals:
    """Return the intervals, in so many steps, in which none visits a node; at first a robot may be at its start."""
    count = last.shape[0]
    most = count + visits.shape[0] + 1
    first, begins, ends = np.empty(count + 1, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    order, used = np.empty(visits.shape[0], np.int64), 0
    for n in range(count):
        first[n] = used
        # The few visits to a node by their first steps.
        own, visit = 0, np.int64(last[n])
        while visit >= 0:
            place = own
            while place > 0 and visits[order[place - 1], 0] > visits[visit, 0]:
                order[place] = order[place - 1]
                place -= 1
            order[place], own, visit = visit, own + 1, visits[visit, 2]
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
    first[count] = used
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
