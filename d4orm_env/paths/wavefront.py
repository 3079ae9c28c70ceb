"""Shortest free paths to one position, compiled with numba: an any-angle wavefront over a grid, in plane and space.

As in Lazy Theta* (A. Nash, S. Koenig and C. Tovey, AAAI 2010) a node of the grid is worth the value of its anchor and
the straight line to it, which is tested when the node's turn comes. Anchors are not tied to the grid: where a line is
blocked, it is turned about its far end until it just passes, and the point where it then touches is the new anchor. So
paths are nearly as short as they can be on grids that are no finer than the robot.
"""

from __future__ import annotations

import heapq
from typing import NamedTuple, TypeAlias

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core.arrays import BoolArray, Floats, Ints, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined
from d4orm_env.paths.lattice import Lattice, corner_below, indices_of, neighbour, settled
from d4orm_env.paths.spaces import Position, Space, clearance_at, distance, position_of, sees

_HALVINGS = 6
"""Number of halvings of the angle by which a blocked line is turned, and of the length by which a corner is cut."""
NO_ANCHOR = np.int32(-1)
"""In place of an anchor that is not there."""


class Front(NamedTuple):
    """A wavefront and its anchors."""

    anchor: Ints  #: ``(N,)`` int32 the anchor that each node sees; -1 for a node out of reach
    points: Floats  #: ``(A, 3)`` the anchors; the first is the goal [m]
    values: Floats  #: ``(A,)`` length of the path from each to the goal [m]
    parents: Ints  #: ``(A,)`` int32 the anchor that comes next on that path; -1 for the goal
    goal_clearance: float  #: Clearance at the goal [m]


@inlined
def _between(a: Position, b: Position, share: float) -> Position:
    return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2]))


@compiled
def _turned(
    space: Space, safety_distance: float, a: Position, clearance: float, p: Position, q: Position
) -> tuple[Position, Position]:
    """Two points to go round on the way from ``a`` to ``q``, which it does not see; it sees the neighbour ``p``."""
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        share = (low + high) / 2
        if sees(space, safety_distance, a, clearance, _between(q, p, share), safety_distance):
            high = share
        else:
            low = share
    # The line from ``a`` just passes what it is turned about. Now the corner is cut.
    x = _between(q, p, high)
    near, far = distance(x, a), distance(x, q)
    one, other, low, high = x, x, 0.0, min(near, far)
    if high > 0.0:
        for _ in range(_HALVINGS):
            cut = (low + high) / 2
            b, c = _between(x, a, cut / near), _between(x, q, cut / far)
            if sees(space, safety_distance, b, safety_distance, c, safety_distance):
                low, one, other = cut, b, c
            else:
                high = cut
    return one, other


class _Nodes(NamedTuple):
    """State of the nodes."""

    value: Floats  #: ``(N,)`` length of the path [m]
    anchor: Ints  #: ``(N,)`` int32
    hidden: Ints  #: ``(N,)`` int32 the anchor last found to be hidden
    tested: BoolArray  #: ``(N,)`` bool, whether the anchor is known to be seen
    done: BoolArray  #: ``(N,)`` bool, whether the wavefront has passed
    tried: Ints  #: ``(M,)`` int32 scratch


@inlined
def _kept(anchor: Whole, goal_clearance: float, safety_distance: float) -> float:
    """Return the clearance kept around an anchor: all but the goal are clear."""
    return goal_clearance if anchor == 0 else safety_distance


@compiled
def _seen_anchor(
    space: Space,
    lattice: Lattice,
    safety_distance: float,
    goal_clearance: float,
    nodes: _Nodes,
    points: Floats,
    values: Floats,
    n: Whole,
) -> tuple[np.int32, float]:
    """The best anchor of the neighbours of a node that it sees, and the path by it; -1 for none."""
    (i, j, k), q, tried = indices_of(lattice.size, lattice.points[n]), position_of(lattice.positions, n), nodes.tried
    best, chosen, count = np.inf, NO_ANCHOR, 0
    for move in range(lattice.moves.shape[0]):
        p = neighbour(lattice, move, i, j, k)
        if p < 0 or not nodes.done[p]:
            continue
        a = nodes.anchor[p]
        known = a == nodes.hidden[n]
        for t in range(count):
            known |= tried[t] == a
        if known:
            continue
        tried[count] = a
        count += 1
        at = position_of(points, a)
        length = values[a] + distance(at, q)
        kept = _kept(a, goal_clearance, safety_distance)
        if length < best and sees(space, safety_distance, at, kept, q, safety_distance):
            best, chosen = length, a
    return chosen, best


