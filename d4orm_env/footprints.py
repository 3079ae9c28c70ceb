"""Footprints of robots: the part of the plane, or of space, that a robot covers round its reference point.

A planar footprint is a convex core, a point, a segment or a polygon, widened by a rounding radius. It turns with the
heading of the robot; a robot without a heading keeps it along x. All lengths are metres, in the robot's frame.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import LARGEST, SMALLEST, Floats, numbers_of, positive_number, real_number, short_repr

__all__ = ["Box", "Capsule", "Disc", "Ellipsoid", "Footprint", "Polygon", "Train"]

MAX_CORNERS = 8
"""Most corners of a polygon."""

_ANGLES = np.linspace(0, 2 * np.pi, 64, endpoint=False)
DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""``(64, 2)`` unit vectors all round."""


def _lengths(vectors: Floats) -> Floats:
    """``(n,)`` lengths of ``(n, 2)``, with the same bits on every processor, which ``hypot`` has not."""
    return np.sqrt(vectors[:, 0] * vectors[:, 0] + vectors[:, 1] * vectors[:, 1])


class Core(NamedTuple):
    """A footprint's convex core and how far it is widened."""

    corners: Floats  #: ``(n, 2)`` float64, counterclockwise; one for a point, two for a segment
    rounding: float  #: Distance by which the core is widened [m]

    @property
    def axes(self) -> tuple[Floats, Floats]:
        """``(m, 2)`` unit vectors along which cores are tested for a gap, and how far the core extends along each.

        Those of a polygon are normal to its edges, outward; a segment has its ends' too, a point has none.
        """
        corners = self.corners
        if len(corners) == 1:
            return np.zeros((0, 2)), np.zeros(0)
        edges = np.roll(corners, -1, axis=0) - corners
        edges /= _lengths(edges)[:, None]
        axes = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        axes = np.concatenate([axes, edges]) if len(corners) == 2 else axes
        return axes, (axes[:, None] * corners).sum(axis=2).max(axis=1)


