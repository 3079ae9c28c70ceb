"""Squares side by side, with walls between some of them: rooms with doors, and mazes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, positive_number
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.settings import WALLS, Settings, bounded, grid_size, require_dimension
from d4orm_env.scenarios.well_formed import lattice_step, populate, safety_distance_of

sparse: Any = LazyModule("scipy.sparse")
csgraph: Any = LazyModule("scipy.sparse.csgraph")

WALL = 0.1
"""Thickness of a wall [m]."""

SAMPLES, TRIES = 16, 1000
"""Drawings that say how long paths usually get, and drawings until one is no longer than these."""


class Openings(NamedTuple):
    """Openings in the walls between ``columns`` times ``rows`` squares; all squares are connected."""

    right: BoolArray  #: ``(rows, columns - 1)`` between a square and the next to its right
    above: BoolArray  #: ``(rows - 1, columns)`` between a square and the next above
    longest: int  #: About the most walls on the shortest path from a square to another


def draw_openings(random: np.random.Generator, columns: int, rows: int, share: float) -> Openings:
    """Random openings: a spanning tree, and that share of all other walls.

    Paths are no longer than in half of some other drawings, so that one horizon suits every seed.
    """
    longest = _usual_longest(columns, rows, share)
    for _ in range(TRIES):
        openings = _draw(random, columns, rows, share)
        if openings.longest <= longest:
            return openings._replace(longest=longest)
    raise ValueError(
        f"{TRIES} drawings of {columns} x {rows} squares have paths of more than {longest}; try another seed"
    )


@lru_cache(maxsize=64)
def _usual_longest(columns: int, rows: int, share: float) -> int:
    lengths = [_draw(np.random.default_rng(seed), columns, rows, share).longest for seed in range(SAMPLES)]
    return sorted(lengths)[SAMPLES // 2]


def _draw(random: np.random.Generator, columns: int, rows: int, share: float) -> Openings:
    squares = np.arange(rows * columns).reshape(rows, columns)
    first = np.concatenate([squares[:, :-1].ravel(), squares[:-1].ravel()])
    second = np.concatenate([squares[:, 1:].ravel(), squares[1:].ravel()])
    # The tree takes what is smallest, and the extra openings are the smallest of what is left.
    weight = 1 + random.random(len(first))
    graph = sparse.coo_array((weight, (first, second)), shape=(squares.size, squares.size))
    is_open = np.isin(weight, csgraph.minimum_spanning_tree(graph.tocsr()).data)
    others = np.sort(weight[~is_open])
    extra = round(share * len(others))
    if extra:
        is_open |= weight <= others[extra - 1]
    opened = sparse.coo_array((np.ones(is_open.sum()), (first[is_open], second[is_open])), shape=graph.shape).tocsr()
    longest, begin = 0, 0
    for _ in range(2):  # from anywhere to the square furthest off, and from there to the one furthest off
        hops = csgraph.shortest_path(opened, directed=False, unweighted=True, indices=begin)
        longest, begin = int(hops.max()), int(np.argmax(hops))
    right, above = np.split(is_open, [rows * (columns - 1)])
    return Openings(right.reshape(rows, columns - 1), above.reshape(rows - 1, columns), longest)


def wall_world(openings: Openings, side: float, width: float, random: np.random.Generator) -> World:
    """The world of squares with these openings, centred on the origin.

    Squares have a ``side`` from wall to wall [m], and openings a ``width`` [m], at random along a side.
    """
    columns, rows = openings.above.shape[1], openings.right.shape[0]
    pitch = side + WALL
    half = np.array([columns * pitch - WALL, rows * pitch - WALL]) / 2
    boxes = []
    for axis, is_open in ((0, openings.right.T), (1, openings.above)):
        gaps = random.uniform(0, 1, is_open.shape) * (side - width) - half[1 - axis]
        for line, own in enumerate(is_open):
            begin = gaps[line, own] + pitch * np.flatnonzero(own)
            pieces = np.column_stack([np.r_[-half[1 - axis], begin + width], np.r_[begin, half[1 - axis]]])
            # What is no longer than thick belongs to the walls across, if any ends there.
            pieces = pieces[pieces[:, 1] - pieces[:, 0] > 1.01 * WALL]
            across = np.full((len(pieces), 1), (line + 1) * pitch - WALL - half[axis])
            low, high = np.hstack([across, pieces[:, :1]]), np.hstack([across + WALL, pieces[:, 1:]])
            boxes.append(np.hstack([low, high] if axis == 0 else [low[:, ::-1], high[:, ::-1]]))
    return World(2, boxes=np.vstack(boxes) if boxes else (), lower=-half, upper=half)


def default_squares(number: float, least: int) -> tuple[int, int]:
    """Columns and rows of the smallest square plan of at least that many squares."""
    side = max(least, int(np.ceil(np.sqrt(number))))
    return side, side


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
    require_dimension(settings, 2)
    size = default_squares(settings.num_robots / 2, 3) if rooms is None else grid_size(rooms, "rooms")
    side, width = bounded(room_size, "room_size"), bounded(door_width, "door_width")
    share = positive_number(extra_doors, "extra_doors", zero_allowed=True, most=1.0)
    if width > side:
        raise ValueError(f"door_width is {width:g}; it must be at most the room_size, which is {side:g}")
    return _populate_squares(settings, size, side, ("door_width", width), share, "more rooms or a larger room_size")


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
    require_dimension(settings, 2)
    width = bounded(corridor_width, "corridor_width")
    if cells is None:
        # Where two robots cannot pass each other, every position takes a dead end.
        is_wide = width > 1.1 * (2 * safety_distance_of(settings) + settings.spacing + settings.goal_radius)
        cells = default_squares((2.5 if is_wide else 12) * settings.num_robots, 6)
    size, remedy = grid_size(cells, "cells"), "more cells or a larger corridor_width"
    share = positive_number(loops, "loops", zero_allowed=True, most=1.0)
    return _populate_squares(settings, size, width, ("corridor_width", width), share, remedy)


def _populate_squares(
    settings: Settings, size: tuple[int, int], side: float, opening: tuple[str, float], share: float, remedy: str
) -> Problem:
    """The problem of a team among ``size`` squares, columns and rows, whose openings have a name and a width [m]."""
    step, random = lattice_step(settings, np.array(size) * (side + WALL), opening), settings.generator(WALLS)
    openings = draw_openings(random, *size, share)
    world = wall_world(openings, side, opening[1], random)
    return populate(settings, world, step, (openings.longest + 1) * (side + WALL), remedy)
