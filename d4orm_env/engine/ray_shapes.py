"""Rays that meet a shape, compiled with numba: each function shortens some of the rays of one robot by one shape.

Rays are the columns of ``fan`` ``(4, R)``: unit vectors, and one over their components. ``row`` ``(R,)`` is how far
they reach [m], and those from ``begin`` to ``end`` are shortened, in loops without branches.
"""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, Whole
from d4orm_env.engine.compiling import ONE, ZERO, compiled, inlined
from d4orm_env.engine.convex_cores import AXES, CORNERS, COUNT, EXTENTS, NUM_AXES, ROUNDING
from d4orm_env.engine.simd import use_wide_registers

_FAR = np.float32(1e15)
"""Farther than anything."""
_PARALLEL = np.float32(1e-15)
"""Component of a direction in place of zero, so that dividing by it gives a number."""


@compiled
def meet_disc(
    x: np.float32, y: np.float32, radius: np.float32, fan: FloatArray, row: FloatArray, begin: Whole, end: Whole
) -> None:
    """Shorten rays by a disc at a relative position."""
    use_wide_registers()
    for i in range(np.uint64(begin), np.uint64(end)):
        along, across = x * fan[0, i] + y * fan[1, i], x * fan[1, i] - y * fan[0, i]
        rest = radius * radius - across * across
        half = np.sqrt(rest if rest > ZERO else ZERO)
        distance = along - half
        distance = distance if distance > ZERO else ZERO
        distance = distance if (rest >= ZERO) & (along + half >= ZERO) else _FAR
        row[i] = distance if distance < row[i] else row[i]


@compiled
def meet_box(
    low_x: np.float32, low_y: np.float32, high_x: np.float32, high_y: np.float32,
    fan: FloatArray, row: FloatArray, begin: Whole, end: Whole,
) -> None:  # fmt: skip
    """Shorten rays by a box between two relative corners."""
    use_wide_registers()
    for i in range(np.uint64(begin), np.uint64(end)):
        one_x, other_x, one_y, other_y = low_x * fan[2, i], high_x * fan[2, i], low_y * fan[3, i], high_y * fan[3, i]
        enter_x, leave_x = (one_x, other_x) if one_x < other_x else (other_x, one_x)
        enter_y, leave_y = (one_y, other_y) if one_y < other_y else (other_y, one_y)
        enter, leave = enter_x if enter_x > enter_y else enter_y, leave_x if leave_x < leave_y else leave_y
        enter = enter if enter > ZERO else ZERO
        distance = enter if leave >= enter else _FAR
        row[i] = distance if distance < row[i] else row[i]


@inlined
def _cut(enter: np.float32, leave: np.float32, inside: np.float32, growth: np.float32) -> tuple[np.float32, np.float32]:
    """Cut a ray to the inner side of a line: ``inside`` at its beginning is positive there, and grows so fast."""
    parallel = (growth < _PARALLEL) & (growth > -_PARALLEL)
    cut = -inside / (ONE if parallel else growth)
    later, sooner = (growth > ZERO) & (cut > enter) & ~parallel, (growth < ZERO) & (cut < leave) & ~parallel
    outside = parallel & (inside < ZERO)
    return cut if later else enter, -ONE if outside else cut if sooner else leave


@compiled
def meet_triangle(
    x: np.float32, y: np.float32, c: FloatArray, fan: FloatArray, row: FloatArray, begin: Whole, end: Whole
) -> None:
    """Shorten rays from ``(x, y)`` by a triangle of three corners counter-clockwise, ``c`` ``(6,)``."""
    use_wide_registers()
    x0, y0, x1, y1, x2, y2 = c[2] - c[0], c[3] - c[1], c[4] - c[2], c[5] - c[3], c[0] - c[4], c[1] - c[5]
    inside0, inside1, inside2 = (
        x0 * (y - c[1]) - y0 * (x - c[0]),
        x1 * (y - c[3]) - y1 * (x - c[2]),
        x2 * (y - c[5]) - y2 * (x - c[4]),
    )
    for i in range(np.uint64(begin), np.uint64(end)):
        ray_x, ray_y = fan[0, i], fan[1, i]
        enter, leave = _cut(ZERO, _FAR, inside0, x0 * ray_y - y0 * ray_x)
        enter, leave = _cut(enter, leave, inside1, x1 * ray_y - y1 * ray_x)
        enter, leave = _cut(enter, leave, inside2, x2 * ray_y - y2 * ray_x)
        distance = enter if leave >= enter else _FAR
        row[i] = distance if distance < row[i] else row[i]


