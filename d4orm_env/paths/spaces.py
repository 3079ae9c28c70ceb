"""Obstacles as path finding reads them: distances to them, and which lines are free.

Whether a line is free is found by marching along it with steps that the clearance allows. Where there is hardly any
room, steps are a quarter of the distance to keep: what is convex and comes no nearer than that at both ends of such a
step comes nearer by at most 1/128 of it in between.

Worlds of the plane are treated as spatial ones without end in z.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray, Ints, Whole
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined

TOLERANCE = 5e-6
"""Rounding of clearances, as a share of the safety distance."""

Position: TypeAlias = tuple[float, float, float]


class Space(NamedTuple):
    """A world with obstacles as the wavefront reads it; see :class:`~d4orm_env.geometry.world_index.WorldIndex`."""

    low: Floats  #: ``(3,)`` lowest corner of the index [m]
    cell: float  #: Size of its cells [m]
    scale: float  #: One over that [1/m]
    size: IntArray  #: ``(3,)`` its cells along each axis
    rounding: float  #: Error of its clearances [m]
    clearance: FloatArray  #: ``(C,)`` float32
    first: Ints  #: ``(C + 1,)`` int32
    items: Ints  #: int32
    boxes: Floats  #: ``(., 7)``
    triangles: Floats  #: ``(., 6)``
    bounds: Floats  #: ``(2, 3)`` of the world
    extent: Floats  #: ``(2, 3)`` of the obstacles
    pad: float  #: Distance from the obstacles that the index covers at least [m]


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
def to_bounds(space: Space, x: float, y: float, z: float) -> float:
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
    """Number of the cell of a position, of the outermost one beyond the index, and offsets from its centre in cells."""
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
def about_to_obstacles(space: Space, x: float, y: float, z: float) -> float:
    """The same, found quickly and too small by a cell or two."""
    cell, dx, dy, dz = _cell(space, x, y, z)
    return space.clearance[cell] - np.sqrt(dx * dx + dy * dy + dz * dz) * space.cell - space.rounding


@inlined
def clearance_at(space: Space, x: float, y: float, z: float) -> float:
    """Distance of a position from the nearest obstacle or bound, negative inside [m]."""
    return min(_to_obstacles(space, x, y, z), to_bounds(space, x, y, z))


@inlined
def distance(a: Position, b: Position) -> float:
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    return np.sqrt(dx * dx + dy * dy + dz * dz)


@compiled
def sees(
    space: Space, safety_distance: float, a: Position, clearance_a: float, b: Position, clearance_b: float
) -> bool:
    """Check whether a line is free.

    ``clearance_a`` and ``clearance_b`` are the clearances at the ends: a position that lies nearer to something than
    ``safety_distance`` is left on lines that come no nearer than it is.
    """
    length = distance(a, b)
    if length == 0.0:
        return True
    ux, uy, uz = (b[0] - a[0]) / length, (b[1] - a[1]) / length, (b[2] - a[2]) / length
    need_a, need_b = min(safety_distance, clearance_a), min(safety_distance, clearance_b)
    zone_a, zone_b = 2 * (safety_distance - need_a), length - 2 * (safety_distance - need_b)
    s = 0.0
    while s < length:
        x, y, z = a[0] + s * ux, a[1] + s * uy, a[2] + s * uz
        need = safety_distance
        if s < zone_a:
            need = need_a
        if s > zone_b:
            need = min(need, need_b)
        shortest = 0.25 * max(need, 0.1 * safety_distance)
        room = about_to_obstacles(space, x, y, z) - need
        if room < shortest:
            room = _to_obstacles(space, x, y, z) - need
            if room < -TOLERANCE * safety_distance:
                return False
        s += max(room, shortest)
    return True


@inlined
def position_of(rows: Floats, n: Whole) -> Position:
    return (rows[n, 0], rows[n, 1], rows[n, 2])


@compiled
def is_free_line(space: Space, safety_distance: float, tail: Floats, head: Floats) -> bool:
    """Check whether a body of this radius moves freely straight from one position to another.

    An end that lies nearer than that to something is left and reached on a line that comes no nearer.
    """
    p, q = (tail[0], tail[1], tail[2]), (head[0], head[1], head[2])
    return sees(
        space, safety_distance, p, clearance_at(space, p[0], p[1], p[2]), q, clearance_at(space, q[0], q[1], q[2])
    )


@cached_kernel(variant="lines", **OPTIONS)
def free_lines(space: Space, safety_distance: float, tails: Floats, heads: Floats, free: BoolArray) -> None:
    """:func:`is_free_line` of many, from ``tails`` ``(Q, 3)`` to ``heads`` ``(Q, 3)``; ``free`` ``(Q,)`` is output."""
    for b in range(tails.shape[0]):
        free[b] = is_free_line(space, safety_distance, tails[b], heads[b])
