"""Shortest free paths to one place, compiled with numba: a wavefront over a grid, any-angle, in the plane and in space.

As in Lazy Theta* (A. Nash, S. Koenig and C. Tovey, AAAI 2010) a node of the grid is worth the value of its anchor and
the straight line to it, which is tested when the node's turn comes. Anchors are not tied to the grid: where a line is
blocked, it is turned about its far end until it just passes, and the place where it then touches is the new anchor. So
paths are nearly as short as they can be on grids that are no finer than the robot.

Whether a line is free is found by marching along it with steps that the clearance allows. Where there is hardly any
room, steps are a quarter of the distance to keep: what is convex and comes no nearer than that at both ends of such a
step comes nearer by at most 1/128 of it in between.

Worlds of the plane are treated as spatial ones without end in z.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray, Ints, Whole
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined

_HALVINGS = 6
"""Number of halvings of the angle by which a blocked line is turned, and of the length by which a corner is cut."""
_PUSHES, _SLACK = 4, 0.03
"""Number of times a node is pushed away from an obstacle, and the excess of a push, as a share of the reach; a third of
it each time, so as to end in the middle of narrow gaps."""
_TOLERANCE = 5e-6
"""Rounding of clearances, as a share of the reach."""
_NOBODY = np.int32(-1)

Place: TypeAlias = tuple[float, float, float]


class Space(NamedTuple):
    """A world with obstacles as the wavefront reads it; see :class:`~d4orm_env.geometry.world_index.WorldIndex`.

    Attributes:
        low: ``(3,)`` lowest corner of the index [m].
        cell: Size of its cells [m].
        scale: One over that [1/m].
        size: ``(3,)`` its cells along each axis.
        rounding: Error of its clearances [m].
        clearance: ``(C,)`` float32.
        first: ``(C + 1,)`` int32.
        items: int32.
        boxes: ``(., 7)``.
        triangles: ``(., 6)``.
        bounds: ``(2, 3)`` of the world.
        extent: ``(2, 3)`` of the obstacles.
        pad: Distance from the obstacles that the index covers at least [m].
    """

    low: Floats
    cell: float
    scale: float
    size: IntArray
    rounding: float
    clearance: FloatArray
    first: Ints
    items: Ints
    boxes: Floats
    triangles: Floats
    bounds: Floats
    extent: Floats
    pad: float


class Lattice(NamedTuple):
    """A grid whose free points are the nodes of a wavefront, both numbered with the last axis fastest.

    Attributes:
        low: ``(3,)`` the first point [m].
        step: Between neighbours along an axis [m].
        size: ``(3,)`` int64 points along each axis.
        moves: ``(M, 3)`` int64 to the neighbours of a point.
        nodes: ``(G,)`` int32 the node of each point; -1 where it is not free.
        points: ``(N,)`` int32 the point of each node.
        places: ``(N, 3)`` where each node is [m].
    """

    low: Floats
    step: float
    size: IntArray
    moves: IntArray
    nodes: Ints
    points: Ints
    places: Floats


class Front(NamedTuple):
    """A wavefront and its anchors.

    Attributes:
        anchor: ``(N,)`` int32 the anchor that each node sees; -1 for a node out of reach.
        points: ``(A, 3)`` the anchors; the first is the goal [m].
        values: ``(A,)`` length of the path from each to the goal [m].
        parents: ``(A,)`` int32 the anchor that comes next on that path; -1 for the goal.
        room: Clearance at the goal [m].
    """

    anchor: Ints
    points: Floats
    values: Floats
    parents: Ints
    room: float


class Fields(NamedTuple):
    """The wavefronts of a team, one behind the other, and the lattices that they are on.

    Attributes:
        reach: ``(K,)`` the distance that each robot keeps [m].
        room: ``(K,)`` clearance at its goal [m].
        lattice: ``(K,)`` int64 number of its lattice.
        low: ``(L, 3)`` the first nodes of the lattices [m].
        step: ``(L,)`` between neighbours along an axis [m].
        size: ``(L, 3)`` int64 points along each axis.
        first_node: ``(L + 1,)`` int64 where the part of ``nodes`` of each lattice begins, and the end.
        nodes: int32 the node of each point; -1 where it is not free.
        first_place: ``(L + 1,)`` int64 where the part of ``places`` of each lattice begins, and the end.
        places: ``(., 3)`` where the nodes are [m].
        first_anchor: ``(K + 1,)`` int64 where the part of ``anchor`` of each robot begins, and the end.
        anchor: int32, see :class:`Front`.
        first_point: ``(K + 1,)`` int64 where those of ``points``, ``values`` and ``parents`` begin, and the end.
        points: ``(., 3)`` [m].
        values: [m].
        parents: int32, counted from the first one of the robot.
    """

    reach: Floats
    room: Floats
    lattice: IntArray
    low: Floats
    step: Floats
    size: IntArray
    first_node: IntArray
    nodes: Ints
    first_place: IntArray
    places: Floats
    first_anchor: IntArray
    anchor: Ints
    first_point: IntArray
    points: Floats
    values: Floats
    parents: Ints


def make_space(problem: Problem) -> Space:
    """The world of a problem; it must have obstacles."""
    world, d = problem.world, problem.dimension
    shapes, index = world.shapes, world.index(float(problem.team.radius.max()) + problem.margin)
    cell = 1.0 / float(index.scale)
    lower, upper = shapes.extent()
    pad = 0.999 * float((lower - index.low).min())
    corners = shapes.boxes.astype(np.float64)
    low, high = corners[:, :d], corners[:, d : 2 * d]
    for axis in range(d):
        if np.isinf(low[:, axis]).any():
            lower[axis], upper[axis] = -np.inf, np.inf
    return Space(
        low=np.append(index.low.astype(np.float64), [-cell / 2] * (3 - d)),
        cell=cell,
        scale=1 / cell,
        size=np.append(index.size, [1] * (3 - d)).astype(np.int64),
        rounding=max(0.0, float(index.slack) - cell * float(np.sqrt(d)) / 2) + 1e-4 * cell,
        clearance=index.clearance,
        first=index.first,
        items=index.items,
        boxes=np.hstack([*_endless(np.stack([low, high])), corners[:, 2 * d :]]),
        triangles=shapes.triangles.astype(np.float64),
        bounds=_endless(world.bounds.astype(np.float64)),
        extent=_endless(np.stack([lower, upper])),
        pad=pad,
    )


def _endless(corners: Floats) -> Floats:
    """Lower and upper corners ``(2, ..., d)`` in three dimensions."""
    end = np.full((*corners.shape[1:-1], 3 - corners.shape[-1]), np.inf)
    return np.stack([np.concatenate([corner, side * end], axis=-1) for side, corner in zip((-1, 1), corners)])


@inlined
def _box_distance(boxes: Floats, i: int, x: float, y: float, z: float) -> float:
    gx = max(boxes[i, 0] - x, x - boxes[i, 3])
    gy = max(boxes[i, 1] - y, y - boxes[i, 4])
    gz = max(boxes[i, 2] - z, z - boxes[i, 5])
    deepest = max(gx, max(gy, gz))
    gx, gy, gz = max(gx, 0.0), max(gy, 0.0), max(gz, 0.0)
    return np.sqrt(gx * gx + gy * gy + gz * gz) + min(deepest, 0.0) - boxes[i, 6]


@compiled
def _triangle_distance(triangles: Floats, i: int, x: float, y: float) -> float:
    nearest, inside = np.inf, True
    for edge in range(3):
        after = 2 * edge + 2 if edge < 2 else 0
        bx, by = triangles[i, 2 * edge], triangles[i, 2 * edge + 1]
        ax, ay = triangles[i, after] - bx, triangles[i, after + 1] - by
        ox, oy = x - bx, y - by
        share = min(max((ox * ax + oy * ay) / (ax * ax + ay * ay), 0.0), 1.0)
        dx, dy = ox - share * ax, oy - share * ay
        nearest = min(nearest, dx * dx + dy * dy)
        inside &= ax * oy - ay * ox >= 0.0
    return -np.sqrt(nearest) if inside else np.sqrt(nearest)


@inlined
def _to_bounds(space: Space, x: float, y: float, z: float) -> float:
    low, high = space.bounds[0], space.bounds[1]
    room = min(min(x - low[0], high[0] - x), min(y - low[1], high[1] - y))
    return min(room, min(z - low[2], high[2] - z))


@inlined
def _to_extent(space: Space, x: float, y: float, z: float) -> float:
    low, high = space.extent[0], space.extent[1]
    gx, gy, gz = max(low[0] - x, x - high[0], 0.0), max(low[1] - y, y - high[1], 0.0), max(low[2] - z, z - high[2], 0.0)
    return np.sqrt(gx * gx + gy * gy + gz * gz)


@inlined
def _cell(space: Space, x: float, y: float, z: float) -> tuple[int, float, float, float]:
    """Number of the cell of a place, of the outermost one beyond the index, and offsets from its centre in cells."""
    low, scale, size = space.low, space.scale, space.size
    x, y, z = (x - low[0]) * scale, (y - low[1]) * scale, (z - low[2]) * scale
    i = min(max(np.int64(x), 0), size[0] - 1)
    j = min(max(np.int64(y), 0), size[1] - 1)
    k = min(max(np.int64(z), 0), size[2] - 1)
    return (i * size[1] + j) * size[2] + k, x - i - 0.5, y - j - 0.5, z - k - 0.5


@compiled
def _to_obstacles(space: Space, x: float, y: float, z: float) -> float:
    """Distance to the nearest obstacle, exact up to ``pad`` and never too large."""
    cell, dx, dy, dz = _cell(space, x, y, z)
    nearest = np.inf
    for number in range(space.first[cell], space.first[cell + 1]):
        item = space.items[number]
        if item < space.boxes.shape[0]:
            nearest = min(nearest, _box_distance(space.boxes, item, x, y, z))
        else:
            nearest = min(nearest, _triangle_distance(space.triangles, item - space.boxes.shape[0], x, y))
    if max(abs(dx), max(abs(dy), abs(dz))) > 0.501:
        nearest = max(min(nearest, space.pad), _to_extent(space, x, y, z))
    return nearest


@inlined
def _about_to_obstacles(space: Space, x: float, y: float, z: float) -> float:
    """The same, found quickly and too small by a cell or two."""
    cell, dx, dy, dz = _cell(space, x, y, z)
    return space.clearance[cell] - np.sqrt(dx * dx + dy * dy + dz * dz) * space.cell - space.rounding


@inlined
def clearance_at(space: Space, x: float, y: float, z: float) -> float:
    """Distance of a place from the nearest obstacle or bound, negative inside [m]."""
    return min(_to_obstacles(space, x, y, z), _to_bounds(space, x, y, z))


@inlined
def _distance(a: Place, b: Place) -> float:
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    return np.sqrt(dx * dx + dy * dy + dz * dz)


@compiled
def _sees(space: Space, reach: float, a: Place, own_a: float, b: Place, own_b: float) -> bool:
    """Check whether a line is free.

    ``own_a`` and ``own_b`` are the clearances at the ends: a place that lies nearer to something than ``reach`` is left
    on lines that come no nearer than it is.
    """
    length = _distance(a, b)
    if length == 0.0:
        return True
    ux, uy, uz = (b[0] - a[0]) / length, (b[1] - a[1]) / length, (b[2] - a[2]) / length
    need_a, need_b = min(reach, own_a), min(reach, own_b)
    zone_a, zone_b = 2 * (reach - need_a), length - 2 * (reach - need_b)
    s = 0.0
    while s < length:
        x, y, z = a[0] + s * ux, a[1] + s * uy, a[2] + s * uz
        need = reach
        if s < zone_a:
            need = need_a
        if s > zone_b:
            need = min(need, need_b)
        shortest = 0.25 * max(need, 0.1 * reach)
        room = _about_to_obstacles(space, x, y, z) - need
        if room < shortest:
            room = _to_obstacles(space, x, y, z) - need
            if room < -_TOLERANCE * reach:
                return False
        s += max(room, shortest)
    return True


@inlined
def _indices(size: IntArray, n: Whole) -> tuple[int, int, int]:
    """Steps to a point along each axis."""
    return n // (size[2] * size[1]), n // size[2] % size[1], n % size[2]


@inlined
def _place(rows: Floats, n: Whole) -> Place:
    return (rows[n, 0], rows[n, 1], rows[n, 2])


@inlined
def _corner(low: Floats, step: float, size: IntArray, q: Place) -> tuple[int, int, int]:
    """Steps along each axis to the point below a place, or to the outermost one."""
    i = min(max(np.int64((q[0] - low[0]) / step), 0), size[0] - 1)
    j = min(max(np.int64((q[1] - low[1]) / step), 0), size[1] - 1)
    return i, j, min(max(np.int64((q[2] - low[2]) / step), 0), size[2] - 1)


@inlined
def _neighbour(lattice: Lattice, move: int, i: int, j: int, k: int) -> np.int64:
    """The node next to a point; -1 where none is."""
    ni, nj, nk = i + lattice.moves[move, 0], j + lattice.moves[move, 1], k + lattice.moves[move, 2]
    size = lattice.size
    if ni < 0 or nj < 0 or nk < 0 or ni >= size[0] or nj >= size[1] or nk >= size[2]:
        return np.int64(-1)
    return np.int64(lattice.nodes[(ni * size[1] + nj) * size[2] + nk])


@inlined
def _between(a: Place, b: Place, share: float) -> Place:
    return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2]))


@compiled
def _turned(space: Space, reach: float, a: Place, own: float, p: Place, q: Place) -> tuple[Place, Place]:
    """Two places to go round on the way from ``a`` to ``q``, which it does not see and ``p`` beside it does."""
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        share = (low + high) / 2
        if _sees(space, reach, a, own, _between(q, p, share), reach):
            high = share
        else:
            low = share
    # The line from ``a`` just passes what it is turned about. Now the corner is cut.
    x = _between(q, p, high)
    near, far = _distance(x, a), _distance(x, q)
    one, other, low, high = x, x, 0.0, min(near, far)
    if high > 0.0:
        for _ in range(_HALVINGS):
            cut = (low + high) / 2
            b, c = _between(x, a, cut / near), _between(x, q, cut / far)
            if _sees(space, reach, b, reach, c, reach):
                low, one, other = cut, b, c
            else:
                high = cut
    return one, other


@compiled
def _settled(space: Space, lattice: Lattice, reach: float, place: Place) -> tuple[Place, bool]:
    """The place, or if a body of this reach does not fit there one less than half a step away where it does.

    And whether it does.
    """
    half, probe, slack = lattice.step / 2, lattice.step / 64, reach * _SLACK
    x, y, z = place
    clearance = clearance_at(space, x, y, z)
    for _ in range(_PUSHES):
        if clearance > reach or clearance < reach - lattice.step:
            break
        gx = clearance_at(space, x + probe, y, z) - clearance_at(space, x - probe, y, z)
        gy = clearance_at(space, x, y + probe, z) - clearance_at(space, x, y - probe, z)
        gz = clearance_at(space, x, y, z + probe) - clearance_at(space, x, y, z - probe)
        norm = np.sqrt(gx * gx + gy * gy + gz * gz)
        if norm == 0.0:
            break
        push = (reach + slack - clearance) / norm
        slack /= 3
        x = min(max(x + push * gx, place[0] - half), place[0] + half)
        y = min(max(y + push * gy, place[1] - half), place[1] + half)
        z = min(max(z + push * gz, place[2] - half), place[2] + half)
        clearance = clearance_at(space, x, y, z)
    return (x, y, z), clearance > reach


@cached_kernel(variant="settle", **OPTIONS)
def settle_nodes(space: Space, lattice: Lattice, reach: float) -> int:
    """Find the points of a lattice where a body of this reach fits, if that is less than half a step away.

    Returns:
        How many there are; as many as there is room for are written as nodes.
    """
    low, step, count = lattice.low, lattice.step, 0
    for n in range(lattice.nodes.shape[0]):
        i, j, k = _indices(lattice.size, n)
        place = (low[0] + i * step, low[1] + j * step, low[2] + k * step)
        fits = (
            _about_to_obstacles(space, place[0], place[1], place[2])
            > reach
            < _to_bounds(space, place[0], place[1], place[2])
        )
        if not fits:
            place, fits = _settled(space, lattice, reach, place)
        lattice.nodes[n] = count if fits else -1
        if fits:
            if count < lattice.points.shape[0]:
                lattice.points[count] = n
                lattice.places[count, 0], lattice.places[count, 1], lattice.places[count, 2] = place
            count += 1
    return count


class _Nodes(NamedTuple):
    """State of the nodes.

    Attributes:
        value: ``(N,)`` length of the path [m].
        anchor: ``(N,)`` int32.
        hidden: ``(N,)`` int32 the anchor last found to be hidden.
        tested: ``(N,)`` bool, whether the anchor is known to be seen.
        done: ``(N,)`` bool, whether the wavefront has passed.
        tried: ``(M,)`` int32 scratch.
    """

    value: Floats
    anchor: Ints
    hidden: Ints
    tested: BoolArray
    done: BoolArray
    tried: Ints


@inlined
def _kept(anchor: Whole, own_goal: float, reach: float) -> float:
    """Return the clearance kept around an anchor: all but the goal are clear."""
    return own_goal if anchor == 0 else reach


@compiled
def _seen_anchor(
    space: Space,
    lattice: Lattice,
    reach: float,
    own_goal: float,
    nodes: _Nodes,
    points: Floats,
    values: Floats,
    n: Whole,
) -> tuple[np.int32, float]:
    """The best anchor of the neighbours of a node that it sees, and the path by it; -1 for none."""
    (i, j, k), q, tried = _indices(lattice.size, lattice.points[n]), _place(lattice.places, n), nodes.tried
    best, chosen, count = np.inf, _NOBODY, 0
    for move in range(lattice.moves.shape[0]):
        p = _neighbour(lattice, move, i, j, k)
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
        at = _place(points, a)
        length = values[a] + _distance(at, q)
        if length < best and _sees(space, reach, at, _kept(a, own_goal, reach), q, reach):
            best, chosen = length, a
    return chosen, best


@compiled
def _detour(
    space: Space, lattice: Lattice, reach: float, nodes: _Nodes, n: Whole, q: Place
) -> tuple[np.int64, float, Place]:
    """The best neighbour to go on from to a node at ``q``, -1 for none, the path by it, and where it bends.

    In a narrow gap neighbours may see each other by way of a place between them only; elsewhere it is ``q``.
    """
    i, j, k = _indices(lattice.size, lattice.points[n])
    best, through, bend = np.inf, np.int64(-1), q
    for straight in (True, False):
        for move in range(lattice.moves.shape[0]):
            p = _neighbour(lattice, move, i, j, k)
            if p < 0 or not nodes.done[p]:
                continue
            place, c, fits = _place(lattice.places, p), q, True
            if not straight:
                c, fits = _settled(space, lattice, reach, _between(place, q, 0.5))
            length = nodes.value[p] + _distance(place, c) + _distance(c, q)
            if not fits or length >= best or not _sees(space, reach, place, reach, c, reach):
                continue
            if straight or _sees(space, reach, c, reach, q, reach):
                best, through, bend = length, p, c
        if through >= 0:
            break
    return through, best, bend


@compiled
def _add_anchor(points: Floats, values: Floats, parents: Ints, number: int, place: Place, parent: int) -> None:
    points[number, 0], points[number, 1], points[number, 2] = place
    values[number] = values[parent] + _distance(place, _place(points, parent))
    parents[number] = parent


Heap: TypeAlias = list[tuple[float, np.int64]]
"""Nodes by the length of their paths."""


@register_jitable(nogil=True, **OPTIONS)
def _begin_at(lattice: Lattice, at: Place, around: int, nodes: _Nodes) -> Heap:
    """Give the nodes so many steps around the goal straight paths."""
    size, heap = lattice.size, [(0.0, np.int64(0)) for _ in range(0)]
    low_i, low_j, low_k = _corner(lattice.low, lattice.step, size, at)
    for i in range(max(0, low_i - around), min(size[0], low_i + around + 1)):
        for j in range(max(0, low_j - around), min(size[1], low_j + around + 1)):
            for k in range(max(0, low_k - around), min(size[2], low_k + around + 1)):
                n = np.int64(lattice.nodes[(i * size[1] + j) * size[2] + k])
                if n >= 0:
                    nodes.value[n], nodes.anchor[n] = _distance(at, _place(lattice.places, n)), 0
                    heapq.heappush(heap, (nodes.value[n], n))
    return heap


@register_jitable(nogil=True, **OPTIONS)
def _pass_on(
    space: Space,
    lattice: Lattice,
    reach: float,
    nodes: _Nodes,
    n: Whole,
    a: Whole,
    at: Place,
    own: float,
    value: float,
    heap: Heap,
) -> None:
    """Give the neighbours of node ``n`` paths by its anchor ``a`` at a place of clearance ``own``, if shorter."""
    i, j, k = _indices(lattice.size, lattice.points[n])
    for move in range(lattice.moves.shape[0]):
        p = _neighbour(lattice, move, i, j, k)
        if p < 0 or nodes.done[p]:
            continue
        place = _place(lattice.places, p)
        length = value + _distance(at, place)
        # What is hidden from one that has no path yet may still be reached by going round.
        if length >= nodes.value[p] or (nodes.hidden[p] == a and nodes.value[p] < np.inf):
            continue
        if nodes.tested[p] and not _sees(space, reach, at, own, place, reach):
            nodes.hidden[p] = a
            continue
        nodes.value[p], nodes.anchor[p] = length, a
        heapq.heappush(heap, (length, p))


@cached_kernel(variant="wave", **OPTIONS)
def _spread(
    space: Space, lattice: Lattice, reach: float, goal: Floats, nodes: _Nodes
) -> tuple[Floats, Floats, Ints, float]:
    """See :func:`spread`; anchors, their values and their parents, and the clearance at the goal."""
    value, anchor, hidden = nodes.value, nodes.anchor, nodes.hidden
    points, values, parents = np.empty((256, 3)), np.empty(256), np.empty(256, np.int32)
    points[0, 0], points[0, 1], points[0, 2] = goal[0], goal[1], goal[2]
    values[0], parents[0], used = 0.0, _NOBODY, 1
    at = _place(points, 0)
    own_goal = clearance_at(space, at[0], at[1], at[2])
    heap = _begin_at(lattice, at, 2 + int(2 * max(0.0, reach - own_goal) / lattice.step), nodes)
    while len(heap) > 0:
        length, n = heapq.heappop(heap)
        if nodes.done[n] or length != value[n]:
            continue
        q, a = _place(lattice.places, n), anchor[n]
        if not nodes.tested[n] and not _sees(space, reach, _place(points, a), _kept(a, own_goal, reach), q, reach):
            hidden[n] = a
            a, value[n] = _seen_anchor(space, lattice, reach, own_goal, nodes, points, values, n)
            p, via, bend = _detour(space, lattice, reach, nodes, n, q)
            if via < value[n]:
                b, c, parent = _place(lattice.places, p), bend, anchor[p]
                if c == q:
                    at = _place(points, parent)
                    b, c = _turned(space, reach, at, _kept(parent, own_goal, reach), b, q)
                if used + 2 > len(values):
                    points = np.concatenate((points, np.empty((used, 3))))
                    values = np.concatenate((values, np.empty(used)))
                    parents = np.concatenate((parents, np.empty(used, np.int32)))
                _add_anchor(points, values, parents, used, b, parent)
                _add_anchor(points, values, parents, used + 1, c, used)
                a, used = np.int32(used + 1), used + 2
                value[n] = values[a] + _distance(c, q)
            anchor[n], nodes.tested[n] = a, a >= 0
            if a < 0:
                continue
            if value[n] > length:
                heapq.heappush(heap, (value[n], n))
                continue
        nodes.done[n] = True
        _pass_on(space, lattice, reach, nodes, n, a, _place(points, a), _kept(a, own_goal, reach), values[a], heap)
    for node in range(lattice.places.shape[0]):
        if not nodes.done[node]:
            anchor[node] = _NOBODY
    return points[:used].copy(), values[:used].copy(), parents[:used].copy(), own_goal


def spread(space: Space, lattice: Lattice, reach: float, goal: Floats) -> Front:
    """The wavefront of a body of this reach from its goal ``(3,)``."""
    count = len(lattice.places)
    nodes = _Nodes(
        value=np.full(count, np.inf),
        anchor=np.full(count, _NOBODY),
        hidden=np.full(count, _NOBODY),
        tested=np.zeros(count, np.bool_),
        done=np.zeros(count, np.bool_),
        tried=np.empty(len(lattice.moves), np.int32),
    )
    return Front(nodes.anchor, *_spread(space, lattice, reach, goal, nodes))


def gather(reach: Floats, lattices: Sequence[Lattice], number: IntArray, fronts: Sequence[Front]) -> Fields:
    """The wavefronts of robots that keep ``reach`` ``(K,)``, on the lattices of these numbers ``(K,)``."""
    return Fields(
        reach=reach,
        room=np.array([front.room for front in fronts]),
        lattice=number,
        low=np.stack([lattice.low for lattice in lattices]),
        step=np.array([lattice.step for lattice in lattices]),
        size=np.stack([lattice.size for lattice in lattices]),
        first_node=_beginnings([lattice.nodes for lattice in lattices]),
        nodes=_joined([lattice.nodes for lattice in lattices]),
        first_place=_beginnings([lattice.places for lattice in lattices]),
        places=_joined([lattice.places for lattice in lattices]),
        first_anchor=_beginnings([front.anchor for front in fronts]),
        anchor=_joined([front.anchor for front in fronts]),
        first_point=_beginnings([front.points for front in fronts]),
        points=_joined([front.points for front in fronts]),
        values=_joined([front.values for front in fronts]),
        parents=_joined([front.parents for front in fronts]),
    )


def _beginnings(arrays: list[np.ndarray]) -> IntArray:
    """Return the offset of each when they lie one behind the other, and the end of the last one."""
    return np.cumsum([0, *map(len, arrays)])


def _joined(arrays: list[np.ndarray]) -> Any:
    """The arrays, one behind the other; a single one is not copied."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


