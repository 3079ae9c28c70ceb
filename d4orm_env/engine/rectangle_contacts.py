"""Exact contacts of two rounded rectangles in many samples at once: boxes, capsules and discs, compiled with numba.

Two rectangles overlap where none of their four axes has a gap between them. Otherwise they are as near as a corner of
one is to the other. Each is told in closed form from the offset of their centres and the turn between them, so that
the loops over samples vectorise; the second one is asked only where the axes leave it open.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray, Whole
from d4orm_env.engine.compiling import ZERO, compiled
from d4orm_env.engine.simd import CHUNK, TILE, chunk_at_most, use_wide_registers

Rectangle: TypeAlias = tuple[np.float32, np.float32, np.float32]
"""Half of the length and of the width, and how far ahead of the reference point the centre lies [m]."""
Offset: TypeAlias = tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32]


@compiled
def _larger(a: np.float32, b: np.float32) -> np.float32:
    return a if a > b else b


@compiled
def _smaller(a: np.float32, b: np.float32) -> np.float32:
    return a if a < b else b


@compiled
def _offset(
    one: Rectangle, other: Rectangle, places: FloatArray, a: Whole, b: Whole, poses: FloatArray, p: Whole, q: Whole
) -> Offset:
    """The second centre seen from the first one, along the axes of the first and of the second, and the turn between
    them as a unit vector. Places are in the rows from ``a`` and ``b`` on, poses in those from ``p`` and ``q`` on.
    """
    c, s, d, t = poses[p], poses[p + TILE], poses[q], poses[q + TILE]
    x = (places[b] - places[a]) + ((poses[q + 2 * TILE] + other[2] * d) - (poses[p + 2 * TILE] + one[2] * c))
    y = (places[b + TILE] - places[a + TILE]) + (
        (poses[q + 3 * TILE] + other[2] * t) - (poses[p + 3 * TILE] + one[2] * s)
    )
    return c * x + s * y, c * y - s * x, d * x + t * y, d * y - t * x, c * d + s * t, c * t - s * d


@compiled
def _apart(one: Rectangle, other: Rectangle, at: Offset) -> np.float32:
    """The most by which an axis tells two rectangles from each other."""
    along, across = abs(at[4]), abs(at[5])
    mine = _larger(
        abs(at[0]) - (one[0] + other[0] * along + other[1] * across),
        abs(at[1]) - (one[1] + other[0] * across + other[1] * along),
    )
    its = _larger(
        abs(at[2]) - (other[0] + one[0] * along + one[1] * across),
        abs(at[3]) - (other[1] + one[0] * across + one[1] * along),
    )
    return _larger(mine, its)


@compiled
def _corner_distance2(half: Rectangle, x: np.float32, y: np.float32) -> np.float32:
    """The squared distance of a point from a rectangle about the origin."""
    gap_x, gap_y = _larger(abs(x) - half[0], ZERO), _larger(abs(y) - half[1], ZERO)
    return gap_x * gap_x + gap_y * gap_y


@compiled
def _corners_distance2(
    half: Rectangle, its: Rectangle, x: np.float32, y: np.float32, c: np.float32, s: np.float32
) -> np.float32:
    """The squared distance of the nearest corner of another rectangle, at ``(x, y)`` and turned by ``(c, s)``."""
    along_x, along_y, across_x, across_y = its[0] * c, its[0] * s, -its[1] * s, its[1] * c
    front = _smaller(
        _corner_distance2(half, x + along_x + across_x, y + along_y + across_y),
        _corner_distance2(half, x + along_x - across_x, y + along_y - across_y),
    )
    back = _smaller(
        _corner_distance2(half, x - along_x + across_x, y - along_y + across_y),
        _corner_distance2(half, x - along_x - across_x, y - along_y - across_y),
    )
    return _smaller(front, back)


@compiled
def rectangles_within(
    one: Rectangle, other: Rectangle, near: np.uint64, total: np.float32,
    places: FloatArray, a: Whole, b: Whole, poses: FloatArray, p: Whole, q: Whole, buffer: FloatArray,
) -> np.uint64:  # fmt: skip
    """Return where, of the first ``CHUNK`` samples, those ``near``, two rectangles are within ``total``."""
    use_wide_registers()
    for s in range(CHUNK):
        buffer[s] = _apart(one, other, _offset(one, other, places, a + s, b + s, poses, p + s, q + s))
    sure, possible = chunk_at_most(buffer, 0, ZERO) & near, chunk_at_most(buffer, 0, total) & near
    if sure == possible:
        return sure
    for s in range(CHUNK):
        at = _offset(one, other, places, a + s, b + s, poses, p + s, q + s)
        mine = _corners_distance2(one, other, at[0], at[1], at[4], at[5])
        buffer[s] = _smaller(mine, _corners_distance2(other, one, -at[2], -at[3], at[4], -at[5]))
    return sure | (chunk_at_most(buffer, 0, total * total) & possible)
