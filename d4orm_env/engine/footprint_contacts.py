"""Exact contacts of footprints that are no discs, compiled with numba, for the samples that their outer discs flag.

A robot is a body, and its trailers are further ones: see :class:`~d4orm_env.core.bodies.FootprintArrays`.
Where the bodies of the plane are is kept in ``poses``, :data:`POSE` rows each: the heading as a unit vector, and the
reference point relative to the robot's position. Those of body ``i`` begin at ``i * stride + begin``.
"""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, Whole
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine.compiling import ONE, ZERO, compiled, inlined, trailing_zeros
from d4orm_env.engine.convex_cores import (
    ball_meets_box,
    balls_within,
    box_is_beyond,
    cores_within,
    leaves_bounds,
    place_body,
    place_box,
    place_disc,
    place_triangle,
    rectangles_within,
)
from d4orm_env.engine.elementary import cosine, sine
from d4orm_env.engine.obstacles import cell_at
from d4orm_env.engine.simd import BIT, CHUNK, NOWHERE, TILE, chunk_at_most, use_wide_registers

POSE = 4
"""Rows of a body's pose."""

_CHUNK_BITS = np.uint64((1 << CHUNK) - 1)
_HALF = np.float32(0.5)


@compiled
def place_bodies(f: FootprintArrays, k: Whole, w: FloatArray, poses: FloatArray, stride: int, begin: Whole) -> None:
    """Write the poses of robot ``k`` and its trailers, its state in the first rows of ``w``."""
    use_wide_registers()
    i, before = np.int64(k), np.int64(0)
    while i >= 0:
        o, column, hitch = i * stride + begin, f.heading[i], f.hitch[i]
        if column >= 0:
            for s in range(TILE):
                poses[o + s] = cosine(w[column * TILE + s])
            for s in range(TILE):
                poses[o + TILE + s] = sine(w[column * TILE + s])
        else:
            poses[o : o + TILE], poses[o + TILE : o + 2 * TILE] = ONE, ZERO
        if i == k:
            poses[o + 2 * TILE : o + 4 * TILE] = ZERO
        else:
            for s in range(TILE):  # it lags behind the body before it by the hitch angle
                c, t, x, y = poses[before + s], poses[before + TILE + s], poses[o + s], poses[o + TILE + s]
                poses[o + s], poses[o + TILE + s] = c * x + t * y, t * x - c * y
            for s in range(2 * TILE):
                poses[o + 2 * TILE + s] = poses[before + 2 * TILE + s] - hitch * poses[o + s]
        before, i = o, np.int64(f.following[i])


