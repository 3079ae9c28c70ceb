"""Exact tests of convex bodies, compiled with numba: cores of the plane, rounded rectangles, and ellipsoids.

Two convex cores are farther apart than a distance where one of their axes shows it (the separating axis theorem, which
along a unit axis bounds the distance), overlap where none shows a gap, and are otherwise as near as some corner of one
is to some edge of the other. Of rectangles (boxes, capsules, discs) both follow in closed form from the offset of their
centres and the turn between them, in many samples at once: the loops over these vectorise. All is computed relative to
the robot, so that large coordinates cost no precision. In space ellipsoids keep their axes along those of the world;
see :func:`balls_within`.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray, Whole
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.dynamics import collision
from d4orm_env.engine.compiling import ONE, ZERO, compiled
from d4orm_env.engine.elementary import OPS, maximum, minimum
from d4orm_env.engine.simd import CHUNK, TILE, chunk_at_most, use_wide_registers

_HALF = np.float32(0.5)

# Parts of a placed core: a row of a buffer of TILE numbers.
COUNT, NUM_AXES, ROUNDING, CORNERS, AXES, EXTENTS = 0, 1, 2, 3, 19, 35
BISECTIONS = 16
"""Steps by which the best weight of two ellipsoids is found: to 2^-16, where the criterion is flat."""


@compiled
def place_disc(radius: np.float32, x: np.float32, y: np.float32, core: FloatArray) -> None:
    """Write a disc at ``(x, y)``."""
    core[COUNT], core[NUM_AXES], core[ROUNDING] = ONE, ZERO, radius
    core[CORNERS], core[CORNERS + 1] = x, y


@compiled
def place_body(
    f: FootprintArrays, i: Whole, c: np.float32, s: np.float32, x: np.float32, y: np.float32, core: FloatArray
) -> None:
    """Write body ``i`` at ``(x, y)``, its heading as a unit vector ``(c, s)``."""
    core[COUNT], core[NUM_AXES], core[ROUNDING] = f.num_corners[i], f.num_axes[i], f.rounding[i]
    for j in range(f.num_corners[i]):
        core[CORNERS + 2 * j] = x + (c * f.corners[i, j, 0] - s * f.corners[i, j, 1])
        core[CORNERS + 2 * j + 1] = y + (s * f.corners[i, j, 0] + c * f.corners[i, j, 1])
    for j in range(f.num_axes[i]):
        along_x, along_y = c * f.axes[i, j, 0] - s * f.axes[i, j, 1], s * f.axes[i, j, 0] + c * f.axes[i, j, 1]
        core[AXES + 2 * j], core[AXES + 2 * j + 1] = along_x, along_y
        core[EXTENTS + j] = f.extents[i, j] + (along_x * x + along_y * y)


@compiled
def place_box(boxes: FloatArray, i: Whole, x: np.float32, y: np.float32, core: FloatArray) -> None:
    """Write a rounded box of the plane, seen from ``(x, y)``."""
    left, low, right, high = boxes[i, 0] - x, boxes[i, 1] - y, boxes[i, 2] - x, boxes[i, 3] - y
    core[COUNT], core[NUM_AXES], core[ROUNDING] = np.float32(4), np.float32(4), boxes[i, 4]
    core[CORNERS], core[CORNERS + 1], core[CORNERS + 2], core[CORNERS + 3] = left, low, right, low
    core[CORNERS + 4], core[CORNERS + 5], core[CORNERS + 6], core[CORNERS + 7] = right, high, left, high
    core[AXES], core[AXES + 1], core[AXES + 2], core[AXES + 3] = -ONE, ZERO, ONE, ZERO
    core[AXES + 4], core[AXES + 5], core[AXES + 6], core[AXES + 7] = ZERO, -ONE, ZERO, ONE
    core[EXTENTS], core[EXTENTS + 1], core[EXTENTS + 2], core[EXTENTS + 3] = -left, right, -low, high


@compiled
def place_triangle(triangles: FloatArray, i: Whole, x: np.float32, y: np.float32, core: FloatArray) -> None:
    """Write a triangle, seen from ``(x, y)``."""
    core[COUNT], core[NUM_AXES], core[ROUNDING] = np.float32(3), np.float32(3), ZERO
    for j in range(3):
        core[CORNERS + 2 * j], core[CORNERS + 2 * j + 1] = triangles[i, 2 * j] - x, triangles[i, 2 * j + 1] - y
    for j in range(3):
        after = CORNERS + 2 * ((j + 1) % 3)
        along_x, along_y = core[after] - core[CORNERS + 2 * j], core[after + 1] - core[CORNERS + 2 * j + 1]
        length = np.sqrt(along_x * along_x + along_y * along_y)
        core[AXES + 2 * j], core[AXES + 2 * j + 1] = along_y / length, -along_x / length
        core[EXTENTS + j] = core[AXES + 2 * j] * core[after] + core[AXES + 2 * j + 1] * core[after + 1]


@compiled
def _separation(a: FloatArray, b: FloatArray, widest: np.float32) -> np.float32:
    """The widest gap to ``b`` along an axis of ``a``, or ``widest`` if that is wider."""
    for i in range(int(a[NUM_AXES])):
        along_x, along_y, least = a[AXES + 2 * i], a[AXES + 2 * i + 1], np.float32(np.inf)
        for j in range(int(b[COUNT])):
            least = min(least, along_x * b[CORNERS + 2 * j] + along_y * b[CORNERS + 2 * j + 1])
        widest = max(widest, least - a[EXTENTS + i])
    return widest


@compiled
def _corner_near_edge(a: FloatArray, b: FloatArray, distance: np.float32) -> bool:
    """Check whether a corner of ``a`` is within ``distance`` of an edge of ``b``."""
    count = int(b[COUNT])
    for i in range(int(a[COUNT])):
        for j in range(count):
            x, y = a[CORNERS + 2 * i] - b[CORNERS + 2 * j], a[CORNERS + 2 * i + 1] - b[CORNERS + 2 * j + 1]
            if x * x + y * y <= distance * distance:
                return True
            after = CORNERS + 2 * ((j + 1) % count)
            along_x, along_y = b[after] - b[CORNERS + 2 * j], b[after + 1] - b[CORNERS + 2 * j + 1]
            # A point, and a box of no size, have edges of no length: their corner has been asked.
            if along_x * along_x + along_y * along_y > ZERO and collision.meets_edge(
                x, y, along_x, along_y, distance, ZERO, OPS
            ):
                return True
    return False


@compiled
def cores_within(a: FloatArray, b: FloatArray, extra: np.float32) -> bool:
    """Check whether two placed cores, each widened by its rounding, are within ``extra`` of each other."""
    total = a[ROUNDING] + b[ROUNDING] + extra
    nothing = np.float32(-np.inf)
    apart = _separation(b, a, _separation(a, b, nothing))
    if apart > total:
        return False
    if apart <= ZERO and apart > nothing:
        return True
    return _corner_near_edge(a, b, total) or _corner_near_edge(b, a, total)


@compiled
def balls_within(
    x: np.float32, y: np.float32, z: np.float32,
    a: tuple[np.float32, np.float32, np.float32], b: tuple[np.float32, np.float32, np.float32],
) -> bool:  # fmt: skip
    """Check whether two ellipsoids with these semi-axes, offset by ``(x, y, z)``, touch (Perram and Wertheim, 1985).

    They are apart where ``s (1 - s) (x^2 / ((1 - s) a^2 + s b^2) + ...)`` exceeds one for some weight ``s``. It is
    concave in ``s``: its slope is bisected. Of two that are alike the best weight is one half.
    """
    if a == b:
        x, y, z = _HALF * x / a[0], _HALF * y / a[1], _HALF * z / a[2]
        return bool(x * x + y * y + z * z <= ONE)
    low, high, most = ZERO, ONE, ZERO
    for _ in range(BISECTIONS):
        s = _HALF * (low + high)
        value = slope = ZERO
        for axis in range(3):
            d = x if axis == 0 else y if axis == 1 else z
            a2, b2 = a[axis] * a[axis], b[axis] * b[axis]
            mixed = (ONE - s) * a2 + s * b2
            value += s * (ONE - s) * d * d / mixed
            slope += d * d * ((ONE - s) * (ONE - s) * a2 - s * s * b2) / (mixed * mixed)
        most = max(most, value)
        low, high = (s, high) if slope > ZERO else (low, s)
    return bool(most <= ONE)


@compiled
def ball_meets_box(boxes: FloatArray, i: Whole, x: np.float32, y: np.float32, z: np.float32,
                    axes: tuple[np.float32, np.float32, np.float32]) -> bool:  # fmt: skip
    """Check whether an ellipsoid with these semi-axes at ``(x, y, z)`` touches a rounded box."""
    gap_x = max(boxes[i, 0] - x, x - boxes[i, 3], ZERO)
    gap_y = max(boxes[i, 1] - y, y - boxes[i, 4], ZERO)
    gap_z = max(boxes[i, 2] - z, z - boxes[i, 5], ZERO)
    rounding = boxes[i, 6]
    if rounding > ZERO:  # a ball, or a cylinder, from whose axis the gap along z is zero
        return balls_within(gap_x, gap_y, gap_z, axes, (rounding, rounding, rounding))
    gap_x, gap_y, gap_z = gap_x / axes[0], gap_y / axes[1], gap_z / axes[2]
    return bool(gap_x * gap_x + gap_y * gap_y + gap_z * gap_z <= ONE)


@compiled
def leaves_bounds(
    f: FootprintArrays, bounds: FloatArray, i: Whole, position: tuple[np.float32, np.float32, np.float32],
    extra: np.float32, core: FloatArray,
) -> bool:  # fmt: skip
    """Check whether body ``i``, whose core is placed about the robot's position, comes within ``extra`` of a bound."""
    dimension = bounds.shape[1]
    for axis in range(dimension):
        low = high = ZERO
        if dimension == 3:
            high = f.wall_axes[i, axis]
            low = -high
        else:
            low, high = np.float32(np.inf), np.float32(-np.inf)
            for j in range(f.num_corners[i]):
                low, high = min(low, core[CORNERS + 2 * j + axis]), max(high, core[CORNERS + 2 * j + axis])
            low, high = low - f.rounding[i], high + f.rounding[i]
        if position[axis] + (low - extra) <= bounds[0, axis] or position[axis] + (high + extra) >= bounds[1, axis]:
            return True
    return False