@compiled
def _detour(
    space: Space, lattice: Lattice, safety_distance: float, nodes: _Nodes, n: Whole, q: Position
) -> tuple[np.int64, float, Position]:
    """The best neighbour to go on from to a node at ``q``, -1 for none, the path by it, and where it bends.

    In a narrow gap neighbours may see each other by way of a point between them only; elsewhere it is ``q``.
    """
    i, j, k = indices_of(lattice.size, lattice.points[n])
    best, through, bend = np.inf, np.int64(-1), q
    for straight in (True, False):
        for move in range(lattice.moves.shape[0]):
            p = neighbour(lattice, move, i, j, k)
            if p < 0 or not nodes.done[p]:
                continue
            position, c, fits = position_of(lattice.positions, p), q, True
            if not straight:
                c, fits = settled(space, lattice, safety_distance, _between(position, q, 0.5))
            length = nodes.value[p] + distance(position, c) + distance(c, q)
            if (
                not fits
                or length >= best
                or not sees(space, safety_distance, position, safety_distance, c, safety_distance)
            ):
                continue
            if straight or sees(space, safety_distance, c, safety_distance, q, safety_distance):
                best, through, bend = length, p, c
        if through >= 0:
            break
    return through, best, bend


@compiled
def _add_anchor(points: Floats, values: Floats, parents: Ints, number: int, position: Position, parent: int) -> None:
    points[number, 0], points[number, 1], points[number, 2] = position
    values[number] = values[parent] + distance(position, position_of(points, parent))
    parents[number] = parent


@register_jitable(nogil=True, **OPTIONS)
def _twice_as_many(points: Floats, values: Floats, parents: Ints) -> tuple[Floats, Floats, Ints]:
    """Arrays of the same anchors with room for twice as many."""
    count = len(values)
    return (
        np.concatenate((points, np.empty((count, 3)))),
        np.concatenate((values, np.empty(count))),
        np.concatenate((parents, np.empty(count, np.int32))),
    )


Heap: TypeAlias = list[tuple[float, np.int64]]
"""Nodes by the length of their paths."""


@register_jitable(nogil=True, **OPTIONS)
def _begin_at(lattice: Lattice, at: Position, around: int, nodes: _Nodes) -> Heap:
    """Give the nodes so many steps around the goal straight paths."""
    size, heap = lattice.size, [(0.0, np.int64(0)) for _ in range(0)]
    low_i, low_j, low_k = corner_below(lattice.low, lattice.step, size, at)
    for i in range(max(0, low_i - around), min(size[0], low_i + around + 1)):
        for j in range(max(0, low_j - around), min(size[1], low_j + around + 1)):
            for k in range(max(0, low_k - around), min(size[2], low_k + around + 1)):
                n = np.int64(lattice.nodes[(i * size[1] + j) * size[2] + k])
                if n >= 0:
                    nodes.value[n], nodes.anchor[n] = distance(at, position_of(lattice.positions, n)), 0
                    heapq.heappush(heap, (nodes.value[n], n))
    return heap


