"""Positions for robots: the free space among obstacles, and random positions, drawn again until they are free."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.portable import root
from d4orm_env.core.world import World
from d4orm_env.scenarios.settings import OBSTACLES, STARTS_AND_GOALS, Settings

ndimage: Any = LazyModule("scipy.ndimage")

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEW, MANY, ROUNDS = 8, 512, 70
"""Candidates drawn at first and at most at once, and how often, before a position is held to be impossible."""

DENSITY = {2: 0.4, 3: 0.25}
"""Share of the area (volume) that random placement fills without fail; it jams at 0.547 (0.384)."""


class PlacementArea(NamedTuple):
    """Region that points are drawn from: a box, or the ellipse (ellipsoid) inside it."""

    half_extent: Points  #: ``(d,)`` half the sides of the box [m]
    is_round: bool = False  #: Whether it is the ellipse
    centre: Points | float = 0.0  #: ``(d,)`` [m]

    def contains(self, points: Points) -> NDArray[np.bool_]:
        """``(C,)`` which of ``(C, d)`` points of the box belong to it."""
        if not self.is_round:
            return np.full(len(points), True)
        extent = np.maximum(self.half_extent, np.finfo(np.float64).tiny)
        return (((points - self.centre) / extent) ** 2).sum(axis=1) <= 1


def scatter(settings: Settings, size: float) -> tuple[Points, Points]:
    """Random starts and goals ``(K, d)`` in the square (cube) of side ``size`` around the origin.

    Starts keep more than the margin to each other, goals likewise, and no robot starts at its goal. Each is drawn
    uniformly, and drawn again until it is free.
    """
    count, dimension = settings.num_robots, settings.team.dimension
    random = settings.generator(STARTS_AND_GOALS)
    area = PlacementArea(np.full(dimension, size / 2))
    needed = max(size_for(count, settings.spacing, dimension), 3 * settings.goal_radius)
    starts, goals = np.empty((0, dimension)), np.empty((0, dimension))
    for robot in range(count if needed <= size else 0):
        starts = _with_another(random, area, starts, settings.spacing)
        own = (starts[robot:], settings.goal_radius)
        goals = _with_another(random, area, goals, settings.spacing, own)
        if min(len(starts), len(goals)) == robot:
            break
    if min(len(starts), len(goals)) < count:
        raise ValueError(
            f"scenario {settings.scenario!r}: {count} robots of radius {np.max(settings.team.radius):g} m with margin "
            f"{settings.margin:g} m do not fit at random in a size of {size:g} m; "
            f"use size={round_up(needed if needed > size else 1.2 * size)}"
        )
    return starts, goals


def size_for(count: int, spacing: float, dimension: int) -> float:
    """Side of the square (cube) that takes ``count`` random points ``spacing`` apart without fail [m]."""
    ball = math.pi / 4 * spacing * spacing if dimension == 2 else math.pi / 6 * spacing * spacing * spacing
    return root(count * ball / DENSITY[dimension], dimension) if count > 1 else 0.0


def with_random_obstacles(settings: Settings, world: World, positions: Points, area: PlacementArea) -> World:
    """The world and ``settings.num_obstacles`` random circles, or spheres in space.

    They keep more than the margin to the ``positions`` ``(2 K, d)``, starts, then goals, of which there are none where
    these are drawn later, and leave the largest robot a passage with its margin on both sides, between each other and
    to everything else: no obstacle closes a path.
    """
    if not settings.num_obstacles:
        return world
    random = settings.generator(OBSTACLES)
    size = float(np.float32(settings.obstacle_radius))
    passage = 2 * (float(np.max(settings.team.radius)) + settings.margin)
    safety_distance = np.tile(np.float64(settings.team.radius), 2) + size + settings.margin
    balls: Points = np.empty((0, world.dimension))

    def is_free(centres: Points) -> NDArray[np.bool_]:
        apart = _gaps(centres, positions, safety_distance) > 0
        passable = (world.clearance(centres) > size + passage) & (_gaps(centres, balls, 2 * size + passage) > 0)
        return np.asarray(apart & passable)

    for index in range(settings.num_obstacles):
        ball = _first(random, area, is_free)
        if ball is None:
            raise ValueError(
                f"scenario {settings.scenario!r}: only {index} of {settings.num_obstacles} obstacles of radius "
                f"{size:g} m fit between the robots; use num_obstacles={index}, a smaller obstacle_radius or a larger "
                f"scenario"
            )
        balls = np.vstack([balls, ball])
    rows = np.vstack([world.balls, np.hstack([balls, np.full((len(balls), 1), size)])])
    return replace(world, circles=rows) if world.dimension == 2 else replace(world, spheres=rows)


def round_up(value: float) -> str:
    """A length rounded up to the next centimetre, for an error that says what would do."""
    return f"{math.floor(value * 100) / 100 + 0.01:.2f}" if value < 1e6 else f"{value * 1.01:.2e}"


def _with_another(
    random: np.random.Generator,
    area: PlacementArea,
    points: Points,
    spacing: float,
    avoid: tuple[Points, float] | None = None,
) -> Points:
    """``points`` and a random one further than ``spacing`` from each, or just ``points`` if there is no room."""

    def is_free(candidates: Points) -> NDArray[np.bool_]:
        free = _gaps(candidates, points, spacing) > 0
        return free if avoid is None else free & (_gaps(candidates, *avoid) > 0)

    position = _first(random, area, is_free)
    return points if position is None else np.vstack([points, position])


def _first(
    random: np.random.Generator, area: PlacementArea, is_free: Callable[[Points], NDArray[np.bool_]]
) -> Points | None:
    """The first uniform random point of an area that is free, or ``None`` if none of many was."""
    half = area.half_extent
    for attempt in range(ROUNDS):
        points = area.centre + random.uniform(-half, half, (min(FEW << attempt, MANY), len(half)))
        # Rounded as the problem will hold them, so that what is checked is what is used.
        points = points.astype(np.float32).astype(np.float64)
        free = area.contains(points) & is_free(points)
        if free.any():
            return points[np.argmax(free)]
    return None


def _gaps(candidates: Points, points: Points, safety_distance: Points | float) -> Points:
    """``(C,)`` least distance of each candidate to points, less what they keep; infinite where there are none [m]."""
    if not len(points):
        return np.full(len(candidates), np.inf)
    return (np.linalg.norm(candidates[:, None] - points, axis=-1) - safety_distance).min(axis=1)


MAX_POINTS = 2**24
"""Lattice points of a world at most: what a map of four million cells needs."""

_POINTS_AT_ONCE = 2**15
"""Lattice points that are looked at in one go, in a processor's cache."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """The largest connected region in which a robot can drive clear of obstacles, as points of a lattice."""

    low: Points  #: ``(d,)`` the first lattice point [m]
    step: float  #: Distance of neighbouring lattice points [m]
    #: ``(n_1, ..., n_d)`` which points belong to the region. A robot can go straight from each to its neighbours along
    #: the axes.
    inside: Mask

    def points(self, indices: NDArray[np.int64]) -> Points:
        """``(..., d)`` positions of the lattice points of these indices, as float32 holds them [m]."""
        return (self.low + self.step * indices).astype(np.float32).astype(np.float64)

    def contains(self, position: Points) -> bool:
        """Check whether the lattice point nearest to a position belongs to the region."""
        index = np.round((position - self.low) / self.step).astype(int)
        within = ((index >= 0) & (index < self.inside.shape)).all()
        return bool(within and self.inside[tuple(index)])

    @cached_property
    def longest_path(self) -> float:
        """About the longest of all shortest paths within the region [m], to some 10%."""
        inside = np.pad(self.inside, 1)
        steps = np.array(list(product((-1, 0, 1), repeat=inside.ndim)))
        around = steps @ (np.array(inside.strides) // inside.itemsize)
        # Straight steps and any steps in turn go about as far in all directions.
        kinds = (around[np.abs(steps).sum(axis=1) == 1], around)
        end, _ = _last_reached(inside.ravel(), np.flatnonzero(inside)[:1], kinds)
        return _last_reached(inside.ravel(), end, kinds)[1] * self.step


def _last_reached(
    inside: Mask, begin: NDArray[np.int64], kinds: Sequence[NDArray[np.int64]]
) -> tuple[NDArray[np.int64], int]:
    """One of the points reached last from another, and after how many steps, of these kinds in turn."""
    unseen, front, steps = inside.copy(), begin, 0
    last = np.empty(len(inside), np.int32)
    while True:
        unseen[front] = False
        near = (front[:, None] + kinds[steps % len(kinds)]).ravel()
        near = near[unseen[near]]
        if not len(near):
            return np.sort(front)[:1], steps
        # Each point once; sorting takes longer.
        number = np.arange(len(near), dtype=np.int32)
        last[near] = number
        front, steps = near[last[near] == number], steps + 1


@lru_cache(maxsize=4)
def free_space(world: World, safety_distance: float, step: float) -> FreeSpace:
    """The free space of a world with bounds for robots whose centres keep ``safety_distance`` to everything [m].

    The lattice begins at the lower bounds, in steps of ``step`` [m].
    """
    low, high = world.bounds.astype(np.float64)
    shape = ((high - low) / step + 1).astype(int)
    if np.prod(shape, dtype=np.float64) > MAX_POINTS:
        raise ValueError(
            f"a world of {' x '.join(f'{side:g}' for side in high - low)} m takes more than {MAX_POINTS} points "
            f"{step:.2g} m apart to find free places in; use a smaller world or larger robots"
        )
    space = FreeSpace(low, step, np.zeros(shape, np.bool_))
    # Between two neighbours that are further from everything than this a robot keeps its safety distance.
    needed = math.sqrt(safety_distance * safety_distance + step * step / 4)
    free = np.empty(shape, np.bool_)
    rows = max(1, _POINTS_AT_ONCE // int(np.prod(shape[1:])))
    for begin in range(0, shape[0], rows):
        part = free[begin : begin + rows]
        indices = np.moveaxis(np.indices(part.shape), 0, -1)
        indices[..., 0] += begin
        part[...] = world.is_clear(space.points(indices), needed)
    regions, count = ndimage.label(free)
    return replace(space, inside=regions == 1 + np.argmax(np.bincount(regions.ravel())[1:])) if count else space