@compiled
def _look_from(space: Space, fields: Fields, robot: int, q: Place) -> tuple[Place, float, np.int32]:
    """Return the next position for a robot at ``q``, the length of the whole path, and the anchor."""
    reach, lattice, first = fields.reach[robot], fields.lattice[robot], fields.first_point[robot]
    step, size, first_place = fields.step[lattice], fields.size[lattice], fields.first_place[lattice]
    first_node, first_anchor = fields.first_node[lattice], fields.first_anchor[robot]
    goal, own_goal, own = _place(fields.points, first), fields.room[robot], clearance_at(space, q[0], q[1], q[2])
    if _sees(space, reach, goal, own_goal, q, own):
        return goal, _distance(goal, q), np.int32(0)
    i, j, k = _corner(fields.low[lattice], step, size, q)
    # From deep inside an obstacle there may be none.
    rings = 2 + np.int64(2 * min(max(0.0, reach - own), 2 * reach) / step)
    ring, target, length, anchor = 0, q, np.inf, _NOBODY
    while ring < rings and anchor < 0:
        last = _NOBODY
        for ni in range(max(0, i - ring), min(size[0], i + ring + 2)):
            for nj in range(max(0, j - ring), min(size[1], j + ring + 2)):
                for nk in range(max(0, k - ring), min(size[2], k + ring + 2)):
                    n = np.int64(fields.nodes[first_node + (ni * size[1] + nj) * size[2] + nk])
                    if n < 0:
                        continue
                    a = fields.anchor[first_anchor + n]
                    if a < 0:
                        continue
                    at, value = _place(fields.points, first + a), fields.values[first + a]
                    straight = value + _distance(at, q)
                    if straight < length and a != last:
                        last = a
                        if _sees(space, reach, at, own_goal if a == 0 else reach, q, own):
                            target, length, anchor = at, straight, a
                            continue
                    place = _place(fields.places, first_place + n)
                    bent = value + _distance(at, place) + _distance(place, q)
                    if bent < length and _sees(space, reach, place, reach, q, own):
                        target, length, anchor = place, bent, a
        ring += 1
    return target, length, anchor


