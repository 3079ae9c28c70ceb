"""Convex bodies, and lengths, closest approaches and gaps in float64, with the same bits on every processor.

Sums over components are written out: how NumPy's own reductions group them depends on the processor.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core import portable

if TYPE_CHECKING:
    from d4orm_env.core.team import Team

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

_SECTIONS = np.linspace(0.0, 1.0, 9)
_SECTION_ROUNDS = 14  # each narrows the bracket to a quarter: 4e-9 of the chord in the end


def dot(a: Floats, b: Floats) -> Floats:
    """Inner product over the last axis."""
    total: Floats = a[..., 0] * b[..., 0]
    for axis in range(1, a.shape[-1]):
        total = total + a[..., axis] * b[..., axis]
    return total


def norm(a: Floats) -> Floats:
    """Length over the last axis."""
    return np.sqrt(dot(a, a))


def closest_approach(start: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Smallest distance to the origin of points moving from ``start`` to ``end``, and the fraction of the way there."""
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
    return np.sqrt(square) + np.minimum(deepest, 0.0)


def box_approach(start: Floats, end: Floats, boxes: Floats) -> tuple[Floats, Floats]:
    """:func:`closest_approach` by the signed distance to boxes.

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


def segment_distance(points: Floats, begin: Floats, end: Floats) -> Floats:
    """Distance from points in the plane to a segment."""
    along, offset = end - begin, points - begin
    fraction = np.clip(dot(offset, along) / dot(along, along), 0.0, 1.0)
    return norm(offset - fraction[..., None] * along)


def polygon_distance(points: Floats, corners: Floats) -> Floats:
    """Signed distance from points ``(..., 2)`` to the outline of a simple polygon ``(v, 2)``, negative inside."""
    nearest, inside = np.full(points.shape[:-1], np.inf), np.zeros(points.shape[:-1], bool)
    x, y = points[..., 0], points[..., 1]
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        nearest = np.minimum(nearest, segment_distance(points, begin, end))
        # A ray to the right crosses the outline of what it starts inside of an odd number of times.
        spans = (begin[1] > y) != (end[1] > y)
        if begin[1] != end[1]:
            inside ^= spans & (x < begin[0] + (y - begin[1]) * (end[0] - begin[0]) / (end[1] - begin[1]))
    return np.where(inside, -nearest, nearest)


def polygon_approach(start: Floats, end: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """:func:`closest_approach` by the signed distance to a simple polygon; where a chord crosses its outline from
    outside to outside, zero at the crossing.
    """
    before, after = polygon_distance(start, corners), polygon_distance(end, corners)
    smallest, fraction = np.minimum(before, after), (after < before).astype(np.float64)
    move = end - start
    for one, other in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        # Two segments that do not cross are nearest to each other at an end of one of them.
        distance, at = closest_approach(start - one, end - one)
        closer = (distance < smallest) & (smallest > 0)
        smallest, fraction = np.where(closer, distance, smallest), np.where(closer, at, fraction)
        edge, offset = other - one, start - one
        turn = move[..., 0] * edge[1] - move[..., 1] * edge[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = (offset[..., 1] * edge[0] - offset[..., 0] * edge[1]) / turn
            along = (offset[..., 1] * move[..., 0] - offset[..., 0] * move[..., 1]) / turn
        crosses = (turn != 0) & (at >= 0) & (at <= 1) & (along >= 0) & (along <= 1) & (smallest > 0)
        smallest, fraction = np.where(crosses, 0.0, smallest), np.where(crosses, at, fraction)
    return smallest, fraction


@dataclass(frozen=True, eq=False)
class ConvexBodies:
    """Convex bodies, one row each."""

    corners: Floats  #: ``(B, n, 2)`` of planar cores, the last one repeated; of no use in space
    rounding: Floats  #: ``(B,)``
    semi_axes: Floats  #: ``(B, 3)`` in space
    wall_axes: Floats  #: ``(B, 3)`` of what obstacles and bounds meet in space
    outer: Floats  #: ``(B,)`` radii of the discs or balls round them
    stretch: Floats  #: ``(B,)`` how much faster a gap may change than a body moves

    @classmethod
    def of(cls, team: Team) -> ConvexBodies:
        """The footprints of a team: of its robots, and then of their trailers."""
        bodies: list[Any] = [getattr(footprint, "front", footprint) for footprint in team.footprint]
        bodies += [trailer for footprint in team.footprint for trailer in getattr(footprint, "trailers", ())]
        size, most = len(bodies), 1 if team.dimension == 3 else max(len(footprint.core[0]) for footprint in bodies)
        corners, rounding, (semi_axes, wall_axes) = np.zeros((size, most, 2)), np.zeros(size), np.ones((2, size, 3))
        for robot, footprint in enumerate(bodies):
            if team.dimension == 3:
                semi_axes[robot] = footprint.semi_axes
                body = getattr(footprint, "body", None)
                wall_axes[robot] = footprint.semi_axes if body is None else body
                continue
            own, rounding[robot] = footprint.core
            corners[robot, : len(own)], corners[robot, len(own) :] = own, own[-1]
        outer = np.array([footprint.outer_radius for footprint in bodies]).astype(np.float32).astype(np.float64)
        return cls(corners, rounding, semi_axes, wall_axes, outer, semi_axes.max(axis=1) / semi_axes.min(axis=1))

    def take(self, index: Indices) -> ConvexBodies:
        """Some of them, in the order given."""
        return ConvexBodies(*(getattr(self, field.name)[index] for field in fields(self)))

    def at_walls(self) -> ConvexBodies:
        """Return the bodies in space as obstacles and bounds meet them."""
        axes, outer = self.wall_axes, self.wall_axes.max(axis=1).astype(np.float32).astype(np.float64)
        return replace(self, semi_axes=axes, outer=outer, stretch=axes.max(axis=1) / axes.min(axis=1))

    def placed(self, index: Indices, position: Floats, turn: Floats) -> Floats:
        """``(N, n, 2)`` corners of bodies at positions ``(N, 2)`` turned by ``(N,)``."""
        sine, cosine = (part[:, None] for part in portable.sin_cos(turn))
        x, y = self.corners[index, :, 0], self.corners[index, :, 1]
        return position[:, None] + np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


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
    golden, best = (np.sqrt(5.0) - 1) / 2, np.full(len(offset), 0.5)  # it is the best of two that are alike
    alike = bool((a == b).all())
    if not alike:
        tried = np.stack([value(np.full(len(offset), weight)) for weight in WEIGHTS])
        best = WEIGHTS[tried.argmax(axis=0)]
    low, high = (best, best) if alike else (best - width, best + width)
    for _ in range(0 if alike else GOLDEN_STEPS):
        left, right = high - golden * (high - low), low + golden * (high - low)
        rising = value(left) < value(right)
        low, high = np.where(rising, left, low), np.where(rising, high, right)
    factor = np.sqrt(np.maximum(value((low + high) / 2), 1e-12))
    return np.maximum(norm(offset) * (1 - 1 / factor), -np.minimum(a.min(axis=1), b.min(axis=1)))
