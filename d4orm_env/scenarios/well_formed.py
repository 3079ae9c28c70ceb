"""Free space among walls, and starts and goals in it, such that every robot gets by those at rest.

Such an instance is called well-formed (Cap, Novak, Kleiner and Selecky, 2015): each robot has a path from its start to
its goal that keeps clear of all other starts and goals. One after another, in any order, all of them arrive, and none
that has docked closes the path of another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, Floats, IntArray
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.portable import root
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.layout import Layout, PlacementArea, build, round_up, with_random_obstacles
from d4orm_env.scenarios.settings import STARTS_AND_GOALS, Settings

ndimage: Any = LazyModule("scipy.ndimage")

RESERVE = 1 / 150
"""More than float32 rounds away over a map, and left free in addition to the margin, in radii of the largest robot."""

ENOUGH_POINTS = 2**18
"""Lattice points that do where nothing is narrow."""

WINDOW = {2: 32, 3: 8}
"""Least distance, in lattice points, within which a path round a position is looked for."""

TRIES, ROUNDS = 200, 3
"""Positions tried for each start or goal in one attempt to find all of them, and attempts."""

MAX_POINTS = 2**24
"""Lattice points of a world at most: what a map of four million cells needs."""

_POINTS_AT_ONCE = 2**15
"""Lattice points that are looked at in one go, in a processor's cache."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """The largest connected region in which a robot can drive clear of obstacles, as points of a lattice."""

    low: Floats  #: ``(d,)`` the first lattice point [m]
    step: float  #: Distance of neighbouring lattice points [m]
    #: ``(n_1, ..., n_d)`` which points belong to the region. A robot can go straight from each to its neighbours along
    #: the axes.
    inside: BoolArray

    def points(self, indices: IntArray) -> Floats:
        """``(..., d)`` positions of the lattice points of these indices, as float32 holds them [m]."""
        return (self.low + self.step * indices).astype(np.float32).astype(np.float64)

    def contains(self, position: Floats) -> bool:
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


def _last_reached(inside: BoolArray, begin: IntArray, kinds: Sequence[IntArray]) -> tuple[IntArray, int]:
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


class _FreeRegion:
    """Positions, ``most`` of them, taken from a region, the rest of which stays connected and in touch with each.

    Robots that pass by keep the ``separation`` to a position, in steps of the lattice.
    """

    def __init__(self, inside: BoolArray, separation: float, most: int) -> None:
        self._label, self._dilation = ndimage.label, ndimage.binary_dilation
        self.positions, self.count = np.empty((most, inside.ndim), np.int64), 0
        # A robot finds a path round a position within the wide window about it, or is held to find none.
        self._narrow = 2 * int(separation) + 1
        self._wide = max(self._narrow, WINDOW[inside.ndim])
        self._free = np.pad(inside, self._wide)
        self._taken = np.zeros(self._free.shape, np.int32)
        offsets = np.indices((2 * self._wide + 1,) * inside.ndim) - self._wide
        self._wide_disc = (offsets * offsets).sum(axis=0) <= separation * separation
        self._disc = self._wide_disc[self._about(np.zeros(inside.ndim, np.int64), self._narrow)]

    def add(self, position: IntArray) -> bool:
        """Take a position if that leaves every robot a path."""
        if self._taken[tuple(position + self._wide)] or not self._goes_round(position):
            return False
        taken = self._taken[self._about(position, self._narrow)]
        taken += self._disc
        self.positions[self.count] = position
        others = self.positions[: self.count + 1]
        if all(self._in_touch(other) for other in others[np.abs(others - position).max(axis=1) <= self._narrow]):
            self.count += 1
            return True
        taken -= self._disc
        return False

    def _about(self, position: IntArray, window: int) -> tuple[slice, ...]:
        return tuple(slice(index + self._wide - window, index + self._wide + window + 1) for index in position)

    def _goes_round(self, position: IntArray) -> bool:
        """Check whether all that a new disc touches of the untaken region is connected around it."""
        about = self._about(position, self._wide)
        untaken = self._free[about] & (self._taken[about] == 0)
        regions, _ = self._label(untaken & ~self._wide_disc)
        touched = regions[self._dilation(untaken & self._wide_disc)]
        return len(np.unique(touched[touched > 0])) == 1

    def _in_touch(self, position: IntArray) -> bool:
        """Check whether a robot gets from a position to the untaken region through no disc but its own."""
        about = self._about(position, self._narrow)
        free, taken = self._free[about], self._taken[about]
        untaken = free & (taken == 0)
        regions, _ = self._label(untaken | (free & (taken == 1) & self._disc))
        return bool((regions[untaken] == regions[(self._narrow,) * position.size]).any())