@cached_kernel(variant="look", **OPTIONS)
def look(
    space: Space, fields: Fields, first: int, places: Floats, target: Floats, length: Floats, anchor: Ints
) -> None:
    """The paths of some robots from places.

    Args:
        space: The world.
        fields: The wavefronts of all robots.
        first: Number of the first of these robots, which follow each other.
        places: ``(R, Q, 3)``.
        target: ``(R, Q, 3)`` where to go first, the place itself where there is no path; output.
        length: ``(R, Q)`` of the whole path; infinite where there is none, output.
        anchor: ``(R, Q)`` int32 the anchor that is the target or comes next, output; -1 where there is none.
    """
    for r in range(places.shape[0]):
        for b in range(places.shape[1]):
            q = (places[r, b, 0], places[r, b, 1], places[r, b, 2])
            to, length[r, b], anchor[r, b] = _look_from(space, fields, first + r, q)
            target[r, b, 0], target[r, b, 1], target[r, b, 2] = to


@compiled
def is_free_line(space: Space, reach: float, tail: Floats, head: Floats) -> bool:
    """Check whether a body of this radius moves freely straight from one position to another.

    An end that lies nearer than that to something is left and reached on a line that comes no nearer.
    """
    p, q = (tail[0], tail[1], tail[2]), (head[0], head[1], head[2])
    return _sees(space, reach, p, clearance_at(space, p[0], p[1], p[2]), q, clearance_at(space, q[0], q[1], q[2]))


@cached_kernel(variant="lines", **OPTIONS)
def free_lines(space: Space, reach: float, tails: Floats, heads: Floats, free: BoolArray) -> None:
    """:func:`is_free_line` of many, from ``tails`` ``(Q, 3)`` to ``heads`` ``(Q, 3)``; ``free`` ``(Q,)`` is output."""
    for b in range(tails.shape[0]):
        free[b] = is_free_line(space, reach, tails[b], heads[b])