@compiled
def box_is_beyond(boxes: FloatArray, i: Whole, distance: np.float32, x: np.float32, y: np.float32) -> bool:
    """Check whether a rounded box of the plane is farther from a position than ``distance``."""
    gap_x, gap_y = max(boxes[i, 0] - x, x - boxes[i, 2], ZERO), max(boxes[i, 1] - y, y - boxes[i, 3], ZERO)
    distance += boxes[i, 4]
    return bool(gap_x * gap_x + gap_y * gap_y > distance * distance)


Rectangle: TypeAlias = tuple[np.float32, np.float32, np.float32]
"""Half of the length and of the width, and how far ahead of the reference point the centre lies [m]."""
Offset: TypeAlias = tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32]


@compiled
def _offset(
    one: Rectangle, other: Rectangle, positions: FloatArray, a: Whole, b: Whole, poses: FloatArray, p: Whole, q: Whole
) -> Offset:
    """The second centre seen from the first one, along the axes of the first and of the second, and the turn between
    them as a unit vector. Positions are in the rows from ``a`` and ``b`` on, poses in those from ``p`` and ``q`` on.
    """
    c, s, d, t = poses[p], poses[p + TILE], poses[q], poses[q + TILE]
    x = (positions[b] - positions[a]) + ((poses[q + 2 * TILE] + other[2] * d) - (poses[p + 2 * TILE] + one[2] * c))
    y = (positions[b + TILE] - positions[a + TILE]) + (
        (poses[q + 3 * TILE] + other[2] * t) - (poses[p + 3 * TILE] + one[2] * s)
    )
    return c * x + s * y, c * y - s * x, d * x + t * y, d * y - t * x, c * d + s * t, c * t - s * d


