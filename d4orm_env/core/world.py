"""The static world: obstacles and bounds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import (
    LARGEST,
    SMALLEST,
    FloatArray,
    Floats,
    Frozen,
    frozen_array,
    numbers_of,
    read_only,
    short_repr,
)
from d4orm_env.geometry.polygon import MAX_ALL_CORNERS, check_polygon, triangulate
from d4orm_env.geometry.shapes import Shapes
from d4orm_env.geometry.world_index import WorldIndex, build_index, is_farther, nearest_distance

LARGEST_ORIGIN = 1e9
"""Largest coordinate of a world [m]: float64 resolves it to 1e-7."""

_LEVELS, _FEW = 3, 2048
"""Grids of an index that finds obstacles for robots wherever they drive, the last 16 times as wide as the first, where
there are no more than so many: with more it takes too long to make, and robots beyond the first grid look at all.
"""


@dataclass(frozen=True, eq=False, init=False)
class World(Frozen):
    """Obstacles and bounds of a planar or spatial world; all numbers are at most 1e6 in magnitude.

    Attributes:
        dimension: 2 or 3.
        circles: ``(., 3)`` centre x, y and radius [m]; planar worlds only.
        spheres: ``(., 4)`` centre x, y, z and radius [m]; spatial worlds only.
        cylinders: ``(., 3)`` axis x, y and radius [m], vertical and unbounded in z; spatial worlds only.
        boxes: ``(., 2 * dimension)`` lower corner, then upper corner [m], axis-aligned.
        polygons: Each ``(v, 2)`` corners in order, either way round [m]; simple, convex or not; planar worlds only. One
            has at most 2,000 corners, and all 30,000.
        lower: ``(dimension,)`` lower bounds of the world [m], or ``None`` for an open world.
        upper: ``(dimension,)`` upper bounds, given together with ``lower``.
        origin: ``(dimension,)`` float64, where zero lies in the coordinates that the world comes from, such as UTM [m].
            Everything here, and of a problem in this world, is relative to it; add it to what goes back there.

    Raises:
        ValueError: For a shape, radius, corner or bound that makes no sense; the message names it.
    """

    dimension: int
    circles: FloatArray
    spheres: FloatArray
    cylinders: FloatArray
    boxes: FloatArray
    polygons: tuple[FloatArray, ...]
    lower: FloatArray | None
    upper: FloatArray | None
    origin: Floats

    def __init__(
        self,
        dimension: int = 2,
        circles: ArrayLike = (),
        spheres: ArrayLike = (),
        cylinders: ArrayLike = (),
        boxes: ArrayLike = (),
        polygons: Sequence[ArrayLike] = (),
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        origin: ArrayLike | None = None,
    ) -> None:
        if not isinstance(dimension, int | np.integer) or dimension not in (2, 3):
            raise ValueError(f"dimension of the world is {short_repr(dimension)}; it must be 2 or 3")
        if (lower is None) != (upper is None):
            raise ValueError("bounds need both lower and upper; give both, or neither for an open world")
        lowest, highest = ([f"{end} {axis}" for axis in "xyz"[:dimension]] for end in ("least", "greatest"))
        rows = {
            "circles": (circles, ("x", "y", "radius")),
            "spheres": (spheres, ("x", "y", "z", "radius")),
            "cylinders": (cylinders, ("x", "y", "radius")),
            "boxes": (boxes, (*lowest, *highest)),
        }
        tables = {
            name: frozen_array(given, name, (None, len(columns)), largest=LARGEST, columns=columns)
            for name, (given, columns) in rows.items()
        }
        bounds = {
            name: None if given is None else frozen_array(given, f"bounds {name}", (dimension,), largest=LARGEST)
            for name, given in (("lower", lower), ("upper", upper))
        }
        corners = _polygons(polygons)
        origin = np.zeros(dimension) if origin is None else origin
        frozen_array(origin, "origin", (dimension,), largest=LARGEST_ORIGIN)
        # Adding zero makes -0.0 a plain zero.
        offset = np.array(origin, np.float64) + 0.0
        self._set(dimension=dimension, polygons=corners, origin=offset, **tables, **bounds)
        self._check()

    def _check(self) -> None:
        for name, dimension in (("circles", 2), ("spheres", 3), ("cylinders", 3)):
            round_obstacles = getattr(self, name)
            if len(round_obstacles) and self.dimension != dimension:
                raise ValueError(f"{name} need a world of dimension {dimension}, and this one has {self.dimension}")
            for index, radius in enumerate(round_obstacles[:, -1]):
                if radius <= 0:
                    raise ValueError(f"radius of {name}[{index}] is {radius:g}; it must be positive")
        d = self.dimension
        for index in np.flatnonzero((self.boxes[:, :d] >= self.boxes[:, d:]).any(axis=1))[:1].tolist():
            raise ValueError(
                f"boxes[{index}] is {self.boxes[index].tolist()}; its lower corner must lie below its upper corner"
            )
        if len(self.polygons) and self.dimension != 2:
            raise ValueError(f"polygons need a world of dimension 2, and this one has {self.dimension}")
        count = sum(map(len, self.polygons))
        if count > MAX_ALL_CORNERS:
            raise ValueError(f"polygons have {count} corners in all, and a world at most {MAX_ALL_CORNERS}; give fewer")
        for index, corners in enumerate(self.polygons):
            check_polygon(corners, f"polygons[{index}]")
        if self.lower is not None and self.upper is not None and (self.lower >= self.upper).any():
            raise ValueError(f"bounds lower {self.lower.tolist()} must lie below upper {self.upper.tolist()}")

    @property
    def num_obstacles(self) -> int:
        """Obstacles of all kinds, bounds not counted."""
        return sum(len(kind) for kind in (self.circles, self.spheres, self.cylinders, self.boxes, self.polygons))

    @property
    def balls(self) -> FloatArray:
        """``(., dimension + 1)`` the obstacles that are round in every dimension: circles, or spheres in space."""
        return self.circles if self.dimension == 2 else self.spheres

    @property
    def bounds(self) -> FloatArray:
        """``(2, dimension)`` lower and upper bounds; infinite in an open world."""
        if self.lower is None or self.upper is None:
            return np.array([[-np.inf] * self.dimension, [np.inf] * self.dimension], np.float32)
        return np.stack([self.lower, self.upper])

    def extremes(self) -> list[FloatArray]:
        """Return outermost points ``(., dimension)`` of obstacles and bounds, to bound distances to them."""
        d = self.dimension
        corners = [self.balls[:, :d] + sign * self.balls[:, d:] for sign in (-1, 1)]
        corners += [self.boxes[:, :d], self.boxes[:, d:], *self.polygons]
        if len(self.cylinders):
            xy = np.concatenate([self.cylinders[:, :2] + sign * self.cylinders[:, 2:] for sign in (-1, 1)])
            corners.append(np.concatenate([xy, np.zeros((len(xy), 1))], axis=1))
        return corners if self.lower is None else [*corners, self.bounds]

    @cached_property
    def triangles(self) -> tuple[tuple[tuple[int, ...], ...], ...]:
        """Triangles that fill each polygon, each three numbers of corners."""
        return tuple(tuple(map(tuple, triangulate(corners).tolist())) for corners in self.polygons)

    @cached_property
    def shapes(self) -> Shapes:
        """All obstacles as rounded boxes and triangles, in the order circles, spheres, cylinders, boxes, polygons."""
        return Shapes(*read_only(shape_tables(self, np)))

    @cached_property
    def _indices(self) -> dict[tuple[float, int, float, int, float], WorldIndex]:
        return {}

    def index(
        self, max_distance: float, nearest: int = 1, positions: FloatArray | None = None, within: float = 0.0
    ) -> WorldIndex:
        """The grid that finds obstacles, made once for distances of about the same size.

        Args:
            max_distance: The largest distance from an obstacle at which it counts [m].
            nearest: Number of nearest obstacles that it is to find.
            positions: ``(N, dimension)`` points round which it is to find them, however far from obstacles [m], and in
                wider grids farther away.
            within: Distance within which it is to find all obstacles, not only the nearest [m].
        """
        max_distance = margin = _rounded_up(max_distance)
        levels = 1
        if positions is not None and self.shapes.count:
            lower, upper = self.shapes.extent()
            margin = _rounded_up(max(max_distance, float(np.max([lower - positions, positions - upper]))))
            levels = _LEVELS if self.shapes.count <= _FEW else 1
        key = (max_distance, nearest, margin, levels, within)
        if key not in self._indices:
            # Cells of a quarter of the distance leave few points undecided, which pays for thousands of samples. Who
            # observes asks once per robot and time step, and in ever new worlds.
            cell = max_distance / 4 if positions is None else max_distance
            self._indices[key] = build_index(self.shapes, cell, margin, nearest, levels, within)
        return self._indices[key]

    def clearance(self, positions: ArrayLike) -> np.ndarray:
        """Distance from points to the nearest obstacle surface or bound, negative inside [m], in float64.

        Inside a polygon it is the distance to the nearest edge of one of the triangles that it is made of.

        Args:
            positions: ``(..., dimension)``.

        Returns:
            ``(...)`` distances; infinite in an empty open world.
        """
        points = self._points(positions)
        to_bounds = self._to_bounds(points)
        if not self.shapes.count:
            return to_bounds
        index = next(iter(self._indices.values()), None)
        if index is None:  # made for a share of the room that the obstacles take
            lower, upper = self.shapes.extent()
            index = self.index(max(float((upper - lower).max()), SMALLEST) / 32)
        flat = points.reshape(-1, self.dimension)
        return np.minimum(nearest_distance(self.shapes, index, flat).reshape(to_bounds.shape), to_bounds)

    def is_clear(self, positions: ArrayLike, distance: float) -> np.ndarray:
        """``(...)`` true where :meth:`clearance` is more than a positive distance [m]; quicker for many points.

        Args:
            positions: ``(..., dimension)``.
            distance: From the nearest obstacle or bound [m].
        """
        points = self._points(positions)
        clear: np.ndarray = self._to_bounds(points) > distance
        if self.shapes.count:
            index = self.index(distance)
            clear[clear] = is_farther(self.shapes, index, points[clear], distance)
        return clear

    def _points(self, positions: ArrayLike) -> Floats:
        points: Floats = numbers_of(positions, "positions must be an array of numbers", np.float64)
        if points.shape[-1:] != (self.dimension,):
            raise ValueError(f"positions have shape {points.shape}; expected (..., {self.dimension})")
        return points

    def _to_bounds(self, points: Floats) -> Floats:
        bounds = self.bounds.astype(np.float64)
        return np.minimum(points - bounds[0], bounds[1] - points).min(axis=-1)


def _rounded_up(distance: float) -> float:
    """The next power of two, so that distances of about the same size share an index."""
    return 2.0 ** math.ceil(math.log2(distance))


def _polygons(given: Sequence[ArrayLike]) -> tuple[FloatArray, ...]:
    if not isinstance(given, Iterable) or isinstance(given, str | bytes | Mapping):
        raise ValueError(f"polygons must be a list of polygons, each a list of corners, not {short_repr(given)}")
    corners = (frozen_array(one, f"polygons[{index}]", (None, 2), largest=LARGEST) for index, one in enumerate(given))
    return tuple(corners)


def shape_tables(world: World, xp: Any) -> tuple[Any, Any]:
    """The tables of :class:`Shapes`, by the functions of NumPy, or of JAX for a world whose numbers may be traced."""
    d, balls, cylinders = world.dimension, xp.asarray(world.balls), xp.asarray(world.cylinders)
    rows = [xp.concatenate([balls[:, :d], balls], axis=1)]
    if d == 3:
        end = xp.full((len(cylinders), 1), xp.inf, xp.float32)
        rows.append(xp.concatenate([cylinders[:, :2], -end, cylinders[:, :2], end, cylinders[:, 2:]], axis=1))
    rows.append(xp.pad(xp.asarray(world.boxes), ((0, 0), (0, 1))))
    pairs = zip(world.polygons, world.triangles, strict=True)
    triangles = [xp.asarray(corners)[np.array(own)].reshape(-1, 6) for corners, own in pairs]
    return xp.concatenate(rows), xp.concatenate([xp.zeros((0, 6), xp.float32), *triangles])


def world_of(value: object, dimension: int) -> World:
    """``value`` as the world of a team that moves in so many dimensions, open for ``None``; else a ValueError."""
    world = World(dimension=dimension) if value is None else value
    if not isinstance(world, World):
        raise ValueError(f"world is {short_repr(world)}; give a World, such as World(boxes=[...]), or leave it out")
    if world.dimension != dimension:
        raise ValueError(f"the world has dimension {world.dimension} and the team {dimension}; match them")
    return world
