"""Near neighbours among many points, compiled with numba: points sorted into cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import Floats, IntArray, Ints, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined


class Cells(NamedTuple):
    """Points by the cell that they lie in."""

    points: Floats  #: ``(N, 3)`` [m]
    low: Floats  #: ``(3,)`` lowest corner [m]
    size: IntArray  #: ``(3,)`` int64 cells along each axis
    width: float  #: Of a cell [m]
    first: IntArray  #: ``(C + 1,)`` int64 where the points of each cell begin in ``items``
    items: IntArray  #: ``(N,)`` int64 numbers of the points, cell by cell


def sort_into_cells(points: Floats, width: float) -> Cells:
    """Sort points ``(N, 3)`` into cells of this width [m], or larger where there would be many more than points."""
    low, high = points.min(axis=0), points.max(axis=0)
    while np.floor((high - low) / width + 1).prod() > 4 * len(points) + 64:
        width *= 1.25
    size = np.floor((high - low) / width).astype(np.int64) + 1
    index = np.minimum(((points - low) / width).astype(np.int64), size - 1)
    cell = (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2]
    first = np.zeros(size.prod() + 1, np.int64)
    first[1:] = np.cumsum(np.bincount(cell, minlength=size.prod()))
    return Cells(points, low, size, width, first, np.argsort(cell, kind="stable"))


@inlined
def cell_range(cells: Cells, axis: int, lowest: float, highest: float) -> tuple[int, int]:
    """The first cell along an axis that a stretch touches, and the one after its last."""
    first = int(np.floor((lowest - cells.low[axis]) / cells.width))
    last = int(np.floor((highest - cells.low[axis]) / cells.width))
    return min(max(first, 0), cells.size[axis]), max(min(last, cells.size[axis] - 1) + 1, 0)


@inlined
def items_in(cells: Cells, i: int, j: int, low: int, high: int) -> tuple[Whole, Whole]:
    """The first of ``items`` in a row of cells along the last axis, and the one after the last."""
    row = (i * cells.size[1] + j) * cells.size[2]
    return cells.first[row + low], cells.first[row + high]


@inlined
def cells_about(
    cells: Cells, tail: Floats, head: Floats, distance: float
) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
    """Along each axis the range of cells with all that may be within ``distance`` of the line between two points."""
    return (
        cell_range(cells, 0, min(tail[0], head[0]) - distance, max(tail[0], head[0]) + distance),
        cell_range(cells, 1, min(tail[1], head[1]) - distance, max(tail[1], head[1]) + distance),
        cell_range(cells, 2, min(tail[2], head[2]) - distance, max(tail[2], head[2]) + distance),
    )


@compiled
def squared_gap(points: Floats, u: Whole, tails: Floats, v: Whole, heads: Floats, w: Whole) -> float:
    """Squared distance of point ``u`` to the line from ``tails[v]`` to ``heads[w]``."""
    ax, ay, az = heads[w, 0] - tails[v, 0], heads[w, 1] - tails[v, 1], heads[w, 2] - tails[v, 2]
    ox, oy, oz = points[u, 0] - tails[v, 0], points[u, 1] - tails[v, 1], points[u, 2] - tails[v, 2]
    square = ax * ax + ay * ay + az * az
    share = 0.0
    if square > 0.0:
        share = min(max((ox * ax + oy * ay + oz * az) / square, 0.0), 1.0)
    dx, dy, dz = ox - share * ax, oy - share * ay, oz - share * az
    return dx * dx + dy * dy + dz * dz


@cached_kernel(variant="near", **OPTIONS)
def near_lines(
    cells: Cells, tails: Floats, heads: Floats, distance: float, first: IntArray, items: Ints, after: bool
) -> int:
    """Find the points that come within ``distance`` of lines.

    Args:
        cells: The ``N`` points.
        tails: ``(Q, 3)`` ends of the lines.
        heads: ``(Q, 3)``.
        distance: [m].
        first: ``(Q + 1,)`` int64 where those of each line begin in ``items``, output.
        items: ``(room,)`` int32 numbers of points, ascending per line, output as far as there is room.
        after: Whether only points with numbers greater than that of the line are wanted.

    Returns:
        How many there are.
    """
    count = 0
    for q in range(tails.shape[0]):
        first[q] = count
        (low_i, high_i), (low_j, high_j), (low_k, high_k) = cells_about(cells, tails[q], heads[q], distance)
        for i in range(low_i, high_i):
            for j in range(low_j, high_j):
                begin, end = items_in(cells, i, j, low_k, high_k)
                for number in range(begin, end):
                    point = cells.items[number]
                    if after and point <= q:
                        continue
                    if squared_gap(cells.points, point, tails, q, heads, q) < distance * distance:
                        if count < items.shape[0]:
                            place = count
                            while place > first[q] and items[place - 1] > point:
                                items[place] = items[place - 1]
                                place -= 1
                            items[place] = point
                        count += 1
    first[tails.shape[0]] = count
    return count


def find_near(
    cells: Cells, tails: Floats, heads: Floats, distance: float, after: bool = False
) -> tuple[IntArray, Ints]:
    """``(first, items)`` of :func:`near_lines`."""
    first, room = np.empty(len(tails) + 1, np.int64), 16 * len(tails)
    while True:
        items = np.empty(room, np.int32)
        count = near_lines(cells, tails, heads, distance, first, items, after)
        if count <= room:
            return first, items[:count]
        room = count
