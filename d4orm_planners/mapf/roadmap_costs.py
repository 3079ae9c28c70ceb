"""Lengths of robots' shortest paths on a roadmap around those that have docked, compiled with numba."""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Ints, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_planners.mapf.near_neighbours import squared_gap
from d4orm_planners.mapf.roadmap import Roadmap

ROUNDING = 2.0**-27
"""Share of the radius of the largest robot that is rounding."""


class Footprints(NamedTuple):
    """The robots.

    Attributes:
        radius: ``(K,)`` [m].
        size: The largest of them [m].
        reach: ``(K,)`` radius and margin to obstacles [m].
        margin: Between robots [m].
        slack: Distance beyond it that they keep where they can [m].
        docked: Distance from its goal at which a robot may stop [m].
        docks: Whether a robot that has arrived stays there for good.
        starts: ``(K,)`` int64 nodes.
        goals: ``(K,)`` int64 nodes.
        costs: ``(K, N)`` float32 length of the path from every node to each robot's goal [m].
    """

    radius: Floats
    size: float
    reach: Floats
    margin: float
    slack: float
    docked: float
    docks: bool
    starts: IntArray
    goals: IntArray
    costs: FloatArray


@compiled
def _gap(points: Floats, u: Whole, v: Whole) -> float:
    return np.sqrt(squared_gap(points, u, points, v, points, v))


@compiled
def passes_too_near(
    roadmap: Roadmap, bodies: Footprints, k: Whole, tail: Whole, head: Whole, i: Whole, u: Whole, gap: float
) -> bool:
    """Check whether robot ``k`` passes robot ``i`` at node ``u`` too near, ``gap``, on its way between two nodes.

    Starts and goals may be nearer to each other than robots keep: then it may leave its own, and come to its own, if it
    comes no nearer on the way.
    """
    hard = bodies.radius[k] + bodies.radius[i] + bodies.margin
    docked = bodies.docks and u == bodies.goals[i]
    need = hard + (bodies.slack / 2 + bodies.docked if docked else bodies.slack)
    if gap >= need:
        return False
    if tail == bodies.starts[k] or tail == bodies.goals[k]:
        need = min(need, _gap(roadmap.nodes, u, tail))
    if head == bodies.goals[k]:
        need = min(need, max(_gap(roadmap.nodes, u, head), hard))
    return gap < need - ROUNDING * bodies.size


@compiled
def closed(roadmap: Roadmap, bodies: Footprints, docked: Ints, k: Whole, tail: Whole, e: Whole) -> bool:
    """Check whether an edge is closed to a robot for good: it would dock in passing, or be too near a docked one.

    ``docked`` ``(N,)`` is the robot docked at each node, -1 for none.
    """
    head = np.int64(roadmap.heads[e])
    if roadmap.room[e] < bodies.reach[k]:
        return True
    if not bodies.docks:
        return False
    for number in range(roadmap.near_first[e], roadmap.near_first[e + 1]):
        u = np.int64(roadmap.near[number])
        if u == bodies.goals[k]:
            if u != head and u != tail and roadmap.gaps[number] < bodies.docked + bodies.slack / 2:
                return True
        elif docked[u] >= 0:
            i = docked[u]
            if i != k and passes_too_near(roadmap, bodies, k, tail, head, i, u, roadmap.gaps[number]):
                return True
    return False


@cached_kernel(variant="costs", **OPTIONS)
def fill_costs(roadmap: Roadmap, bodies: Footprints, docked: Ints, k: Whole, end: Whole, costs: FloatArray) -> None:
    """Length of a robot's shortest path from every node to one; ``costs`` ``(N,)`` is output."""
    costs[:] = np.inf
    heap = [(0.0, np.int64(end))]
    costs[end] = 0.0
    while len(heap) > 0:
        cost, n = heapq.heappop(heap)
        if cost > costs[n]:
            continue
        for e in range(roadmap.first[n], roadmap.first[n + 1]):
            head = np.int64(roadmap.heads[e])
            # Compared as they are kept, in single precision, or rounding would let nodes come up for ever.
            through = np.float32(cost + roadmap.lengths[e])
            if through < costs[head] and not closed(roadmap, bodies, docked, k, n, e):
                costs[head] = through
                heapq.heappush(heap, (np.float64(through), head))


@cached_kernel(variant="open", **OPTIONS)
def is_open(roadmap: Roadmap, bodies: Footprints, docked: Ints, k: Whole, at: Whole, costs: FloatArray) -> bool:
    """Check whether no docked robot closes the path that a robot at a node would take by these costs."""
    if not costs[at] < np.inf:
        return False
    while at != bodies.goals[k]:
        best, edge = costs[at], -1
        for e in range(roadmap.first[at], roadmap.first[at + 1]):
            if costs[roadmap.heads[e]] < best and roadmap.room[e] >= bodies.reach[k]:
                best, edge = costs[roadmap.heads[e]], e
        if edge < 0 or closed(roadmap, bodies, docked, k, at, edge):
            return False
        at = np.int64(roadmap.heads[edge])
    return True
