"""Free space for the robots of a team among obstacles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.world import World
from d4orm_env.scenarios.placement import Points

ndimage: Any = LazyModule("scipy.ndimage")

Mask = NDArray[np.bool_]

MAX_POINTS = 2**24
"""Lattice points of a world at most: what a map of four million cells needs."""

_POINTS_AT_ONCE = 2**15
"""Lattice points that are looked at in one go, in a processor's cache."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """The largest connected region in which a robot can drive clear of obstacles, as points of a lattice.

    Attributes:
        low: ``(d,)`` the first lattice point [m].
        step: Distance of neighbouring lattice points [m].
        inside: ``(n_1, ..., n_d)`` which points belong to the region. A robot can go straight from each to its
            neighbours along the axes.
    """

    low: Points
    step: float
    inside: Mask

    def points(self, indices: NDArray[np.int64]) -> Points:
        """``(..., d)`` places of the lattice points of these indices, as float32 holds them [m]."""
        return (self.low + self.step * indices).astype(np.float32).astype(np.float64)

    def contains(self, place: Points) -> bool:
        """Check whether the lattice point nearest to a position belongs to the region."""
        index = np.round((place - self.low) / self.step).astype(int)
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
def free_space(world: World, reach: float, step: float) -> FreeSpace:
    """The free space of a world with bounds for robots whose centres keep ``reach`` to everything [m].

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
    # A robot keeps its reach between two neighbours that are further from everything than this.
    needed = math.sqrt(reach * reach + step * step / 4)
    free = np.empty(shape, np.bool_)
    rows = max(1, _POINTS_AT_ONCE // int(np.prod(shape[1:])))
    for begin in range(0, shape[0], rows):
        part = free[begin : begin + rows]
        indices = np.moveaxis(np.indices(part.shape), 0, -1)
        indices[..., 0] += begin
        part[...] = world.is_clear(space.points(indices), needed)
    regions, count = ndimage.label(free)
    return replace(space, inside=regions == 1 + np.argmax(np.bincount(regions.ravel())[1:])) if count else space
