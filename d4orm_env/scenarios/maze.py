"""A maze."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from d4orm_env.core.arrays import positive_number
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios.free_space import lattice_step, populate, reach_of
from d4orm_env.scenarios.settings import WALLS, Settings, bounded, grid_size, require_plane
from d4orm_env.scenarios.wall_grid import WALL, default_squares, draw_openings, wall_world


def maze(
    settings: Settings, *, cells: Sequence[int] | None = None, corridor_width: float = 1.2, loops: float = 0.1
) -> Problem:
    """A maze of corridors; starts and goals anywhere where others get by, which is in dead ends if it is narrow.

    Walls, starts and goals are set by the seed.

    Args:
        settings: The common arguments.
        cells: Size of the maze in widths of a corridor, ``(columns, rows)``; by default square and large enough.
        corridor_width: Width of the corridors [m].
        loops: Share of the walls of a maze without loops that are left out.
    """
    require_plane(settings)
    width = bounded(corridor_width, "corridor_width")
    if cells is None:
        # Where two robots cannot pass each other, every place takes a dead end.
        is_wide = width > 1.1 * (2 * reach_of(settings) + settings.spacing + settings.goal_radius)
        cells = default_squares((2.5 if is_wide else 12) * settings.num_robots, 6)
    columns, rows = grid_size(cells, "cells")
    share = positive_number(loops, "loops", zero_allowed=True, most=1.0)
    step = lattice_step(settings, np.array([columns, rows]) * (width + WALL), ("corridor_width", width))
    random = settings.generator(WALLS)
    openings = draw_openings(random, columns, rows, share)
    world = wall_world(openings, width, width, random)
    travel = (openings.longest + 1) * (width + WALL)
    return populate(settings, world, step, travel, "more cells or a larger corridor_width")
