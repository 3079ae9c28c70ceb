"""A forest."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import positive_number
from d4orm_env.core.portable import root
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.free_space import lattice_step, populate
from d4orm_env.scenarios.settings import MAX_COUNT, WALLS, Settings, bounded


def forest(settings: Settings, *, size: float | None = None, density: float = 0.25) -> Problem:
    """Trees at random in a square; starts and goals anywhere between them.

    Trees are circles of radius ``obstacle_radius``, or vertical cylinders in space, where the forest is a cube. They,
    the starts and the goals are set by the seed.

    Args:
        settings: The common arguments.
        size: Side of the square or cube [m]. By default 8 m (5 m in space) or what gives every robot 2.5 m^2 (4 m^3),
            whichever is more.
        density: Trees per square metre; they may overlap.
    """
    dimension = settings.team.dimension
    if size is None:
        size = (
            max(8.0, root(2.5 * settings.num_robots, 2))
            if dimension == 2
            else max(5.0, root(4.0 * settings.num_robots, 3))
        )
    size = bounded(size, "size")
    number = round(positive_number(density, "density", zero_allowed=True) * size * size)
    if number > MAX_COUNT:
        raise ValueError(
            f"a density of {density:g} is {number} trees in a size of {size:g}; scenarios make at most {MAX_COUNT}"
        )
    trunks = settings.generator(WALLS).uniform(-size / 2, size / 2, (number, 2))
    trees = np.column_stack([trunks, np.full(number, settings.obstacle_radius)])
    bounds = np.full(dimension, size / 2)
    circles, cylinders = (trees, ()) if dimension == 2 else ((), trees)
    world = World(dimension, circles=circles, cylinders=cylinders, lower=-bounds, upper=bounds)
    travel = 1.2 * size * float(np.sqrt(dimension))
    return populate(settings, world, lattice_step(settings, 2 * bounds), travel, "a larger size or a lower density")
