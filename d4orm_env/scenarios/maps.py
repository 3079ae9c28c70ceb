"""Maps from files, as worlds and as a scenario: those of the Moving AI Lab and of ROS."""

from __future__ import annotations

import math
import os
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.core.files import checked_path, is_yaml_path, naming, read_limited
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios.grid_map import MAX_BYTES, MAX_CELLS, GridMap, grid_of_fields, read_occupancy_image
from d4orm_env.scenarios.layout import Layout, build
from d4orm_env.scenarios.settings import Settings, bounded, require_dimension
from d4orm_env.scenarios.well_formed import FreeSpace, free_space, populate, safety_distance_of, with_obstacles

PASSABLE, BLOCKED = b".GSE", b"@OTW"
"""Ground, swamp or service points, emitters; out of bounds, trees and water."""
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
"""Prefix that some editors put before UTF-8 text."""


@lru_cache(maxsize=4)
def parse_map(content: bytes, cell: float) -> GridMap:
    """The map of a ``.map`` file's content, of cells with this side [m]."""
    lines = content.removeprefix(BYTE_ORDER_MARK).splitlines()
    height, width = _size(lines)
    rows = [row.rstrip() for row in lines[4:]]
    while rows and not rows[-1]:
        rows.pop()
    if len(rows) != height:
        raise ValueError(f"has {len(rows)} rows of cells where its height is {height}; give as many")
    for number, row in enumerate(rows):
        if len(row) != width:
            raise ValueError(f"has {len(row)} cells in line {number + 5} where its width is {width}; give as many")
    cells = np.frombuffer(b"".join(rows), np.uint8).reshape(height, width)
    blocked = np.isin(cells, np.frombuffer(BLOCKED, np.uint8))
    unknown = np.argwhere(~blocked & ~np.isin(cells, np.frombuffer(PASSABLE, np.uint8)))
    if len(unknown):
        row, column = unknown[0]
        raise ValueError(
            f"has {chr(cells[row, column])!r} in line {row + 5}, column {column + 1}; cells are "
            f"{' '.join(PASSABLE.decode())} (free) and {' '.join(BLOCKED.decode())} (blocked)"
        )
    return GridMap(blocked, cell)


def _size(lines: list[bytes]) -> tuple[int, int]:
    """Rows and columns that the first lines of a map tell."""
    header: dict[bytes, bytes] = {}
    while len(header) < len(lines) and lines[len(header)].strip() != b"map":
        name, value = (*lines[len(header)].split(None, 1), b"", b"")[:2]
        if name not in (b"type", b"height", b"width") or name in header:
            break
        header[name] = value.strip()
    if len(header) < 3 or len(lines) == 3 or lines[3].strip() != b"map":
        raise ValueError(
            "is not a Moving AI map; it must begin with lines 'type octile', 'height ...', 'width ...', 'map'"
        )
    height, width = (_count(header[name], name.decode()) for name in (b"height", b"width"))
    if height * width > MAX_CELLS:
        raise ValueError(f"has {height} x {width} cells; at most {MAX_CELLS} are read")
    return height, width


class MapTask(NamedTuple):
    """A row of a ``.scen`` file: cells as column and row, the upper left one being (0, 0), and the path in cells."""

    line: int
    start: tuple[int, int]
    goal: tuple[int, int]
    path_length: float


def parse_scenario(content: bytes, shape: tuple[int, int], count: int) -> list[MapTask]:
    """The first ``count`` rows of a ``.scen`` file's content; ``shape`` is rows and columns of its map."""
    # Split as bytes: of text more would end a line, such as the ellipsis of a map's name.
    lines = [line.decode("latin-1") for line in content.removeprefix(BYTE_ORDER_MARK).splitlines()]
    if not lines or lines[0].split()[:1] != ["version"]:
        raise ValueError("is not a Moving AI scenario; it must begin with a line 'version 1'")
    tasks: list[MapTask] = []
    for number, line in enumerate(lines[1:], 2):
        if len(tasks) < count and line.strip():
            tasks.append(_task(line, number, shape))
    if len(tasks) < count:
        fewer = f"num_robots={len(tasks)} or " if tasks else ""
        raise ValueError(f"has {len(tasks)} rows for {count} robots; use {fewer}another file")
    return tasks


def _task(line: str, number: int, shape: tuple[int, int]) -> MapTask:
    try:
        width, height, *cells = (int(value) for value in line.split()[-7:-1])
        start, goal, path_length = (cells[0], cells[1]), (cells[2], cells[3]), float(line.split()[-1])
    except (ValueError, IndexError):
        raise ValueError(
            f"has a line {number} that is not bucket, map, width, height, start x, start y, goal x, goal y and length"
        ) from None
    if (height, width) != shape:
        raise ValueError(
            f"is for a map of width {width} and height {height} in line {number}, and the map has {shape[1]} and "
            f"{shape[0]}; give the file that belongs to the map"
        )
    for column, row in (start, goal):
        if not (0 <= column < width and 0 <= row < height):
            raise ValueError(f"names the cell ({column}, {row}) in line {number}, which is not on the map; correct it")
    if not (math.isfinite(path_length) and path_length >= 0):
        raise ValueError(f"gives a length of {path_length} in line {number}; it must be zero or more and finite")
    return MapTask(number, start, goal, path_length)