@compiled
def _semi_axes(
    f: FootprintArrays, k: Whole, radius: np.float32, wider: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """The semi-axes of robot ``k``, or of a ball of this radius if it is -1, each longer by ``wider``."""
    if k < 0:
        return radius + wider, radius + wider, radius + wider
    return f.semi_axes[k, 0] + wider, f.semi_axes[k, 1] + wider, f.semi_axes[k, 2] + wider


@compiled
def _wall_axes(f: FootprintArrays, k: Whole, wider: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """The semi-axes of what obstacles meet of robot ``k``, each longer by ``wider``."""
    return f.wall_axes[k, 0] + wider, f.wall_axes[k, 1] + wider, f.wall_axes[k, 2] + wider


@compiled
def _place_own(f: FootprintArrays, i: Whole, poses: FloatArray, stride: int, begin: Whole, core: FloatArray) -> None:
    """Write body ``i`` of a robot about the robot's position."""
    o = i * stride + begin
    place_body(f, i, poses[o], poses[o + TILE], poses[o + 2 * TILE], poses[o + 3 * TILE], core)


@compiled
def _meets_own(
    f: FootprintArrays,
    k: Whole,
    poses: FloatArray,
    stride: int,
    begin: Whole,
    extra: np.float32,
    buffer: FloatArray,
) -> bool:
    """Check whether a body of robot ``k`` is within ``extra`` of the core in the second row of ``buffer``."""
    i = np.int64(k)
    while i >= 0:
        _place_own(f, i, poses, stride, begin, buffer[:TILE])
        if cores_within(buffer[:TILE], buffer[TILE : 2 * TILE], extra):
            return True
        i = np.int64(f.following[i])
    return False


@compiled
def meets_body(
    f: FootprintArrays, k: Whole, own_radius: np.float32, poses: FloatArray, stride: int, begin: Whole,
    others: FootprintArrays, other: Whole, radius: np.float32, turns: FloatArray,
    x: np.float32, y: np.float32, z: np.float32, planar: bool, extra: np.float32, buffer: FloatArray,
) -> bool:  # fmt: skip
    """Check whether robot ``k`` is within ``extra`` of another body, offset by ``(x, y, z)`` from it.

    That is number ``other`` of ``others``, its bodies' headings in ``turns``, or a disc or ball of its radius if it is
    number -1: an obstacle.
    """
    if not planar:
        wider = _HALF * extra
        own = _wall_axes(f, k, wider) if other < 0 else _semi_axes(f, k, own_radius, wider)
        return balls_within(x, y, z, own, _semi_axes(others, other, radius, wider))
    core = buffer[TILE : 2 * TILE]
    if other < 0:
        place_disc(radius, x, y, core)
        return _meets_own(f, k, poses, stride, begin, extra, buffer)
    j = np.int64(other)
    while j >= 0:
        c, s = (cosine(turns[j]), sine(turns[j])) if others.heading[j] >= 0 else (ONE, ZERO)
        x, y = x - others.hitch[j] * c, y - others.hitch[j] * s
        place_body(others, j, c, s, x, y, core)
        if _meets_own(f, k, poses, stride, begin, extra, buffer):
            return True
        j = np.int64(others.following[j])
    return False


@compiled
def _refine_balls(
    f: FootprintArrays, k: Whole, other: Whole, near: np.uint64, extra: np.float32, positions: FloatArray,
    a: Whole, b: Whole, buffer: FloatArray,
) -> np.uint64:  # fmt: skip
    sure, unsure, wider = near, near, _HALF * extra
    own, its = _semi_axes(f, k, ZERO, wider), _semi_axes(f, other, ZERO, wider)
    if own == its:  # touching where points of the same shape twice as large do: all samples at once
        scale_x, scale_y, scale_z = _HALF / own[0], _HALF / own[1], _HALF / own[2]
        for lane in range(CHUNK):
            x, y = (
                scale_x * (positions[b + lane] - positions[a + lane]),
                scale_y * (positions[b + TILE + lane] - positions[a + TILE + lane]),
            )
            z = scale_z * (positions[b + 2 * TILE + lane] - positions[a + 2 * TILE + lane])
            buffer[lane] = x * x + y * y + z * z
        return chunk_at_most(buffer, 0, ONE) & near
    while unsure != NOWHERE:
        s = np.int64(trailing_zeros(unsure))
        unsure &= unsure - BIT
        x, y = positions[b + s] - positions[a + s], positions[b + TILE + s] - positions[a + TILE + s]
        if not balls_within(x, y, positions[b + 2 * TILE + s] - positions[a + 2 * TILE + s], own, its):
            sure &= ~(BIT << np.uint64(s))
    return sure


@compiled
def _refine_cores(
    f: FootprintArrays, i: Whole, j: Whole, near: np.uint64, extra: np.float32, positions: FloatArray, a: Whole,
    b: Whole, poses: FloatArray, p: Whole, q: Whole, buffer: FloatArray,
) -> np.uint64:  # fmt: skip
    sure, unsure, own, core = near, near, buffer[:TILE], buffer[TILE : 2 * TILE]
    while unsure != NOWHERE:
        s = np.int64(trailing_zeros(unsure))
        unsure &= unsure - BIT
        m, n = p + s, q + s
        x = (positions[b + s] - positions[a + s]) + (poses[n + 2 * TILE] - poses[m + 2 * TILE])
        y = (positions[b + TILE + s] - positions[a + TILE + s]) + (poses[n + 3 * TILE] - poses[m + 3 * TILE])
        place_body(f, i, poses[m], poses[m + TILE], ZERO, ZERO, own)
        place_body(f, j, poses[n], poses[n + TILE], x, y, core)
        if not cores_within(own, core, extra):
            sure &= ~(BIT << np.uint64(s))
    return sure


@inlined
def refine_chunk(
    f: FootprintArrays | None, k: Whole, other: Whole, near: np.uint64, extra: np.float32, dimension: int,
    positions: FloatArray, a: Whole, b: Whole, poses: FloatArray, stride: int, begin: Whole, buffer: FloatArray,
) -> np.uint64:  # fmt: skip
    """Mask of the samples, of those ``near`` among the first ``CHUNK``, in which two robots are within ``extra``.

    Their positions are in the rows of ``positions`` from ``a`` and ``b`` on. ``f`` is the team's footprints; of discs,
    for which it is ``None``, it is known already. ``buffer`` is two rows to overwrite.
    """
    if f is None:
        return near
    if near == NOWHERE:
        return near
    if dimension == 3:
        return _refine_balls(f, k, other, near, extra, positions, a, b, buffer)
    touch, i = NOWHERE, np.int64(k)
    while i >= 0:
        j = np.int64(other)
        while j >= 0:
            left, p, q = near & ~touch, i * stride + begin, j * stride + begin
            if left == NOWHERE:
                return touch
            if f.rectangles[i, 0] >= ZERO and f.rectangles[j, 0] >= ZERO:
                one = (f.rectangles[i, 0], f.rectangles[i, 1], f.rectangles[i, 2])
                its = (f.rectangles[j, 0], f.rectangles[j, 1], f.rectangles[j, 2])
                total = f.rounding[i] + f.rounding[j] + extra
                touch |= rectangles_within(one, its, left, total, positions, a, b, poses, p, q, buffer)
            else:
                touch |= _refine_cores(f, i, j, left, extra, positions, a, b, poses, p, q, buffer)
            j = np.int64(f.following[j])
        i = np.int64(f.following[i])
    return touch


@inlined
def refine_pair(
    f: FootprintArrays | None, k: Whole, other: Whole, near: np.uint64, extra: np.float32, dimension: int,
    positions: FloatArray, a: Whole, b: Whole, poses: FloatArray, stride: int, begin: Whole, buffer: FloatArray,
) -> np.uint64:  # fmt: skip
    """:func:`refine_chunk` in all samples of a tile."""
    if f is None:
        return near
    touch = NOWHERE
    for s in range(0, TILE, CHUNK):
        part = (near >> np.uint64(s)) & _CHUNK_BITS
        part = refine_chunk(
            f, k, other, part, extra, dimension, positions, a + s, b + s, poses, stride, begin + s, buffer
        )
        touch |= part << np.uint64(s)
    return touch


@compiled
def touches_static(
    f: FootprintArrays, arrays: ProblemArrays, k: Whole, position: tuple[np.float32, np.float32, np.float32],
    poses: FloatArray, stride: int, begin: Whole, extra: np.float32, buffer: FloatArray,
) -> bool:  # fmt: skip
    """Check whether robot ``k`` at this position comes within ``extra`` of an obstacle or a bound."""
    index, dimension, i = arrays.grid, arrays.goal.shape[1], np.int64(k)
    while i >= 0:
        if dimension == 2:
            _place_own(f, i, poses, stride, begin, buffer[:TILE])
        if leaves_bounds(f, arrays.bounds, i, position, extra, buffer[:TILE]):
            return True
        i = np.int64(f.following[i])
    if index.clearance.shape[0] == 0:
        return False
    cell, (x, y, z) = cell_at(index, position, dimension), position
    for number in range(index.first[cell], index.first[cell + 1]):
        item = np.int64(index.items[number])
        if dimension == 3:
            if ball_meets_box(arrays.boxes, item, x, y, z, _wall_axes(f, k, extra)):
                return True
            continue
        if item < arrays.boxes.shape[0]:
            if box_is_beyond(arrays.boxes, item, arrays.radius[k] + extra, x, y):
                continue
            place_box(arrays.boxes, item, x, y, buffer[TILE : 2 * TILE])
        else:
            place_triangle(arrays.triangles, item - arrays.boxes.shape[0], x, y, buffer[TILE : 2 * TILE])
        if _meets_own(f, k, poses, stride, begin, extra, buffer):
            return True
    return False


@compiled
def refine_static(
    f: FootprintArrays | None, arrays: ProblemArrays, k: Whole, near: np.uint64, extra: np.float32,
    positions: FloatArray, poses: FloatArray, stride: int, begin: Whole, buffer: FloatArray,
) -> np.uint64:  # fmt: skip
    """Mask of the samples, of those ``near``, in which robot ``k`` is within ``extra`` of an obstacle or a bound.

    Its positions are in the first rows of ``positions``; ``buffer`` is two rows to overwrite. ``f`` is as in
    :func:`refine_chunk`. ``near`` are those in which the disc or ball of its ``wall_radius`` is.
    """
    if f is None:
        return near
    sure, unsure, planar = near, near, arrays.goal.shape[1] == 2
    if not planar and f.wall_axes[k, 0] == f.wall_axes[k, 1] and f.wall_axes[k, 0] == f.wall_axes[k, 2]:
        return near
    while unsure != NOWHERE:
        s = np.int64(trailing_zeros(unsure))
        unsure &= unsure - BIT
        position = (positions[s], positions[TILE + s], ZERO if planar else positions[2 * TILE + s])
        if not touches_static(f, arrays, k, position, poses, stride, begin + s, extra, buffer):
            sure &= ~(BIT << np.uint64(s))
    return sure
