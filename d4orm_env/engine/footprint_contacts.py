"""Exact contacts of footprints that are no discs, compiled with numba, for the samples that their outer discs flag.

Two convex cores are apart by more than a reach where one of their axes tells (the separating axis theorem, which along
a unit axis bounds the distance), overlap where none tells anything, and are otherwise as near as some corner of one is
to some edge of the other. All is computed relative to the robot, so that large coordinates cost no precision. In space
ellipsoids keep their axes along those of the world; see :func:`balls_within`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba.cpython.unsafe import numbers

from d4orm_env.core.arrays import FloatArray, Whole
from d4orm_env.core.footprint_arrays import FootprintArrays
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import collision
from d4orm_env.engine.compiling import ONE, ZERO, compiled
from d4orm_env.engine.elementary import OPS, cosine, sine
from d4orm_env.engine.simd import NOWHERE, TILE

_BIT = np.uint64(1)
_HALF = np.float32(0.5)
_trailing_zeros: Callable[..., int] = numbers.trailing_zeros

# Parts of a placed core: a row of a buffer of TILE numbers.
_COUNT, _NUM_AXES, _ROUNDING, _CORNERS, _AXES, _EXTENTS = 0, 1, 2, 3, 19, 35
BISECTIONS = 16
"""Steps by which the best weight of two ellipsoids is found: to 2^-16, where the criterion is flat."""


@compiled
def _is_disc(k: Whole) -> bool:
    """Check whether a body is no robot, but a disc or ball of its radius: of number -1."""
    return bool(k < 0)


@compiled
def place_robot(
    f: FootprintArrays, k: Whole, radius: np.float32, x: np.float32, y: np.float32, angle: np.float32, core: FloatArray
) -> None:
    """Write the core of robot ``k`` at ``(x, y)`` and this heading, see :func:`_is_disc`."""
    if _is_disc(k):
        core[_COUNT], core[_NUM_AXES], core[_ROUNDING] = ONE, ZERO, radius
        core[_CORNERS], core[_CORNERS + 1] = x, y
        return
    c, s = (cosine(angle), sine(angle)) if f.heading[k] >= 0 else (ONE, ZERO)
    core[_COUNT], core[_NUM_AXES], core[_ROUNDING] = f.num_corners[k], f.num_axes[k], f.rounding[k]
    for i in range(f.num_corners[k]):
        core[_CORNERS + 2 * i] = x + (c * f.corners[k, i, 0] - s * f.corners[k, i, 1])
        core[_CORNERS + 2 * i + 1] = y + (s * f.corners[k, i, 0] + c * f.corners[k, i, 1])
    for i in range(f.num_axes[k]):
        along_x, along_y = c * f.axes[k, i, 0] - s * f.axes[k, i, 1], s * f.axes[k, i, 0] + c * f.axes[k, i, 1]
        core[_AXES + 2 * i], core[_AXES + 2 * i + 1] = along_x, along_y
        core[_EXTENTS + i] = f.extents[k, i] + (along_x * x + along_y * y)


@compiled
def _place_box(boxes: FloatArray, i: Whole, x: np.float32, y: np.float32, core: FloatArray) -> None:
    """Write a rounded box of the plane, seen from ``(x, y)``."""
    left, low, right, high = boxes[i, 0] - x, boxes[i, 1] - y, boxes[i, 2] - x, boxes[i, 3] - y
    core[_COUNT], core[_NUM_AXES], core[_ROUNDING] = np.float32(4), np.float32(4), boxes[i, 4]
    core[_CORNERS], core[_CORNERS + 1], core[_CORNERS + 2], core[_CORNERS + 3] = left, low, right, low
    core[_CORNERS + 4], core[_CORNERS + 5], core[_CORNERS + 6], core[_CORNERS + 7] = right, high, left, high
    core[_AXES], core[_AXES + 1], core[_AXES + 2], core[_AXES + 3] = -ONE, ZERO, ONE, ZERO
    core[_AXES + 4], core[_AXES + 5], core[_AXES + 6], core[_AXES + 7] = ZERO, -ONE, ZERO, ONE
    core[_EXTENTS], core[_EXTENTS + 1], core[_EXTENTS + 2], core[_EXTENTS + 3] = -left, right, -low, high


@compiled
def _place_triangle(triangles: FloatArray, i: Whole, x: np.float32, y: np.float32, core: FloatArray) -> None:
    """Write a triangle, seen from ``(x, y)``."""
    core[_COUNT], core[_NUM_AXES], core[_ROUNDING] = np.float32(3), np.float32(3), ZERO
    for j in range(3):
        core[_CORNERS + 2 * j], core[_CORNERS + 2 * j + 1] = triangles[i, 2 * j] - x, triangles[i, 2 * j + 1] - y
    for j in range(3):
        after = _CORNERS + 2 * ((j + 1) % 3)
        along_x, along_y = core[after] - core[_CORNERS + 2 * j], core[after + 1] - core[_CORNERS + 2 * j + 1]
        length = np.sqrt(along_x * along_x + along_y * along_y)
        core[_AXES + 2 * j], core[_AXES + 2 * j + 1] = along_y / length, -along_x / length
        core[_EXTENTS + j] = core[_AXES + 2 * j] * core[after] + core[_AXES + 2 * j + 1] * core[after + 1]


@compiled
def _separation(a: FloatArray, b: FloatArray, widest: np.float32) -> np.float32:
    """The most by which an axis of ``a`` tells ``b`` from it, or ``widest`` if that is more."""
    for i in range(int(a[_NUM_AXES])):
        along_x, along_y, least = a[_AXES + 2 * i], a[_AXES + 2 * i + 1], np.float32(np.inf)
        for j in range(int(b[_COUNT])):
            least = min(least, along_x * b[_CORNERS + 2 * j] + along_y * b[_CORNERS + 2 * j + 1])
        widest = max(widest, least - a[_EXTENTS + i])
    return widest


@compiled
def _corner_near_edge(a: FloatArray, b: FloatArray, reach: np.float32) -> bool:
    """Check whether a corner of ``a`` is within reach of an edge of ``b``."""
    count = int(b[_COUNT])
    for i in range(int(a[_COUNT])):
        for j in range(count):
            x, y = a[_CORNERS + 2 * i] - b[_CORNERS + 2 * j], a[_CORNERS + 2 * i + 1] - b[_CORNERS + 2 * j + 1]
            if x * x + y * y <= reach * reach:
                return True
            after = _CORNERS + 2 * ((j + 1) % count)
            along_x, along_y = b[after] - b[_CORNERS + 2 * j], b[after + 1] - b[_CORNERS + 2 * j + 1]
            # A point, and a box of no size, have edges of no length: their corner has been asked.
            if along_x * along_x + along_y * along_y > ZERO and collision.meets_edge(
                x, y, along_x, along_y, reach, ZERO, OPS
            ):
                return True
    return False


@compiled
def cores_within(a: FloatArray, b: FloatArray, reach: np.float32) -> bool:
    """Check whether two placed cores, each widened by its rounding, are within ``reach`` of each other."""
    total = a[_ROUNDING] + b[_ROUNDING] + reach
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
    concave in ``s``: its slope is bisected.
    """
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
def _semi_axes(
    f: FootprintArrays, k: Whole, radius: np.float32, wider: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """The semi-axes of robot ``k``, each longer by ``wider``."""
    if _is_disc(k):
        return radius + wider, radius + wider, radius + wider
    return f.semi_axes[k, 0] + wider, f.semi_axes[k, 1] + wider, f.semi_axes[k, 2] + wider


@compiled
def bodies_within(
    f: FootprintArrays, k: Whole, own_radius: np.float32, own_angle: np.float32,
    others: FootprintArrays, other: Whole, radius: np.float32, angle: np.float32,
    x: np.float32, y: np.float32, z: np.float32, planar: bool, reach: np.float32, buffer: FloatArray,
) -> bool:  # fmt: skip
    """Check whether robot ``k`` is within ``reach`` of another body, offset by ``(x, y, z)`` from it."""
    inner = own_radius if _is_disc(k) else f.inner[k]
    inner += radius if _is_disc(other) else others.inner[other]
    inner += reach
    if x * x + y * y + z * z <= inner * inner:
        return True
    if not planar:
        wider = _HALF * reach
        return balls_within(x, y, z, _semi_axes(f, k, own_radius, wider), _semi_axes(others, other, radius, wider))
    own_core, core = buffer[:TILE], buffer[TILE : 2 * TILE]
    place_robot(f, k, own_radius, ZERO, ZERO, own_angle, own_core)
    place_robot(others, other, radius, x, y, angle, core)
    return cores_within(own_core, core, reach)


@compiled
def angle_of(f: FootprintArrays, k: Whole, turns: FloatArray, begin: Whole) -> np.float32:
    """The heading that turns robot ``k``."""
    return turns[begin] if not _is_disc(k) and f.heading[k] >= 0 else ZERO


@compiled
def refine_pair(
    f: FootprintArrays | None, arrays: ProblemArrays, k: Whole, other: Whole, near: np.uint64, reach: np.float32,
    dimension: int, places: FloatArray, a: Whole, b: Whole, turns: FloatArray, turn_a: Whole, turn_b: Whole,
    buffer: FloatArray,
) -> np.uint64:  # fmt: skip
    """Return where, of the samples ``near``, two robots are within ``reach`` of each other.

    Their places are in the rows of ``places`` from ``a`` and ``b`` on, their headings in ``turns`` from ``turn_a`` and
    ``turn_b`` on. ``f`` is the team's footprints; of discs, for which it is ``None``, it is known already.
    """
    if f is None:
        return near
    sure, unsure = near, near
    while unsure != NOWHERE:
        s = np.int64(_trailing_zeros(unsure))
        unsure &= unsure - _BIT
        x, y = places[b + s] - places[a + s], places[b + TILE + s] - places[a + TILE + s]
        z = places[b + 2 * TILE + s] - places[a + 2 * TILE + s] if dimension == 3 else ZERO
        own_angle, angle = angle_of(f, k, turns, turn_a + s), angle_of(f, other, turns, turn_b + s)
        if not bodies_within(
            f, k, arrays.radius[k], own_angle, f, other, arrays.radius[other], angle,
            x, y, z, dimension == 2, reach, buffer,
        ):  # fmt: skip
            sure &= ~(_BIT << np.uint64(s))
    return sure


@compiled
def _leaves_bounds(
    f: FootprintArrays, arrays: ProblemArrays, k: Whole, place: tuple[np.float32, np.float32, np.float32],
    extra: np.float32, core: FloatArray,
) -> bool:  # fmt: skip
    """Check whether robot ``k``, whose core is placed about its reference point, comes within ``extra`` of a bound."""
    dimension = arrays.goal.shape[1]
    for axis in range(dimension):
        low = high = ZERO
        if dimension == 3:
            high = f.semi_axes[k, axis]
            low = -high
        else:
            low, high = np.float32(np.inf), np.float32(-np.inf)
            for i in range(f.num_corners[k]):
                low, high = min(low, core[_CORNERS + 2 * i + axis]), max(high, core[_CORNERS + 2 * i + axis])
            low, high = low - f.rounding[k], high + f.rounding[k]
        if (
            place[axis] + (low - extra) <= arrays.bounds[0, axis]
            or place[axis] + (high + extra) >= arrays.bounds[1, axis]
        ):
            return True
    return False


@compiled
def _ball_meets_box(boxes: FloatArray, i: Whole, x: np.float32, y: np.float32, z: np.float32,
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
def touches_static(
    f: FootprintArrays, arrays: ProblemArrays, k: Whole, x: np.float32, y: np.float32, z: np.float32, angle: np.float32,
    extra: np.float32, buffer: FloatArray,
) -> bool:  # fmt: skip
    """Check whether robot ``k`` at ``(x, y, z)`` and this heading comes within ``extra`` of an obstacle or a bound."""
    index, dimension = arrays.grid, arrays.goal.shape[1]
    own_core, core = buffer[:TILE], buffer[TILE : 2 * TILE]
    if dimension == 2:
        place_robot(f, k, arrays.radius[k], ZERO, ZERO, angle, own_core)
    if _leaves_bounds(f, arrays, k, (x, y, z), extra, own_core):
        return True
    if index.clearance.shape[0] == 0:
        return False
    cell = np.int64(0)
    for axis in range(dimension):
        at = x if axis == 0 else y if axis == 1 else z
        steps = np.int64(max((at - index.low[axis]) * index.scale, ZERO))
        cell = cell * index.size[axis] + min(steps, np.int64(index.size[axis]) - 1)
    for number in range(index.first[cell], index.first[cell + 1]):
        item = np.int64(index.items[number])
        if dimension == 3:
            if _ball_meets_box(arrays.boxes, item, x, y, z, _semi_axes(f, k, arrays.radius[k], extra)):
                return True
            continue
        if item < arrays.boxes.shape[0]:
            _place_box(arrays.boxes, item, x, y, core)
        else:
            _place_triangle(arrays.triangles, item - arrays.boxes.shape[0], x, y, core)
        if cores_within(own_core, core, extra):
            return True
    return False


@compiled
def refine_static(
    f: FootprintArrays | None, arrays: ProblemArrays, k: Whole, near: np.uint64, extra: np.float32,
    places: FloatArray, begin: Whole, turns: FloatArray, turn: Whole, buffer: FloatArray,
) -> np.uint64:  # fmt: skip
    """Return where, of the samples ``near``, robot ``k`` comes within ``extra`` of an obstacle or a bound.

    Its places are in the rows of ``places`` from ``begin`` on, its headings in ``turns`` from ``turn`` on; ``buffer``
    is two rows to overwrite. ``f`` is as in :func:`refine_pair`.
    """
    if f is None:
        return near
    sure, unsure, planar = near, near, arrays.goal.shape[1] == 2
    while unsure != NOWHERE:
        s = np.int64(_trailing_zeros(unsure))
        unsure &= unsure - _BIT
        z = ZERO if planar else places[begin + 2 * TILE + s]
        angle = angle_of(f, k, turns, turn + s)
        if not touches_static(f, arrays, k, places[begin + s], places[begin + TILE + s], z, angle, extra, buffer):
            sure &= ~(_BIT << np.uint64(s))
    return sure
