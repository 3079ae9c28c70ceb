"""Test for simple polygons, by a sweep line in O(n log n) with exact arithmetic.

After M. I. Shamos and D. Hoey, "Geometric Intersection Problems", FOCS 1976. Corners are swept in the order of x, then
y, so that upright edges are no special case. What touches counts as crossing, but for neighbours in the corner that
they share.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from typing import TypeAlias

Corner: TypeAlias = tuple[float, float]

ROUNDING = 4e-16
"""Relative to the sum of its two products, more than the rounding error of an orientation (J. R. Shewchuk, "Adaptive
Precision Floating-Point Arithmetic", Discrete & Computational Geometry, 1997)."""


def first_crossing(corners: list[Corner]) -> tuple[int, int] | None:
    """Two edges of a polygon that meet elsewhere than in the corner that neighbours share, or ``None``.

    Args:
        corners: In order, the last joined to the first, each other than the next. Edge ``i`` begins at corner ``i``.

    Returns:
        The numbers of the two edges, the smaller first: those found first from the left.
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
        place, own = self._corners[corner], ((corner - 1) % self._count, corner)
        begins = [edge for edge in own if self._ends[edge][0] == place]
        below = self._first_not_below(place)
        above = below
        while above < len(self._met) and self._side(self._met[above], place) == 0:
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

    def _first_not_below(self, place: Corner) -> int:
        low, high = 0, len(self._met)
        while low < high:
            middle = (low + high) // 2
            if self._side(self._met[middle], place) > 0:
                low = middle + 1
            else:
                high = middle
        return low

    def _side(self, edge: int, place: Corner) -> int:
        """1 if a place is above an edge, -1 if it is below."""
        return orientation(*self._ends[edge], place)

    def _meet(self, one: int, other: int) -> bool:
        """Check whether two edges have a point in common, but for the corner of neighbours: these show at a corner."""
        if (one - other) % self._count in (1, self._count - 1):
            return False
        (a, b), (c, d) = self._ends[one], self._ends[other]
        first, second = self._side(one, c), self._side(one, d)
        if first == second == 0:
            return max(a, c) <= min(b, d)
        return first * second <= 0 and self._side(other, a) * self._side(other, b) <= 0
