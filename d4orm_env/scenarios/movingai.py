"""Maps and scenarios in the formats of the Moving AI Lab, https://movingai.com/benchmarks/formats.html.

The League of Robot Runners has maps of its own in that format, with emitter and service points, both free.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from d4orm_env.scenarios.grid_map import MAX_CELLS, GridMap

PASSABLE, BLOCKED = b".GSE", b"@OTW"
"""Ground, swamp or service points, emitters; out of bounds, trees and water."""
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
"""Prefix that some editors put before UTF-8 text."""


def parse_map(content: bytes, cell: float) -> GridMap:
    """A ``.map`` file.

    Args:
        content: Of the file.
        cell: Side of a cell [m].

    Raises:
        ValueError: If it is none; one line without the file's name.
    """
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
    """The first rows of a ``.scen`` file.

    Args:
        content: Of the file.
        shape: Rows and columns of its map.
        count: Number of rows.

    Raises:
        ValueError: If it is no such file, is of another map, or has fewer rows; one line without the file's name.
    """
    # Split as bytes: of text more would end a line, such as the ellipsis of a map's name.
    lines = [line.decode("latin-1") for line in content.removeprefix(BYTE_ORDER_MARK).splitlines()]
    if not lines or lines[0].split()[:1] != ["version"]:
        raise ValueError("is not a Moving AI scenario; it must begin with a line 'version 1'")
    tasks: list[MapTask] = []
    for number, line in enumerate(lines[1:], 2):
        if len(tasks) < count and line.strip():
            tasks.append(_task(line, number, shape))
    if len(tasks) < count:
        raise ValueError(f"has {len(tasks)} rows for {count} robots; use num_robots={len(tasks)} or another file")
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
            raise ValueError(f"names the cell ({column}, {row}) in line {number}, which is not on the map")
    if not (math.isfinite(path_length) and path_length >= 0):
        raise ValueError(f"gives a length of {path_length} in line {number}; it must be zero or more and finite")
    return MapTask(number, start, goal, path_length)


def _count(text: bytes, name: str) -> int:
    if not text.isdigit() or len(text) > 9 or int(text) == 0:
        raise ValueError(f"has {text.decode('latin-1')!r} as its {name}; it must be a whole number of at least 1")
    return int(text)