@compiled
def _apart(one: Rectangle, other: Rectangle, at: Offset) -> np.float32:
    """The widest gap of two rectangles along their axes."""
    along, across = abs(at[4]), abs(at[5])
    mine = maximum(
        abs(at[0]) - (one[0] + other[0] * along + other[1] * across),
        abs(at[1]) - (one[1] + other[0] * across + other[1] * along),
    )
    its = maximum(
        abs(at[2]) - (other[0] + one[0] * along + one[1] * across),
        abs(at[3]) - (other[1] + one[0] * across + one[1] * along),
    )
    return maximum(mine, its)


@compiled
def _corner_distance2(half: Rectangle, x: np.float32, y: np.float32) -> np.float32:
    """The squared distance of a point from a rectangle about the origin."""
    gap_x, gap_y = maximum(abs(x) - half[0], ZERO), maximum(abs(y) - half[1], ZERO)
    return gap_x * gap_x + gap_y * gap_y


@compiled
def _corners_distance2(
    half: Rectangle, its: Rectangle, x: np.float32, y: np.float32, c: np.float32, s: np.float32
) -> np.float32:
    """The squared distance of the nearest corner of another rectangle, at ``(x, y)`` and turned by ``(c, s)``."""
    along_x, along_y, across_x, across_y = its[0] * c, its[0] * s, -its[1] * s, its[1] * c
    front = minimum(
        _corner_distance2(half, x + along_x + across_x, y + along_y + across_y),
        _corner_distance2(half, x + along_x - across_x, y + along_y - across_y),
    )
    back = minimum(
        _corner_distance2(half, x - along_x + across_x, y - along_y + across_y),
        _corner_distance2(half, x - along_x - across_x, y - along_y - across_y),
    )
    return minimum(front, back)


@compiled
def rectangles_within(
    one: Rectangle, other: Rectangle, near: np.uint64, total: np.float32,
    positions: FloatArray, a: Whole, b: Whole, poses: FloatArray, p: Whole, q: Whole, buffer: FloatArray,
) -> np.uint64:  # fmt: skip
    """Mask of the first ``CHUNK`` samples, of those ``near``, in which two rectangles are within ``total``."""
    use_wide_registers()
    for s in range(CHUNK):
        buffer[s] = _apart(one, other, _offset(one, other, positions, a + s, b + s, poses, p + s, q + s))
    sure, possible = chunk_at_most(buffer, 0, ZERO) & near, chunk_at_most(buffer, 0, total) & near
    if sure == possible:
        return sure
    for s in range(CHUNK):
        at = _offset(one, other, positions, a + s, b + s, poses, p + s, q + s)
        mine = _corners_distance2(one, other, at[0], at[1], at[4], at[5])
        buffer[s] = minimum(mine, _corners_distance2(other, one, -at[2], -at[3], at[4], -at[5]))
    return sure | (chunk_at_most(buffer, 0, total * total) & possible)
