"""Polygons in the plane: whether one is simple, which way round it goes, and the triangles that it is made of."""

from __future__ import annotations

from heapq import heapify, heappop, heappush

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.geometry.simple_polygon import first_crossing

MAX_CORNERS, MAX_ALL_CORNERS = 2_000, 30_000
"""Limits of one polygon, as of a way of OpenStreetMap, for its triangulation may take quadratic time; and of all."""


def check_polygon(corners: FloatArray, name: str) -> None:
    """Refuse what is no simple polygon.

    Args:
        corners: ``(v, 2)`` in order, either way round; the last is joined to the first.
        name: Its name in messages.

    Raises:
        ValueError: For fewer than three or more than 2,000 corners, two corners in one place, edges that meet elsewhere
            than at the corner they share, or no area.
    """
    if len(corners) < 3:
        raise ValueError(f"{name} has {len(corners)} corners; a polygon needs three or more")
    if len(corners) > MAX_CORNERS:
        raise ValueError(
            f"{name} has {len(corners)} corners, and a polygon at most {MAX_CORNERS}; leave some out, or use "
            "several polygons"
        )
    same = np.flatnonzero((corners == np.roll(corners, -1, axis=0)).all(axis=1))
    if len(same):
        raise ValueError(f"{name}: corner {same[0]} and the one after it are both at {corners[same[0]].tolist()}")
    crossing = first_crossing([(x, y) for x, y in corners.tolist()])
    if crossing is not None:
        one, other = crossing
        raise ValueError(
            f"{name}: the edges from corner {one} and from corner {other} cross or touch; list the corners in order "
            "round the outside, or use several polygons"
        )


def triangulate(corners: FloatArray) -> NDArray[np.intp]:
    """``(v - 2, 3)`` corners of counterclockwise triangles that fill a simple polygon; fewer where some lie in line.

    By cutting off ears (G. H. Meisters, "Polygons Have Ears", American Mathematical Monthly, 1975), the largest first.

    Args:
        corners: ``(v, 2)``.
    """
    return np.array(_Ears(corners.astype(np.float64)).triangles())


class _Ears:
    """A counterclockwise ring of corners, from which ears are cut off one after another.

    A corner that is no ear, because another lies in its triangle, waits until that one is gone or no longer turns to
    the right, and is not looked at before.
    """

    def __init__(self, points: Floats) -> None:
        count = len(points)
        self._points, self._places = points, points.tolist()
        ring = list(range(count))
        if float(_cross(points, np.roll(points, -1, axis=0)).sum()) < 0:
            ring.reverse()
        self._ring = ring
        self._before = dict(zip(ring, ring[-1:] + ring[:-1], strict=True))
        self._after = dict(zip(ring, ring[1:] + ring[:1], strict=True))
        self._rank = dict(zip(ring, range(count), strict=True))
        self._turn = {corner: self._turn_at(corner) for corner in ring}
        self._reflex = np.array([self._turn[corner] < 0 for corner in range(count)])
        self._orders = [np.argsort(axis, kind="stable") for axis in points.T]
        self._sorted = [axis[order] for axis, order in zip(points.T, self._orders, strict=True)]
        self._waiting: dict[int, list[int]] = {}
        self._next = [self._entry(corner) for corner in ring if self._turn[corner] >= 0]
        heapify(self._next)

    def triangles(self) -> list[list[int]]:
        found = []
        while len(self._turn) > 3:
            ear = self._find_ear()
            around = self._before[ear], self._after[ear]
            if self._turn[ear] > 0:
                found.append([around[0], ear, around[1]])
            self._cut_off(ear, *around)
        return [*found, [corner for corner in self._ring if corner in self._turn]]

    def _entry(self, corner: int) -> tuple[float, int, int]:
        """Return the sort key: corners that lie in line, then large turns, then the order round the ring."""
        turn = self._turn[corner]
        return -turn if turn else -np.inf, self._rank[corner], corner

    def _turn_at(self, corner: int) -> float:
        """Twice the area of the triangle at a corner, negative where it turns to the right."""
        (ax, ay), (bx, by), (cx, cy) = (
            self._places[which] for which in (self._before[corner], corner, self._after[corner])
        )
        return (bx - ax) * (cy - by) - (by - ay) * (cx - bx)

    def _find_ear(self) -> int:
        while self._next:
            entry = heappop(self._next)
            corner = entry[2]
            if corner not in self._turn or entry != self._entry(corner):
                continue
            within = self._first_within(corner) if self._turn[corner] else None
            if within is None:
                return corner
            self._waiting.setdefault(within, []).append(corner)
        # Only rounding can hide the ears that every simple polygon has.
        return max(self._turn, key=lambda corner: (self._turn[corner], -self._rank[corner]))

    def _first_within(self, ear: int) -> int | None:
        """A corner that turns to the right and lies in the triangle at another."""
        around = self._before[ear], ear, self._after[ear]
        others = self._near(self._points[list(around)])
        others = others[self._reflex[others]]
        rest = self._points[others]
        inside = ~np.isin(others, around)
        for begin, end in zip(around, (*around[1:], around[0])):
            a, b = self._points[begin], self._points[end]
            inside &= _cross(b - a, rest - a) >= 0
        return int(others[np.argmax(inside)]) if inside.any() else None

    def _near(self, triangle: Floats) -> NDArray[np.intp]:
        """All corners with an x, or all with a y, such as a triangle has: the fewer."""
        few: NDArray[np.intp] | None = None
        for axis, order in enumerate(self._orders):
            low, high = triangle[:, axis].min(), triangle[:, axis].max()
            begin, end = self._sorted[axis].searchsorted(low), self._sorted[axis].searchsorted(high, "right")
            if few is None or end - begin < len(few):
                few = order[begin:end]
        assert few is not None
        return few

    def _cut_off(self, ear: int, before: int, after: int) -> None:
        self._after[before], self._before[after] = after, before
        del self._turn[ear]
        gone = [ear] if self._reflex[ear] else []
        self._reflex[ear] = False
        for corner in (before, after):
            self._turn[corner] = self._turn_at(corner)
            reflex = self._turn[corner] < 0
            if self._reflex[corner] and not reflex:
                gone.append(corner)
            self._reflex[corner] = reflex
            if not reflex:
                heappush(self._next, self._entry(corner))
        for corner in gone:
            for other in self._waiting.pop(corner, ()):
                if other in self._turn and self._turn[other] > 0:
                    heappush(self._next, self._entry(other))


def _cross(a: Floats, b: Floats) -> Floats:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