def draw_positions(
    random: np.random.Generator, space: FreeSpace, groups: Sequence[tuple[BoolArray | None, int]], separation: float
) -> Floats:
    """Random positions ``(P, d)``, far enough apart that a robot gets from each to each while robots are at all others.

    Each of the ``groups`` has the part of the region that its positions are drawn from, or ``None`` for all of it, and
    their number. Robots that pass by keep the ``separation`` to a position [m]. There are fewer than asked for if no
    more fit.
    """
    region = _FreeRegion(space.inside, separation / space.step, sum(number for _, number in groups))
    for part, number in groups:
        candidates = np.flatnonzero(space.inside if part is None else space.inside & part)
        some = random.choice(candidates, min(len(candidates), TRIES * max(number, 100)), replace=False)
        wanted = region.count + number
        for index in zip(*np.unravel_index(some, space.inside.shape), strict=True):
            if region.count == wanted:
                break
            region.add(np.array(index))
        if region.count < wanted:
            break
    return space.points(region.positions[: region.count])


def reserve_of(settings: Settings) -> float:
    """Return the distance left free in addition to the margin [m]."""
    return RESERVE * settings.team.largest_radius


def safety_distance_of(settings: Settings) -> float:
    """Distance that the centre of the largest robot keeps to obstacles [m]."""
    return float(np.max(settings.team.wall_radius)) + settings.margin + reserve_of(settings)


def lattice_step(settings: Settings, sides: ArrayLike, passage: tuple[str, float] | None = None) -> float:
    """Step of a lattice that is fine enough for the robots, and for the narrowest passage wherever it is [m].

    The world has these ``sides`` ``(d,)``, and the narrowest passage a name and a width [m].
    """
    lengths = np.asarray(sides)
    step = max(settings.spacing / 4, root(float(lengths.prod()) / ENOUGH_POINTS, len(lengths)))
    if passage is None:
        return step
    (name, width), safety_distance = passage, safety_distance_of(settings)
    if width < 2.2 * safety_distance:
        raise ValueError(
            f"scenario {settings.scenario!r}: robots of radius {np.max(settings.team.radius):g} m with margin "
            f"{settings.margin:g} m do not fit through a {name} of {width:g} m; "
            f"use {name}={round_up(2.2 * safety_distance)}"
        )
    return min(step, 0.99 * (width / 2 - safety_distance))


def populate(
    settings: Settings,
    world: World,
    step: float,
    travel: float,
    remedy: str,
    exchange: tuple[float, float] | None = None,
) -> Problem:
    """The problem of a team at random positions in a world with walls, at which robots leave all others a path.

    Positions are drawn from a lattice of this ``step`` [m], after random obstacles; ``travel`` is the distance that the
    horizon is made for [m], and ``remedy`` ends the error where the robots do not fit. With ``exchange`` half of the
    robots start at an x below the first value and end above the second [m], the others the other way round.
    """
    world = with_obstacles(settings, world)
    starts, goals = draw_team(settings, free_space(world, safety_distance_of(settings), step), remedy, exchange)
    return build(settings, Layout(starts, goals, world, travel))


def with_obstacles(settings: Settings, world: World, positions: Floats | None = None) -> World:
    """A world with bounds and the random obstacles asked for, clear of starts and goals if they are known."""
    low, high = world.bounds.astype(np.float64)
    positions = np.empty((0, world.dimension)) if positions is None else positions
    return with_random_obstacles(settings, world, positions, PlacementArea((high - low) / 2, centre=(low + high) / 2))


def draw_team(
    settings: Settings, space: FreeSpace, remedy: str, exchange: tuple[float, float] | None = None
) -> tuple[Floats, Floats]:
    """``(K, d)`` random starts and goals; see :func:`populate`."""
    random = settings.generator(STARTS_AND_GOALS)
    count = settings.num_robots
    # A robot may dock anywhere within the goal radius.
    apart = settings.spacing / settings.team.flattening(settings.margin) + settings.goal_radius + reserve_of(settings)
    separation = math.sqrt(apart * apart + space.step * space.step / 4)
    number = np.arange(2 * count)
    groups: list[tuple[BoolArray | None, int]] = [(None, 2 * count)]
    if exchange is not None:
        x = space.low[0] + space.step * np.arange(len(space.inside))[:, None]
        groups = [(x < exchange[0], count), (x > exchange[1], count)]
        # On either side the starts of one half and the goals of the other.
        half = (count + 1) // 2
        number = np.r_[:half, count + half : 2 * count, count : count + half, half:count]
    most = 0
    for _ in range(ROUNDS):
        positions = draw_positions(random, space, groups, separation)
        most = max(most, len(positions))
        if len(positions) == 2 * count:
            return positions[number[:count]], positions[number[count:]]
    raise ValueError(
        f"scenario {settings.scenario!r}: only {most} of {2 * count} starts and goals of robots of radius "
        f"{np.max(settings.team.radius):g} m with margin {settings.margin:g} m fit in such that all robots get by; "
        f"use fewer robots, {remedy}"
    )
