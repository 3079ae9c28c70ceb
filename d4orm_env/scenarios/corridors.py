"""Two rooms with one path between them: a corridor with passing bays, or just a door."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import whole_number
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.placement import Points, round_up
from d4orm_env.scenarios.settings import MAX_COUNT, Settings, bounded, require_plane
from d4orm_env.scenarios.well_formed import lattice_step, populate, reach_of

DOOR_DEPTH = 0.2
"""Thickness of the wall that the door is in [m]."""


def corridor(
    settings: Settings,
    *,
    length: float = 4.0,
    corridor_width: float = 0.6,
    bays: int = 2,
    room_size: float | None = None,
) -> Problem:
    """Two teams in two rooms that exchange through a corridor with passing bays.

    By default one robot fits through the corridor at a time, and one can let another pass in a bay, to the sides of the
    corridor in turn. The seed sets the starts and goals in the rooms.

    Args:
        settings: The common arguments.
        length: Of the corridor, along x [m].
        corridor_width: Along y [m].
        bays: Number of passing bays.
        room_size: Side of the two rooms [m]; by default large enough for starts and goals.
    """
    return _two_rooms(
        settings,
        bounded(length, "length"),
        ("corridor_width", bounded(corridor_width, "corridor_width")),
        whole_number(bays, "bays", 0, MAX_COUNT),
        room_size,
    )


def doorway(settings: Settings, *, door_width: float = 0.6, room_size: float | None = None) -> Problem:
    """Two teams in two rooms that exchange through one door.

    By default one robot fits through the door at a time. The seed sets the starts and goals in the rooms.

    Args:
        settings: The common arguments.
        door_width: Width of the door [m].
        room_size: Side of the two rooms [m]; by default large enough for starts and goals.
    """
    return _two_rooms(settings, DOOR_DEPTH, ("door_width", bounded(door_width, "door_width")), 0, room_size)


def _two_rooms(
    settings: Settings, length: float, passage: tuple[str, float], bays: int, room_size: float | None
) -> Problem:
    require_plane(settings)
    name, width = passage
    # A bay is deep enough that a robot in it lets another pass.
    separation = settings.spacing + 2 * reach_of(settings)
    depth = max(width, separation - width + 0.1) if bays else 0.0
    least = width + 2 * depth
    if room_size is None:
        room_size = max(3.0, 1.25 * float(np.sqrt(settings.num_robots)), 1.1 * least)
    room = bounded(room_size, "room_size")
    if room <= least:
        raise ValueError(f"room_size is {room:g}; a {name} of {width:g} with its bays needs {round_up(least)}")
    bay = max(2 * width, 2 * reach_of(settings) + width)
    if bays * bay * 1.2 > length:
        raise ValueError(
            f"{bays} bays do not fit along a length of {length:g}; use length={round_up(bays * bay * 1.2)}"
        )
    step = lattice_step(settings, [2 * room + length, room], passage)
    middles = length * ((np.arange(bays) + 1) / (bays + 1) - 0.5)
    pockets = np.column_stack([middles - bay / 2, middles + bay / 2])
    above, below = (_bank(length, width / 2, depth, room / 2, own) for own in (pockets[::2], pockets[1::2]))
    boxes = np.vstack([above, below[:, [0, 3, 2, 1]] * [1, -1, 1, -1]])
    corner = np.array([length / 2 + room, room / 2])
    world = World(2, boxes=boxes, lower=-corner, upper=corner)
    clear = length / 2 + reach_of(settings)
    # One half drives through after the other, in a row.
    travel = 2 * (length + 2 * room) + settings.num_robots * settings.spacing
    return populate(settings, world, step, travel, "a larger room_size", exchange=(-clear, clear))


def _bank(length: float, near: float, depth: float, far: float, bays: Points) -> Points:
    """``(., 4)`` boxes on one side of the corridor, from ``near`` to ``far`` of its axis."""
    if not len(bays):
        return np.array([[-length / 2, near, length / 2, far]])
    begin, end = np.r_[-length / 2, bays[:, 1]], np.r_[bays[:, 0], length / 2]
    between = np.column_stack([begin, np.full(len(begin), near), end, np.full(len(begin), near + depth)])
    return np.vstack([between, [-length / 2, near + depth, length / 2, far]])
