"""The maps that MMD was measured on, three times as large, which makes its robots of 0.05 into ours of 0.15 m.

Boxes are those of its authors' published code (yoraish/mmd, 2024). There starts and goals are uniform and keep 0.16 to
boxes and 0.15 to each other; here they are drawn as in all worlds with walls, such that all robots get by. What robots
of the publication learn there besides, lanes, one-way conveyors and stops, no problem here asks for.
Source: Y. Shaoul, I. Mishani, S. Vats, J. Li and M. Likhachev, *Multi-Robot Motion Planning with Diffusion Models*,
ICLR 2025.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from d4orm_env.core.portable import root
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.settings import Settings, bounded, require_plane
from d4orm_env.scenarios.well_formed import lattice_step, populate

SIDE, ROBOTS = 6.0, 20
"""Side of the maps [m], the publication's being 2, and most robots for it; more have as much room each."""

Box = tuple[float, float, float, float]
"""Centre and sides in a map from -1 to 1."""


def mmd_conveyor(settings: Settings, *, side: float | None = None) -> Problem:
    """MMD's map with two conveyors: corridors for one robot between three walls in the middle.

    Args:
        settings: The common arguments.
        side: Of the map [m]; by default 6 m, and in proportion to the number of robots' root for more than 20.
    """
    return _map(settings, side, [(0, 0, 0.8, 0.1), (0, 0.35, 1, 0.1), (0, -0.35, 1, 0.1)])


def mmd_highways(settings: Settings, *, side: float | None = None) -> Problem:
    """MMD's map with highways: roads around nine blocks, three by three.

    Args:
        settings: The common arguments.
        side: Of the map [m]; by default 6 m, and in proportion to the number of robots' root for more than 20.
    """
    rows = [(-0.875, 0.25), (0.0, 0.5), (0.875, 0.25)]
    return _map(settings, side, [(x, y, width, height) for (x, width), (y, height) in product(rows, rows)])


def mmd_drop_region(settings: Settings, *, side: float | None = None) -> Problem:
    """MMD's map with drop regions: four square blocks with aisles between and around them.

    Args:
        settings: The common arguments.
        side: Of the map [m]; by default 6 m, and in proportion to the number of robots' root for more than 20.
    """
    return _map(settings, side, [(x, y, 0.4, 0.4) for x, y in product((-0.4, 0.4), repeat=2)])


def _map(settings: Settings, side: float | None, boxes: Sequence[Box]) -> Problem:
    require_plane(settings)
    if side is None:
        side = SIDE * max(1.0, root(settings.num_robots / ROBOTS, 2))
    half = bounded(side, "side") / 2
    centres, sizes = np.split(half * np.array(boxes), 2, axis=1)
    world = World(2, boxes=np.hstack([centres - sizes / 2, centres + sizes / 2]), lower=[-half] * 2, upper=[half] * 2)
    return populate(settings, world, lattice_step(settings, [2 * half] * 2), 4 * half, "or a larger side")
