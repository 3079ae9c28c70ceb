"""Polygons in the plane: a check that they are simple, and the triangles that fill them.

The check is a sweep line in O(n log n) with exact arithmetic, after M. I. Shamos and D. Hoey, "Geometric Intersection
Problems", FOCS 1976. Corners are swept in the order of x, then y, so that upright edges are no special case. What
touches counts as crossing, but for neighbours in the corner that they share.
"""

from __future__ import annotations

from bisect import bisect_left
from fractions import Fraction
from heapq import heapify, heappop, heappush
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, Floats

MAX_CORNERS, MAX_ALL_CORNERS = 2_000, 30_000
"""Limits of one polygon, as of a way of OpenStreetMap, for its triangulation may take quadratic time; and of all."""


THIN = 1e-6
"""Height up to which a triangle is left out, as a share of the largest coordinate: some roundings of float32."""


def check_polygon(corners: FloatArray, name: str) -> None:
    """Refuse corners ``(v, 2)`` in order, either way round, that are those of no simple polygon."""
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
    """``(v - 2, 3)`` corners of counterclockwise triangles that fill a simple polygon, fewer where some lie in line.

    Triangles so thin that rounding decides what is inside are left out. By cutting off ears (G. H. Meisters, "Polygons
    Have Ears", American Mathematical Monthly, 1975), the largest first.
    """
    return np.array(_Ears(corners.astype(np.float64)).triangles())