@compiled
def meet_bounds(x: np.float32, y: np.float32, bounds: FloatArray, fan: FloatArray, row: FloatArray, end: Whole) -> None:
    use_wide_registers()
    low_x, low_y, high_x, high_y = bounds[0, 0] - x, bounds[0, 1] - y, bounds[1, 0] - x, bounds[1, 1] - y
    for i in range(np.uint64(end)):
        leave_x = (high_x if fan[2, i] > ZERO else low_x) * fan[2, i]
        leave_y = (high_y if fan[3, i] > ZERO else low_y) * fan[3, i]
        distance = leave_x if leave_x < leave_y else leave_y
        distance = distance if distance > ZERO else ZERO
        row[i] = distance if distance < row[i] else row[i]


@compiled
def meet_core(core: FloatArray, fan: FloatArray, row: FloatArray, begin: Whole, end: Whole) -> None:
    """Shorten rays by a core that :func:`~d4orm_env.engine.convex_cores.place_body` has written, seen from the sensor.

    A point or a segment is widened by discs at its ends; what a segment is widened by lies within its ends.
    """
    corners, axes, rounding = int(core[COUNT]), int(core[NUM_AXES]), core[ROUNDING]
    if rounding > ZERO:
        for j in range(corners):
            meet_disc(core[CORNERS + 2 * j], core[CORNERS + 2 * j + 1], rounding, fan, row, begin, end)
    if axes == 0:
        return
    for i in range(np.uint64(begin), np.uint64(end)):
        enter, leave = ZERO, _FAR
        for j in range(axes):
            inside = core[EXTENTS + j] + (rounding if j < corners else ZERO)
            growth = -(core[AXES + 2 * j] * fan[0, i] + core[AXES + 2 * j + 1] * fan[1, i])
            enter, leave = _cut(enter, leave, inside, growth)
        distance = enter if leave >= enter else _FAR
        row[i] = distance if distance < row[i] else row[i]


@compiled
def invert(fan: FloatArray, count: int) -> None:
    """Fill one over the components of so many directions."""
    for i in range(np.uint64(count)):
        for axis in range(2):
            component = fan[axis, i]
            parallel = (component < _PARALLEL) & (component > -_PARALLEL)
            fan[2 + axis, i] = ONE / (_PARALLEL if parallel else component)


@compiled
def _meet_nearby(
    x: np.float32,
    y: np.float32,
    boxes: FloatArray,
    triangles: FloatArray,
    distance: np.float32,
    fan: FloatArray,
    row: FloatArray,
) -> None:
    """Shorten one ray by all obstacles within ``distance`` of ``(x, y)``."""
    for j in range(boxes.shape[0]):
        low_x, low_y, high_x, high_y = boxes[j, 0] - x, boxes[j, 1] - y, boxes[j, 2] - x, boxes[j, 3] - y
        if boxes[j, 4] > ZERO:
            if low_x * low_x + low_y * low_y <= (distance + boxes[j, 4]) * (distance + boxes[j, 4]):
                meet_disc(low_x, low_y, boxes[j, 4], fan, row, 0, 1)
            continue
        gap_x, gap_y = max(low_x, -high_x, ZERO), max(low_y, -high_y, ZERO)
        if gap_x * gap_x + gap_y * gap_y <= distance * distance:
            meet_box(low_x, low_y, high_x, high_y, fan, row, 0, 1)
    for j in range(triangles.shape[0]):
        c = triangles[j]
        gap_x = max(min(c[0], c[2], c[4]) - x, x - max(c[0], c[2], c[4]), ZERO)
        gap_y = max(min(c[1], c[3], c[5]) - y, y - max(c[1], c[3], c[5]), ZERO)
        if gap_x * gap_x + gap_y * gap_y <= distance * distance:
            meet_triangle(x, y, c, fan, row, 0, 1)


@compiled
def is_blocked(
    position: FloatArray, other: FloatArray, boxes: FloatArray, triangles: FloatArray, scratch: FloatArray
) -> bool:
    """Check whether an obstacle lies between two positions; ``scratch`` ``(5, 1)`` is overwritten."""
    fan, row = scratch[:4], scratch[4]
    x, y = other[0] - position[0], other[1] - position[1]
    distance = np.sqrt(x * x + y * y)
    fan[0, 0], fan[1, 0], row[0] = x / distance, y / distance, distance
    invert(fan, 1)
    _meet_nearby(position[0], position[1], boxes, triangles, distance, fan, row)
    return row[0] < distance
