"""Obstacles as two tables: rounded boxes and triangles.

A rounded box is whatever comes within a radius of a box: a circle or a sphere is one of no size, an upright cylinder is
one without end, and a box has the radius zero. Polygons are cut into triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, Floats, IntArray


@dataclass(frozen=True, eq=False)
class Shapes:
    """The obstacles of a world of dimension ``d``, numbered through: first the rounded boxes, then the triangles."""

    boxes: FloatArray  #: ``(B, 2 d + 1)`` float32 lower corner, upper corner, radius [m]; corners may be infinitely far
    triangles: FloatArray  #: ``(T, 6)`` float32 corners ``x, y, x, y, x, y``, counterclockwise [m]; none in space

    @property
    def dimension(self) -> int:
        """``d``."""
        return self.boxes.shape[1] // 2

    @property
    def count(self) -> int:
        """Number of shapes."""
        return len(self.boxes) + len(self.triangles)

    @cached_property
    def _columns(self) -> Floats:
        """``(2 d + 1, B)`` the boxes, one number of all of them after another."""
        return self.boxes.T.astype(np.float64)

    def corners(self) -> tuple[Floats, Floats]:
        """``(S, d)`` lowest and highest corners of boxes around each [m]."""
        d = self.dimension
        boxes, triangles = self.boxes.astype(np.float64), self.triangles.astype(np.float64).reshape(-1, 3, 2)
        low, high = boxes[:, :d] - boxes[:, 2 * d :], boxes[:, d : 2 * d] + boxes[:, 2 * d :]
        if not len(triangles):
            return low, high
        return np.concatenate([low, triangles.min(axis=1)]), np.concatenate([high, triangles.max(axis=1)])

    def extent(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner of all, zero along an axis where none of them ends; there must be some."""
        corners = np.concatenate(self.corners())
        finite = np.isfinite(corners)
        lowest = np.where(finite, corners, np.inf).min(axis=0)
        highest = np.where(finite, corners, -np.inf).max(axis=0)
        ends = finite.any(axis=0)
        return np.where(ends, lowest, 0.0), np.where(ends, highest, 0.0)

    def within(self, points: Floats, max_distance: float) -> tuple[IntArray, IntArray]:
        """Pairs ``(P,)``, ``(P,)`` of points ``(N, d)`` and obstacles, among them all within ``max_distance`` [m]."""
        low, high = self.corners()
        pairs = np.ones((len(points), len(low)), bool)
        for axis in range(self.dimension):
            position = points[:, axis, None]
            pairs &= (position >= low[:, axis] - max_distance) & (position <= high[:, axis] + max_distance)
        rows, items = pairs.nonzero()
        return rows, items

    def signed_distance(self, points: Floats, items: NDArray[np.int64]) -> Floats:
        """``(N,)`` distance from points ``(N, d)`` to the surface of the obstacle of each's number, negative inside
        [m].
        """
        if not len(self.triangles):
            return _box_distance(points, self._columns, items)
        distance, angular = np.empty(len(points)), items >= len(self.boxes)
        distance[~angular] = _box_distance(points[~angular], self._columns, items[~angular])
        corners = self.triangles[items[angular] - len(self.boxes)].astype(np.float64)
        distance[angular] = _triangle_distance(points[angular], corners)
        return distance

    def box_slope(self, points: Floats, items: NDArray[np.int64]) -> Floats:
        """``(N, d)`` a gradient of the distance from each point to the rounded box of that number."""
        boxes, d = self.boxes[items].astype(np.float64), self.dimension
        below, above = boxes[:, :d] - points, points - boxes[:, d : 2 * d]
        outside = np.maximum(below, above)
        # Within a box its nearest face decides.
        nearest_face = np.arange(d) == outside.argmax(axis=1)[:, None]
        beyond = outside.max(axis=1, keepdims=True) > 0
        away = np.where(beyond, np.maximum(outside, 0.0), nearest_face)
        return np.where(above > below, away, -away) / np.linalg.norm(away, axis=1)[:, None]


def _box_distance(points: Floats, columns: Floats, items: IntArray) -> Floats:
    d = points.shape[1]
    square, deepest = np.zeros(len(points)), np.full(len(points), -np.inf)
    for axis in range(d):
        x = points[:, axis]
        outside = columns[axis].take(items) - x
        np.maximum(outside, x - columns[d + axis].take(items), out=outside)
        np.maximum(deepest, outside, out=deepest)
        np.maximum(outside, 0.0, out=outside)
        outside *= outside
        square += outside
    distance: Floats = np.sqrt(square, out=square)
    distance += np.minimum(deepest, 0.0, out=deepest)
    distance -= columns[2 * d].take(items)
    return distance


def _triangle_distance(points: Floats, corners: Floats) -> Floats:
    nearest, inside = np.full(len(points), np.inf), np.ones(len(points), bool)
    for edge in range(3):
        begin, end = corners[:, 2 * edge : 2 * edge + 2], np.roll(corners, -2, axis=1)[:, 2 * edge : 2 * edge + 2]
        along, offset = end - begin, points - begin
        square = along[:, 0] * along[:, 0] + along[:, 1] * along[:, 1]
        share = np.clip((offset[:, 0] * along[:, 0] + offset[:, 1] * along[:, 1]) / square, 0.0, 1.0)
        x, y = offset[:, 0] - share * along[:, 0], offset[:, 1] - share * along[:, 1]
        nearest = np.minimum(nearest, x * x + y * y)
        inside &= along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0] >= 0
    return np.where(inside, -1.0, 1.0) * np.sqrt(nearest)