def _count(text: bytes, name: str) -> int:
    if not text.isdigit() or len(text) > 9 or int(text) == 0:
        raise ValueError(f"has {text.decode('latin-1')!r} as its {name}; it must be a whole number of at least 1")
    return int(text)


PathLike: TypeAlias = str | os.PathLike[str]


IMAGES = (".png", ".pgm")


def load_map(path: PathLike, cell: float = 0.6, resolution: float | None = None) -> World:
    """The world of a map: its blocked cells, merged into few boxes, and bounds around it; y goes up.

    Args:
        path: A ``.map`` file in the format of the Moving AI Lab, whose lower left corner is at the origin: ``.``, ``G``
            ``S`` and ``E`` are free, ``@``, ``O``, ``T`` and ``W`` are blocked. Or the YAML file of ROS's map_server,
            with its ``.png`` or ``.pgm`` image beside it: what is not known to be free is blocked, transparent pixels
            too. Where its origin is so far out that float32 does not resolve the cells, as UTM coordinates are, the
            world begins at zero and has the origin as its :attr:`~d4orm_env.World.origin`. Or such an image alone.
        cell: Side of a cell of a ``.map`` file [m]; a map_server file has a resolution of its own.
        resolution: Side of a pixel of an image without a YAML file [m], whose lower left corner is at the origin.

    Raises:
        ValueError: If the file cannot be read or is no map, one line that names it.
    """
    return read_map(path, cell, resolution).world


def read_map(path: PathLike, cell: float = 0.6, resolution: float | None = None) -> GridMap:
    """Read a map as :func:`load_map`; the same object for the same content."""
    cell = bounded(cell, "cell")
    file = checked_path(path, "a map")
    with naming(file):
        if file.suffix.lower() in IMAGES:
            if resolution is None:
                file.stat()  # where there is none, that is what to tell
                raise ValueError("is an image without its map_server YAML file; give resolution=, its metres per pixel")
            return grid_of_fields({"image": file.name, "resolution": resolution, "origin": [0, 0, 0]}, file.parent)
        if resolution is not None:
            kinds = " or ".join(IMAGES)
            raise ValueError(f"is no {kinds} image, and only these take a resolution; leave it out, or convert it")
        if is_yaml_path(file):
            return read_occupancy_image(file)
        return parse_map(read_limited(file, "a map", MAX_BYTES), cell)


def map(
    settings: Settings, *, map: PathLike | None = None, cell: float = 0.6, resolution: float | None = None,
    scenario_file: PathLike | None = None,
) -> Problem:  # fmt: skip
    """A map from a file; starts and goals anywhere on it, or those of a Moving AI scenario.

    Positions are drawn from the largest connected region that is wide enough for the largest robot, by the seed.

    Args:
        settings: The common arguments.
        map: A Moving AI ``.map`` file, or the YAML file of ROS's map_server; see :func:`load_map`.
        cell: Side of a cell of a ``.map`` file [m].
        resolution: Side of a pixel of an image without a YAML file [m].
        scenario_file: A Moving AI ``.scen`` file, whose first ``num_robots`` rows say from where to where robots go.
    """
    if map is None:
        raise ValueError(
            f"scenario {settings.scenario!r} needs map=, the path of a .map file, of a map_server .yaml file, or of a "
            ".png or .pgm image with its resolution="
        )
    require_dimension(settings, 2)
    grid, safety_distance = read_map(map, cell, resolution), safety_distance_of(settings)
    step = grid.lattice_step(safety_distance)
    space = free_space(grid.world, safety_distance, step)
    if scenario_file is None:
        remedy = "a larger map, larger cells or smaller robots"
        return populate(settings, grid.world, step, space.longest_path, remedy)
    starts, goals, travel = _listed_positions(settings, grid, space, Path(scenario_file))
    world = with_obstacles(settings, grid.world, np.vstack([starts, goals]))
    with naming(Path(scenario_file)):  # whose rows may start or end in one cell
        return build(settings, Layout(starts, goals, world, travel))


def _listed_positions(settings: Settings, grid: GridMap, space: FreeSpace, path: Path) -> tuple[Floats, Floats, float]:
    """Starts and goals of a Moving AI scenario, and the longest path [m]."""
    with naming(path):
        tasks = parse_scenario(read_limited(path, "a map", MAX_BYTES), grid.blocked.shape, settings.num_robots)
        for task in tasks:
            for what, cell in (("start", task.start), ("goal", task.goal)):
                if grid.blocked[cell[::-1]]:
                    at = f"({cell[0]}, {cell[1]}) in line {task.line}"
                    raise ValueError(f"has a {what} at {at}, a blocked cell; give the file that belongs to the map")
                if not space.contains(grid.centres(np.array([cell]))[0]):
                    raise ValueError(
                        f"has a {what} at ({cell[0]}, {cell[1]}) in line {task.line}, which robots of radius "
                        f"{np.max(settings.team.radius):g} m with margin {settings.margin:g} m do not get to; "
                        f"use larger cells or smaller robots"
                    )
    starts, goals = (grid.centres(np.array([getattr(task, what) for task in tasks])) for what in ("start", "goal"))
    straight = np.linalg.norm(goals - starts, axis=1)
    return starts, goals, float(max(straight.max(), grid.cell * max(task.path_length for task in tasks)))