class _Ears:
    """A counterclockwise ring of corners, from which ears are cut off one after another.

    A corner that is no ear, because another lies in its triangle, waits until that one is gone or no longer turns to
    the right, and is not looked at before.
    """

    def __init__(self, points: Floats) -> None:
        count = len(points)
        self._points, self._positions = points, points.tolist()
        self._thin = THIN * float(np.abs(points).max())
        ring = list(range(count))
        if float(_cross(points, np.roll(points, -1, axis=0)).sum()) < 0:
            ring.reverse()
        self._ring = ring
        self._before = dict(zip(ring, ring[-1:] + ring[:-1], strict=True))
        self._after = dict(zip(ring, ring[1:] + ring[:1], strict=True))
        self._rank = dict(zip(ring, range(count), strict=True))
        self._turn = {corner: self._turn_at(corner) for corner in ring}
        self._reflex = np.array([self._turn[corner] < 0 for corner in range(count)])
        self._waiting: dict[int, list[int]] = {}
        self._next = [self._entry(corner) for corner in ring if self._turn[corner] >= 0]
        heapify(self._next)

    def triangles(self) -> list[list[int]]:
        found = []
        while len(self._turn) > 3:
            ear = self._find_ear()
            around = self._before[ear], self._after[ear]
            found.append([around[0], ear, around[1]])
            self._cut_off(ear, *around)
        found.append([corner for corner in self._ring if corner in self._turn])
        height = self._heights(found)
        return [triangle for triangle, thick in zip(found, (height > self._thin) | (height == height.max())) if thick]

    def _heights(self, triangles: list[list[int]]) -> Floats:
        """The least height of each triangle, negative where its corners lie clockwise."""
        a, b, c = np.moveaxis(self._points[np.array(triangles)], 1, 0)
        longest = np.max([np.hypot(*(end - begin).T) for begin, end in ((a, b), (b, c), (c, a))], axis=0)
        return _cross(b - a, c - a) / longest

    def _entry(self, corner: int) -> tuple[float, int, int]:
        """Return the sort key: corners that lie in line, then large turns, then the order round the ring."""
        turn = self._turn[corner]
        return -turn if turn else -np.inf, self._rank[corner], corner

    def _turn_at(self, corner: int) -> float:
        """Twice the area of the triangle at a corner, negative where it turns to the right."""
        (ax, ay), (bx, by), (cx, cy) = (
            self._positions[which] for which in (self._before[corner], corner, self._after[corner])
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
        others = np.flatnonzero(self._reflex)
        rest = self._points[others]
        inside = ~np.isin(others, around)
        for begin, end in zip(around, (*around[1:], around[0])):
            a, b = self._points[begin], self._points[end]
            inside &= _cross(b - a, rest - a) >= 0
        return int(others[np.argmax(inside)]) if inside.any() else None

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


Corner: TypeAlias = tuple[float, float]

ROUNDING = 4e-16
"""Relative to the sum of its two products, more than the rounding error of an orientation (J. R. Shewchuk, "Adaptive
Precision Floating-Point Arithmetic", Discrete & Computational Geometry, 1997)."""


def first_crossing(corners: list[Corner]) -> tuple[int, int] | None:
    """The numbers of two edges that meet elsewhere than in the corner that neighbours share, or ``None``.

    They are those found first from the left, the smaller first. Edge ``i`` begins at corner ``i``, each other than the
    next.
    """
    pair = _Sweep(corners).run()
    return None if pair is None else (min(pair), max(pair))


def orientation(a: Corner, b: Corner, c: Corner) -> int:
    """1 if ``c`` is to the left of the line from ``a`` to ``b``, -1 if to the right, 0 if on it, exactly."""
    left, right = (b[0] - a[0]) * (c[1] - a[1]), (b[1] - a[1]) * (c[0] - a[0])
    area, error = left - right, ROUNDING * (abs(left) + abs(right))
    if abs(area) > error or error == 0:
        return (area > 0) - (area < 0)
    (ax, ay), (bx, by), (cx, cy) = ((Fraction(x), Fraction(y)) for x, y in (a, b, c))
    exact = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    return (exact > 0) - (exact < 0)


class _Sweep:
    """The edges that the sweep line meets, from the lowest to the highest."""

    def __init__(self, corners: list[Corner]) -> None:
        self._corners, self._count = corners, len(corners)
        ends = zip(corners, corners[1:] + corners[:1], strict=True)
        self._ends = [(a, b) if a < b else (b, a) for a, b in ends]
        self._met: list[int] = []

    def run(self) -> tuple[int, int] | None:
        order = sorted(range(self._count), key=lambda corner: (self._corners[corner], corner))
        for one, other in pairwise(order):
            if self._corners[one] == self._corners[other]:
                return one, other
        for corner in order:
            found = self._pass(corner)
            if found is not None:
                return found
        return None

    def _pass(self, corner: int) -> tuple[int, int] | None:
        """Move the line over a corner; a pair of edges that meet where they must not, if that shows one."""
        position, own = self._corners[corner], ((corner - 1) % self._count, corner)
        begins = [edge for edge in own if self._ends[edge][0] == position]
        below = bisect_left(self._met, 0, key=lambda edge: -self._side(edge, position))
        above = below
        while above < len(self._met) and self._side(self._met[above], position) == 0:
            if self._met[above] not in own:
                return self._met[above], corner
            above += 1
        if len(begins) == 2:
            turn = self._side(begins[0], self._ends[begins[1]][1])
            if turn == 0:
                return own
            if turn < 0:
                begins.reverse()
        self._met[below:above] = begins
        above = below + len(begins)
        for index in sorted({below, above}):
            if 0 < index < len(self._met) and self._meet(self._met[index - 1], self._met[index]):
                return self._met[index - 1], self._met[index]
        return None

    def _side(self, edge: int, position: Corner) -> int:
        """1 if a position is above an edge, -1 if it is below."""
        return orientation(*self._ends[edge], position)

    def _meet(self, one: int, other: int) -> bool:
        """Check whether two edges have a point in common, but for the corner of neighbours: these show at a corner."""
        if (one - other) % self._count in (1, self._count - 1):
            return False
        (a, b), (c, d) = self._ends[one], self._ends[other]
        first, second = self._side(one, c), self._side(one, d)
        if first == second == 0:
            return max(a, c) <= min(b, d)
        return first * second <= 0 and self._side(other, a) * self._side(other, b) <= 0
