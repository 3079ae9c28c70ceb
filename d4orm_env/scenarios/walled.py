"""Scenarios in bounds: a corridor, a door, a warehouse, a forest, and what MMD and AMSwarm were measured on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from d4orm_env.core.arrays import Floats, positive_number, whole_number
from d4orm_env.core.portable import root
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.generators import antipodal_circle
from d4orm_env.scenarios.layout import build, round_up
from d4orm_env.scenarios.settings import JITTER, MAX_COUNT, WALLS, Settings, bounded, grid_size, require_dimension
from d4orm_env.scenarios.well_formed import lattice_step, populate, safety_distance_of

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
    require_dimension(settings, 2)
    name, width = passage
    # A bay is deep enough that a robot in it lets another pass.
    separation = settings.spacing + 2 * safety_distance_of(settings)
    depth = max(width, separation - width + 0.1) if bays else 0.0
    least = width + 2 * depth
    if room_size is None:
        room_size = max(3.0, 1.25 * float(np.sqrt(settings.num_robots)), 1.1 * least)
    room = bounded(room_size, "room_size")
    if room <= least:
        raise ValueError(f"room_size is {room:g}; a {name} of {width:g} with its bays needs {round_up(least)}")
    bay = max(2 * width, 2 * safety_distance_of(settings) + width)
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
    clear = length / 2 + safety_distance_of(settings)
    # One half drives through after the other, in a row.
    travel = 2 * (length + 2 * room) + settings.num_robots * settings.spacing
    return populate(settings, world, step, travel, "a larger room_size", exchange=(-clear, clear))


def _bank(length: float, near: float, depth: float, far: float, bays: Floats) -> Floats:
    """``(., 4)`` boxes on one side of the corridor, from ``near`` to ``far`` of its axis."""
    if not len(bays):
        return np.array([[-length / 2, near, length / 2, far]])
    begin, end = np.r_[-length / 2, bays[:, 1]], np.r_[bays[:, 0], length / 2]
    between = np.column_stack([begin, np.full(len(begin), near), end, np.full(len(begin), near + depth)])
    return np.vstack([between, [-length / 2, near + depth, length / 2, far]])


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
    require_dimension(settings, 2)
    counts = grid_size((2, max(3, -(-settings.num_robots // 4))) if shelves is None else shelves, "shelves")
    size = np.array([bounded(shelf_length, "shelf_length"), bounded(shelf_width, "shelf_width")])
    aisle = bounded(aisle_width, "aisle_width")
    half = (np.array(counts) * (size + aisle) + aisle) / 2
    step = lattice_step(settings, 2 * half, ("aisle_width", aisle))
    column, row = np.meshgrid(*(np.arange(count) for count in counts))
    low = np.column_stack([column.ravel(), row.ravel()]) * (size + aisle) + aisle - half
    world = World(2, boxes=np.hstack([low, low + size]), lower=-half, upper=half)
    return populate(settings, world, step, 2 * float(half.sum()), "more shelves or a larger aisle_width")


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
        least, room = (8.0, 2.5) if dimension == 2 else (5.0, 4.0)
        size = max(least, root(room * settings.num_robots, dimension))
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


SIDE, ROBOTS = 6.0, 20
"""Side of MMD's maps [m], the publication's being 2, and most robots for it; more have as much room each."""

Box = tuple[float, float, float, float]
"""Centre and sides in a map from -1 to 1."""


_ROADS = ((-0.875, 0.25), (0.0, 0.5), (0.875, 0.25))
MMD_MAPS: Mapping[str, tuple[str, Sequence[Box]]] = {
    "mmd_conveyor": (
        "MMD's map with two conveyors: corridors for one robot between three walls in the middle.",
        [(0, 0, 0.8, 0.1), (0, 0.35, 1, 0.1), (0, -0.35, 1, 0.1)],
    ),
    "mmd_highways": (
        "MMD's map with highways: roads around nine blocks, three by three.",
        [(x, y, width, height) for (x, width), (y, height) in product(_ROADS, _ROADS)],
    ),
    "mmd_drop_region": (
        "MMD's map with drop regions: four square blocks with aisles between and around them.",
        [(x, y, 0.4, 0.4) for x, y in product((-0.4, 0.4), repeat=2)],
    ),
}
"""Description of each map, and its boxes; see :func:`mmd_map`."""


def mmd_map(boxes: Sequence[Box], settings: Settings, *, side: float | None = None) -> Problem:
    """A map of MMD, three times as large, which makes its robots of 0.05 into ours of 0.15 m.

    Boxes are those of its authors' published code (yoraish/mmd, 2024). There starts and goals are uniform and keep 0.16
    to boxes and 0.15 to each other; here they are drawn as in all worlds with walls, such that all robots get by. What
    robots of the publication learn there besides, lanes, one-way conveyors and stops, no problem here asks for.
    Source: Y. Shaoul, I. Mishani, S. Vats, J. Li and M. Likhachev, *Multi-Robot Motion Planning with Diffusion Models*,
    ICLR 2025.

    Args:
        boxes: The map's.
        settings: The common arguments.
        side: Of the map [m]; by default 6 m, and in proportion to the number of robots' root for more than 20.
    """
    require_dimension(settings, 2)
    if side is None:
        side = SIDE * max(1.0, root(settings.num_robots / ROBOTS, 2))
    half = bounded(side, "side") / 2
    centres, sizes = np.split(half * np.array(boxes), 2, axis=1)
    world = World(2, boxes=np.hstack([centres - sizes / 2, centres + sizes / 2]), lower=[-half] * 2, upper=[half] * 2)
    return populate(settings, world, lattice_step(settings, [2 * half] * 2), 4 * half, "or a larger side")


AMSWARM: Mapping[str, tuple[str, Sequence[tuple[float, float]]]] = {
    "amswarm_1": ("ten 3D robots on a circle, no obstacles", ()),
    "amswarm_2": ("five cylinders close together in the centre", ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))),
    "amswarm_3": ("four cylinders around the centre", ((0, 1), (0, -1), (1, 0), (-1, 0))),
    "amswarm_4": (
        "a cylinder in the centre and four at the corners of a square", ((0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
    ),
    "amswarm_5": ("five cylinders, to one side", ((0, 0), (0, 1), (0, -1), (-1, 1), (-1, -1))),
}  # fmt: skip
"""Environments of AMSwarm, and where their cylinders are; see :func:`amswarm`."""


def amswarm(centres: Sequence[tuple[float, float]], settings: Settings, *, jitter: float = 0.0) -> Problem:
    """Ten 3D robots among cylinders: the paper's comparison with AMSwarm (section VIII).

    ``holonomic3d`` robots of radius 0.29 m with margin 0.05 m, antipodal on a circle of radius 2.5 m in the plane
    z = 0, in bounds of +-3 m. The obstacles are vertical cylinders of radius 0.2 m.

    Args:
        centres: x and y of the cylinders [m].
        settings: The common arguments; ten robots.
        jitter: Each coordinate of each start is moved by a uniform random number within +-``jitter`` [m].
    """
    require_dimension(settings, 3)
    if settings.num_robots != 10:
        raise ValueError(
            f"num_robots is {settings.num_robots}; scenario {settings.scenario!r} has exactly 10 robots, so leave "
            f"num_robots out, or use scenario 'circle' with model='holonomic3d'"
        )
    jitter = bounded(jitter, "jitter", zero_allowed=True)
    layout = antipodal_circle(settings, 5.0)
    moved = layout.starts + settings.generator(JITTER).uniform(-jitter, jitter, layout.starts.shape)
    world = World(dimension=3, cylinders=[(x, y, 0.2) for x, y in centres], lower=[-3.0] * 3, upper=[3.0] * 3)
    return build(settings, replace(layout, starts=moved, world=world))
