"""Polygons in the plane: whether one is simple, which way round it goes, and the triangles that it is made of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, Floats

_PAIRS_AT_ONCE = 2**20


def check_polygon(corners: FloatArray, name: str) -> None:
    """Refuse what is no simple polygon.

    Args:
        corners: ``(v, 2)`` in order, either way round; the last is joined to the first.
        name: What messages call it.

    Raises:
        ValueError: For fewer than three corners, two corners in one place, edges that meet elsewhere than at the corner
            they share, or no area.
    """
    if len(corners) < 3:
        raise ValueError(f"{name} has {len(corners)} corners; a polygon needs three or more")
    points = corners.astype(np.float64)
    after = np.roll(points, -1, axis=0)
    same = np.flatnonzero((points == after).all(axis=1))
    if len(same):
        raise ValueError(f"{name}: corner {same[0]} and the one after it are both at {corners[same[0]].tolist()}")
    crossing = _first_crossing(points, after)
    if crossing is not None:
        one, other = crossing
        raise ValueError(
            f"{name}: the edges from corner {one} and from corner {other} cross or touch; list the corners in order "
            "round the outside, or use several polygons"
        )


def triangulate(corners: FloatArray) -> NDArray[np.intp]:
    """``(v - 2, 3)`` corners of counterclockwise triangles that fill a simple polygon; fewer where some lie in line.

    By cutting off ears (G. H. Meisters, "Polygons Have Ears", American Mathematical Monthly, 1975).

    Args:
        corners: ``(v, 2)``.
    """
    points = corners.astype(np.float64)
    ring = list(range(len(points)))
    if float(_cross(points, np.roll(points, -1, axis=0)).sum()) < 0:
        ring.reverse()
    triangles = []
    while len(ring) > 3:
        ear, area = _find_ear(points[ring])
        if area > 0:
            triangles.append([ring[ear - 1], ring[ear], ring[(ear + 1) % len(ring)]])
        del ring[ear]
    return np.array([*triangles, ring])


def _cross(a: Floats, b: Floats) -> Floats:
    product: Floats = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


def _find_ear(ring: Floats) -> tuple[int, float]:
    """A corner of a counterclockwise ring that can be cut off, and twice the area that goes with it."""
    before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
    turn = _cross(ring - before, after - ring)
    flat = np.flatnonzero(turn == 0)
    if len(flat):
        return int(flat[0]), 0.0
    others, order = np.flatnonzero(turn < 0), np.argsort(-turn, kind="stable")
    for ear in order[: np.count_nonzero(turn > 0)]:
        a, b, c = before[ear], ring[ear], after[ear]
        rest = ring[others[(others != (ear - 1) % len(ring)) & (others != (ear + 1) % len(ring))]]
        inside = (_cross(b - a, rest - a) >= 0) & (_cross(c - b, rest - b) >= 0) & (_cross(a - c, rest - c) >= 0)
        if not inside.any():
            return int(ear), float(turn[ear])
    # Only rounding can hide the ears that every simple polygon has.
    return int(order[0]), float(turn[order[0]])


def _first_crossing(begin: Floats, end: Floats) -> tuple[int, int] | None:
    """The first two edges that have a point in common, but for the corner that neighbours share."""
    count = len(begin)
    rows = max(1, _PAIRS_AT_ONCE // count)
    for first in range(0, count, rows):
        one = np.arange(first, min(first + rows, count))[:, None]
        other = np.arange(count)[None]
        a, b, c, d = begin[one], end[one], begin[other], end[other]
        sides = [_cross(b - a, c - a), _cross(b - a, d - a), _cross(d - c, a - c), _cross(d - c, b - c)]
        overlap = (
            np.maximum(np.minimum(a, b), np.minimum(c, d)) <= np.minimum(np.maximum(a, b), np.maximum(c, d))
        ).all(-1)
        apart = (np.sign(sides[0]) * np.sign(sides[1]) > 0) | (np.sign(sides[2]) * np.sign(sides[3]) > 0)
        meet = overlap & ~apart
        # Neighbours meet in their corner; they fold back on each other if they are parallel and not on either side.
        back = (sides[1] == 0) & (((b - a) * (d - c)).sum(axis=-1) < 0)
        meet = np.where(other == (one + 1) % count, back, np.where(one == (other + 1) % count, False, meet))
        found = np.argwhere(meet & (other != one))
        if len(found):
            return int(first + found[0, 0]), int(found[0, 1])
    return None