class Footprint(ABC):
    """The region that a robot covers, in its own frame."""

    dimension: int = 2
    """Dimensions of the space it lies in; a disc is a ball in space."""

    @property
    @abstractmethod
    def outer_radius(self) -> float:
        """Radius of the smallest disc or ball about the reference point that holds it [m]."""

    @property
    def inner_radius(self) -> float:
        """Radius of the largest disc or ball about the reference point within it, zero if there is none [m]."""
        return min(self.wall_axes)

    @property
    def girth(self) -> float:
        """Radius of the smallest upright cylinder about the reference point that holds it [m]."""
        return max(self.semi_axes[:2])

    @property
    def semi_axes(self) -> tuple[float, float, float]:
        """Semi-axes of the ball or ellipsoid that it is in space, along x, y and z [m]."""
        return self.outer_radius, self.outer_radius, self.outer_radius

    @property
    def wall_axes(self) -> tuple[float, float, float]:
        """The same of what obstacles and bounds meet."""
        return self.semi_axes

    @property
    def wall_radius(self) -> float:
        """Outer radius of what obstacles and bounds meet [m]."""
        return max(self.wall_axes)

    @abstractmethod
    def outline(self) -> Floats:
        """``(n, 2)`` points round it, counterclockwise, seen from above [m]: to draw it."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():  # type: ignore[call-overload] # all are dataclasses
            if value is None:
                continue
            title = f"{name} of {type(self).__name__}"
            number = real_number(value, title)
            if name != "offset":
                positive_number(number, title, least=SMALLEST, most=LARGEST)
            elif not abs(number) <= LARGEST:
                raise ValueError(f"{title} is {number:g}; it must be at most {LARGEST:g} m in magnitude")
            object.__setattr__(self, name, number)  # one kind of number in files and comparisons


class Planar(Footprint):
    """A footprint in the plane, which turns with the robot."""

    def outline(self) -> Floats:
        corners, rounding = self.core
        return corners[(DIRECTIONS @ corners.T).argmax(axis=1)] + rounding * DIRECTIONS

    @property
    @abstractmethod
    def core(self) -> Core:
        """Its convex core."""

    @property
    def outer_radius(self) -> float:
        corners, rounding = self.core
        return float(_lengths(corners).max()) + rounding

    @property
    def inner_radius(self) -> float:
        return max(0.0, self.core.rounding + float(self.core.axes[1].min()))


@dataclass(frozen=True)
class Disc(Planar):
    """A disc, or a ball in space."""

    radius: float  #: Radius [m]

    @property
    def core(self) -> Core:
        """The centre, widened by the radius."""
        return Core(np.zeros((1, 2)), self.radius)

    @property
    def outer_radius(self) -> float:
        return self.radius

    @property
    def inner_radius(self) -> float:
        return self.radius


@dataclass(frozen=True)
class Box(Planar):
    """A rectangle, its length along the heading."""

    length: float  #: Along the heading [m]
    width: float  #: Across it [m]
    #: How far ahead of the reference point its centre lies [m]; half of the length less the rear overhang for a car,
    #: whose reference point is its rear axle
    offset: float = 0.0

    @property
    def core(self) -> Core:
        """Its four corners."""
        front, back, side = self.offset + self.length / 2, self.offset - self.length / 2, self.width / 2
        return Core(np.array([[front, -side], [front, side], [back, side], [back, -side]]), 0.0)


@dataclass(frozen=True)
class Capsule(Planar):
    """A rectangle with round ends: all within a radius of a segment along the heading."""

    length: float  #: Length of the segment [m]; with both ends the capsule is longer by twice the radius
    radius: float  #: Half of its width [m]
    offset: float = 0.0  #: How far ahead of the reference point its centre lies [m]

    @property
    def core(self) -> Core:
        """Its segment."""
        return Core(np.array([[self.offset - self.length / 2, 0.0], [self.offset + self.length / 2, 0.0]]), self.radius)


@dataclass(frozen=True)
class Polygon(Planar):
    """A convex polygon.

    Raises:
        ValueError: If there are fewer or more, two coincide, or the polygon is not convex.
    """

    #: ``(n, 2)``, three to eight corners in order, either way round, x along the heading [m]
    corners: tuple[tuple[float, float], ...]

    def __init__(self, corners: ArrayLike) -> None:
        table: Floats = numbers_of(corners, "corners of Polygon must be rows of two numbers", np.float64)
        if table.ndim != 2 or table.shape[1] != 2 or not 3 <= len(table) <= MAX_CORNERS:
            raise ValueError(f"corners of Polygon have shape {table.shape}; expected (n, 2), n from 3 to {MAX_CORNERS}")
        if not np.isfinite(table).all() or np.abs(table).max() > LARGEST:
            raise ValueError(f"corners of Polygon must be finite and at most {LARGEST:g} in magnitude")
        edges = np.roll(table, -1, axis=0) - table
        turns = edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(edges[:, 0], -1)
        # A star turns one way at every corner too, but more than once round.
        headings = np.arctan2(edges[:, 1], edges[:, 0])
        round_trip = np.abs(np.sum((np.roll(headings, -1) - headings + np.pi) % (2 * np.pi) - np.pi))
        if not ((turns > 0).all() or (turns < 0).all()) or round_trip > 3 * np.pi:
            corner = int(np.argmax(turns * np.sign(turns.sum()) <= 0) + 1) % len(table)
            raise ValueError(
                f"Polygon is not convex at corner {corner}, {table[corner].tolist()}; give the corners of its convex "
                f"hull, in order and each once"
            )
        object.__setattr__(self, "corners", tuple(map(tuple, (table if turns[0] > 0 else table[::-1]).tolist())))

    @property
    def core(self) -> Core:
        """Its corners."""
        return Core(np.array(self.corners), 0.0)


@dataclass(frozen=True, repr=False)
class Ellipsoid(Footprint):
    """An ellipsoid in space, its axes along those of the world: the room that a multirotor's downwash needs.

    With a ``body``, the ellipsoid is for other robots only, whatever their footprints. Obstacles, moving ones too, and
    bounds meet the ball of that radius.

    Raises:
        ValueError: If a size is no positive number, or the body is larger than a semi-axis.
    """

    x: float  #: Semi-axis along x [m]
    y: float  #: Semi-axis along y [m]
    z: float  #: Semi-axis along z [m]
    #: Radius of the ball in it that obstacles and bounds meet [m]; ``None`` if they meet the ellipsoid
    body: float | None = None
    dimension = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.body is not None and self.body > min(self.semi_axes):
            raise ValueError(
                f"body of Ellipsoid is {self.body:g}; its ball must be within the ellipsoid, {min(self.semi_axes):g} "
                "at most"
            )

    def __repr__(self) -> str:
        # Without a body as it was before there were any: digests of problems are made of it.
        body = "" if self.body is None else f", body={self.body!r}"
        return f"Ellipsoid(x={self.x!r}, y={self.y!r}, z={self.z!r}{body})"

    @property
    def semi_axes(self) -> tuple[float, float, float]:
        return self.x, self.y, self.z

    @property
    def wall_axes(self) -> tuple[float, float, float]:
        return self.semi_axes if self.body is None else (self.body, self.body, self.body)

    def outline(self) -> Floats:
        return DIRECTIONS * (self.x, self.y)

    @property
    def outer_radius(self) -> float:
        return max(self.semi_axes)


@dataclass(frozen=True, init=False)
class Train(Footprint):
    """A robot with trailers, each a planar footprint about its own reference point: a trailer's axle.

    Raises:
        ValueError: If one of them is no planar footprint, or the trailers are none or no sequence.
    """

    front: Planar  #: Of the robot itself
    trailers: tuple[Planar, ...]  #: From the front on

    def __init__(self, front: Planar, trailers: Sequence[Planar]) -> None:
        if isinstance(trailers, str) or not isinstance(trailers, Sequence):
            raise ValueError(f"trailers of Train are {short_repr(trailers)}; give a list of footprints, one each")
        for footprint in (front, *trailers):
            if not isinstance(footprint, Planar):
                raise ValueError(
                    f"Train is made of planar footprints such as Box(0.5, 0.25), not {short_repr(footprint)}"
                )
        if not trailers:
            raise ValueError("trailers of Train are none; give one footprint each, or leave Train out")
        object.__setattr__(self, "front", front)
        object.__setattr__(self, "trailers", tuple(trailers))

    @property
    def outer_radius(self) -> float:
        """That of the front; :attr:`Team.radius` includes the trailers."""
        return self.front.outer_radius

    @property
    def inner_radius(self) -> float:
        return self.front.inner_radius

    def outline(self) -> Floats:
        return self.front.outline()