@register_jitable(nogil=True, **OPTIONS)
def _pass_on(
    space: Space,
    lattice: Lattice,
    safety_distance: float,
    nodes: _Nodes,
    n: Whole,
    a: Whole,
    at: Position,
    clearance: float,
    value: float,
    heap: Heap,
) -> None:
    """Give the neighbours of node ``n`` paths by its anchor ``a``, at a position of this clearance, if shorter."""
    i, j, k = indices_of(lattice.size, lattice.points[n])
    for move in range(lattice.moves.shape[0]):
        p = neighbour(lattice, move, i, j, k)
        if p < 0 or nodes.done[p]:
            continue
        position = position_of(lattice.positions, p)
        length = value + distance(at, position)
        # What is hidden from one that has no path yet may still be reached by going round.
        if length >= nodes.value[p] or (nodes.hidden[p] == a and nodes.value[p] < np.inf):
            continue
        if nodes.tested[p] and not sees(space, safety_distance, at, clearance, position, safety_distance):
            nodes.hidden[p] = a
            continue
        nodes.value[p], nodes.anchor[p] = length, a
        heapq.heappush(heap, (length, p))


@cached_kernel(variant="wave", **OPTIONS)
def _spread(
    space: Space, lattice: Lattice, safety_distance: float, goal: Floats, nodes: _Nodes
) -> tuple[Floats, Floats, Ints, float]:
    """See :func:`spread`; anchors, their values and their parents, and the clearance at the goal."""
    value, anchor, hidden = nodes.value, nodes.anchor, nodes.hidden
    points, values, parents = np.empty((256, 3)), np.empty(256), np.empty(256, np.int32)
    points[0, 0], points[0, 1], points[0, 2] = goal[0], goal[1], goal[2]
    values[0], parents[0], used = 0.0, NO_ANCHOR, 1
    at = position_of(points, 0)
    goal_clearance = clearance_at(space, at[0], at[1], at[2])
    heap = _begin_at(lattice, at, 2 + int(2 * max(0.0, safety_distance - goal_clearance) / lattice.step), nodes)
    while len(heap) > 0:
        length, n = heapq.heappop(heap)
        if nodes.done[n] or length != value[n]:
            continue
        q, a = position_of(lattice.positions, n), anchor[n]
        at, kept = position_of(points, a), _kept(a, goal_clearance, safety_distance)
        if not nodes.tested[n] and not sees(space, safety_distance, at, kept, q, safety_distance):
            hidden[n] = a
            a, value[n] = _seen_anchor(space, lattice, safety_distance, goal_clearance, nodes, points, values, n)
            p, via, bend = _detour(space, lattice, safety_distance, nodes, n, q)
            if via < value[n]:
                b, c, parent = position_of(lattice.positions, p), bend, anchor[p]
                if c == q:
                    at = position_of(points, parent)
                    b, c = _turned(space, safety_distance, at, _kept(parent, goal_clearance, safety_distance), b, q)
                if used + 2 > len(values):
                    points, values, parents = _twice_as_many(points, values, parents)
                _add_anchor(points, values, parents, used, b, parent)
                _add_anchor(points, values, parents, used + 1, c, used)
                a, used = np.int32(used + 1), used + 2
                value[n] = values[a] + distance(c, q)
            anchor[n], nodes.tested[n] = a, a >= 0
            if a >= 0 and value[n] > length:
                heapq.heappush(heap, (value[n], n))
            if a < 0 or value[n] > length:
                continue
        nodes.done[n] = True
        at, kept = position_of(points, a), _kept(a, goal_clearance, safety_distance)
        _pass_on(space, lattice, safety_distance, nodes, n, a, at, kept, values[a], heap)
    return points[:used].copy(), values[:used].copy(), parents[:used].copy(), goal_clearance


def spread(space: Space, lattice: Lattice, safety_distance: float, goal: Floats) -> Front:
    """The wavefront of a body that keeps this distance, from its goal ``(3,)``."""
    count = len(lattice.positions)
    nodes = _Nodes(
        value=np.full(count, np.inf),
        anchor=np.full(count, NO_ANCHOR),
        hidden=np.full(count, NO_ANCHOR),
        tested=np.zeros(count, np.bool_),
        done=np.zeros(count, np.bool_),
        tried=np.empty(len(lattice.moves), np.int32),
    )
    found = _spread(space, lattice, safety_distance, goal, nodes)
    return Front(np.where(nodes.done, nodes.anchor, NO_ANCHOR), *found)
