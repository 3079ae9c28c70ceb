"""A warehouse."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.free_space import lattice_step, populate
from d4orm_env.scenarios.settings import Settings, bounded, grid_size, require_plane


def warehouse(
    settings: Settings,
    *,
    shelves: Sequence[int] | None = None,
    shelf_length: float = 3.0,
    shelf_width: float = 0.8,
    aisle_width: float = 1.2,
) -> Problem:
    """Rows of shelves with aisles between and around them; starts and goals anywhere in the aisles.

    The seed sets the starts and goals.

    Args:
        settings: The common arguments.
        shelves: Number of shelves, ``(columns, rows)``; by default 2 columns, and a row for every four robots but at
            least 3.
        shelf_length: Along x [m].
        shelf_width: Along y [m].
        aisle_width: Width of all aisles [m].
    """
    require_plane(settings)
    counts = grid_size((2, max(3, -(-settings.num_robots // 4))) if shelves is None else shelves, "shelves")
    size = np.array([bounded(shelf_length, "shelf_length"), bounded(shelf_width, "shelf_width")])
    aisle = bounded(aisle_width, "aisle_width")
    half = (np.array(counts) * (size + aisle) + aisle) / 2
    step = lattice_step(settings, 2 * half, ("aisle_width", aisle))
    column, row = np.meshgrid(*(np.arange(count) for count in counts))
    low = np.column_stack([column.ravel(), row.ravel()]) * (size + aisle) + aisle - half
    world = World(2, boxes=np.hstack([low, low + size]), lower=-half, upper=half)
    return populate(settings, world, step, 2 * float(half.sum()), "more shelves or a larger aisle_width")
