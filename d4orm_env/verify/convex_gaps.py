"""Gaps between convex bodies in float64: cores of polygons in the plane, ellipsoids in space."""

from __future__ import annotations

import numpy as np

from d4orm_env.verify.geometry import Floats, dot, norm

WEIGHTS, GOLDEN_STEPS = np.linspace(0.0, 1.0, 33)[1:-1], 48
"""Weights of two ellipsoids between which the best is bracketed, and golden sections that narrow it."""


def core_gap(a: Floats, b: Floats) -> Floats:
    """``(N,)`` signed gaps of convex cores ``(N, n, 2)`` and ``(N, m, 2)``, counterclockwise; corners may repeat."""
    apart = np.maximum(_separation(a, b), _separation(b, a))
    distance = np.minimum(_corner_distance(a, b), _corner_distance(b, a))
    return np.where((apart <= 0) & (apart > -np.inf), apart, distance)


def _separation(a: Floats, b: Floats) -> Floats:
    """``(N,)`` the most by which an edge of ``a``, or an end of a segment, has all of ``b`` before it."""
    edges = np.roll(a, -1, axis=1) - a
    length = norm(edges)
    # A segment has an edge there and one back.
    segment = (length > 0).sum(axis=1) == 2
    most = np.full(len(a), -np.inf)
    for i in range(a.shape[1]):
        unit = edges[:, i] / np.where(length[:, i] > 0, length[:, i], 1.0)[:, None]
        normal = np.stack([unit[:, 1], -unit[:, 0]], axis=-1)
        for axis, corner, counts in ((normal, a[:, i], length[:, i] > 0),
                                     (-unit, a[:, i], segment & (length[:, i] > 0))):  # fmt: skip
            before = dot(b - corner[:, None], axis[:, None]).min(axis=1)
            most = np.where(counts, np.maximum(most, before), most)
    return most


def _corner_distance(a: Floats, b: Floats) -> Floats:
    """``(N,)`` least distance from a corner of ``a`` to an edge of ``b``."""
    least = np.full(len(a), np.inf)
    for j in range(b.shape[1]):
        begin, along = b[:, j], b[:, (j + 1) % b.shape[1]] - b[:, j]
        offset, square = a - begin[:, None], dot(along, along)
        share = np.clip(dot(offset, along[:, None]) / np.where(square > 0, square, 1.0)[:, None], 0.0, 1.0)
        least = np.minimum(least, norm(offset - share[..., None] * along[:, None]).min(axis=1))
    return least


def ball_gap(offset: Floats, a: Floats, b: Floats) -> Floats:
    """``(N,)`` gap of two ellipsoids along the line of their centres, of these semi-axes ``(N, 3)``.

    The factor by which both must grow to touch is the square root of the maximum of a concave function of a weight
    (Perram and Wertheim, 1985).
    """
    square, a2, b2 = offset * offset, a * a, b * b

    def value(s: Floats) -> Floats:
        s = s[..., None]
        parts = s * (1 - s) * square / ((1 - s) * a2 + s * b2)
        return parts[..., 0] + parts[..., 1] + parts[..., 2]

    width = WEIGHTS[1] - WEIGHTS[0]
    tried = np.stack([value(np.full(len(offset), weight)) for weight in WEIGHTS])
    best = WEIGHTS[tried.argmax(axis=0)]
    low, high = best - width, best + width
    golden = (np.sqrt(5.0) - 1) / 2
    for _ in range(GOLDEN_STEPS):
        left, right = high - golden * (high - low), low + golden * (high - low)
        rising = value(left) < value(right)
        low, high = np.where(rising, left, low), np.where(rising, high, right)
    factor = np.sqrt(np.maximum(value((low + high) / 2), 1e-12))
    return np.maximum(norm(offset) * (1 - 1 / factor), -np.minimum(a.min(axis=1), b.min(axis=1)))
