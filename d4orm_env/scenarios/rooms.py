"""Rooms with doors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from d4orm_env.core.arrays import positive_number
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios.free_space import lattice_step, populate
from d4orm_env.scenarios.settings import WALLS, Settings, bounded, grid_size, require_plane
from d4orm_env.scenarios.wall_grid import WALL, default_squares, draw_openings, wall_world


def rooms(
    settings: Settings,
    *,
    rooms: Sequence[int] | None = None,
    room_size: float = 2.5,
    door_width: float = 0.8,
    extra_doors: float = 0.3,
) -> Problem:
    """A grid of rooms with doors between them; starts and goals anywhere in them.

    As many doors as it takes to get from each room to each other, and some more. Walls, doors, starts and goals are set
    by the seed.

    Args:
        settings: The common arguments.
        rooms: Number of rooms, ``(columns, rows)``; by default 3 x 3, or enough for one to every second robot.
        room_size: Side of a room [m].
        door_width: Width of the doors [m].
        extra_doors: Share of the walls without a door that get one all the same.
    """
    require_plane(settings)
    columns, rows = default_squares(settings.num_robots / 2, 3) if rooms is None else grid_size(rooms, "rooms")
    side, width = bounded(room_size, "room_size"), bounded(door_width, "door_width")
    share = positive_number(extra_doors, "extra_doors", zero_allowed=True, most=1.0)
    if width > side:
        raise ValueError(f"door_width is {width:g}; it must be at most the room_size, which is {side:g}")
    step = lattice_step(settings, np.array([columns, rows]) * (side + WALL), ("door_width", width))
    random = settings.generator(WALLS)
    openings = draw_openings(random, columns, rows, share)
    world = wall_world(openings, side, width, random)
    travel = (openings.longest + 1) * (side + WALL)
    return populate(settings, world, step, travel, "more rooms or a larger room_size")
