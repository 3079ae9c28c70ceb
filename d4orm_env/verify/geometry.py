"""Lengths and closest approaches in float64, with the same bits on every processor.

Sums over components are written out: how NumPy's own reductions group them depends on the processor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_SECTIONS = np.linspace(0.0, 1.0, 9)
_SECTION_ROUNDS = 14  # each narrows the bracket to a quarter: 4e-9 of the chord in the end


def dot(a: Floats, b: Floats) -> Floats:
    """Inner product over the last axis."""
    total: Floats = a[..., 0] * b[..., 0]
    for axis in range(1, a.shape[-1]):
        total = total + a[..., axis] * b[..., axis]
    product: Floats = total
    return product


def norm(a: Floats) -> Floats:
    """Length over the last axis."""
    length: Floats = np.sqrt(dot(a, a))
    return length


def closest_approach(start: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Smallest distance to the origin of points moving from ``start`` to ``end``, and at what fraction of the way."""
    move = end - start
    square = dot(move, move)
    fraction = np.clip(-dot(start, move) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    return norm(start + fraction[..., None] * move), fraction


def box_distance(points: Floats, boxes: Floats) -> Floats:
    """Distance from points to the surface of boxes, negative inside; the last axes broadcast, coordinates last."""
    size = points.shape[-1]
    square, deepest = np.zeros(()), np.full((), -np.inf)
    for axis in range(size):
        x = points[..., axis]
        outside = np.maximum(boxes[..., axis] - x, x - boxes[..., size + axis])
        beyond = np.maximum(outside, 0.0)
        square = square + beyond * beyond
        deepest = np.maximum(deepest, outside)
    distance: Floats = np.sqrt(square) + np.minimum(deepest, 0.0)
    return distance


def box_approach(start: Floats, end: Floats, boxes: Floats) -> tuple[Floats, Floats]:
    """As :func:`closest_approach`, for the signed distance to boxes.

    That distance is convex along a chord, so its minimum lies next to the best of any grid of points: a search in ever
    finer grids brackets it without fail.
    """
    lower, width = np.zeros(start.shape[:-1]), 1.0
    for _ in range(_SECTION_ROUNDS):
        fraction = np.minimum(lower + width * _SECTIONS.reshape(-1, *[1] * lower.ndim), 1.0)
        distance = box_distance(start + fraction[..., None] * (end - start), boxes)
        best = np.take_along_axis(fraction, distance.argmin(axis=0)[None], axis=0)[0]
        width /= (len(_SECTIONS) - 1) / 2
        lower = np.maximum(best - width / 2, 0.0)
    return distance.min(axis=0), best
