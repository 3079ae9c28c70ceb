"""Index of the obstacles: a grid with those that can be nearest to any point, however many there are.

Every cell keeps the clearance at its centre and the obstacles that are nearest to some point in it. Clearance changes
by no more than the distance between two points (it is 1-Lipschitz), so what it is at the centre decides nearly every
question about a point of the cell; where it does not, the cell's few obstacles do. Nothing is approximated.

A world too large for cells of the size asked for gets larger ones, which cost time and no exactness.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import FloatArray, Floats, Ints, read_only
from d4orm_env.geometry.grid_refinement import PAIRS_AT_ONCE, fill_grid
from d4orm_env.geometry.shapes import Shapes

MAX_BYTES = 64 * 2**20
"""Memory of an index."""

MAX_CELLS = 2**21

FREE_CELLS, CELLS_PER_OBSTACLE = 2**15, 2**8
"""No more cells than these allow: more would take longer to make than they save."""

WIDER = 4
"""Ratio of the cell sizes of one grid of an index and the next."""

_EPSILON = float(np.finfo(np.float32).eps)


class WorldIndex(NamedTuple):
    """A grid over a world of dimension ``d``; cells are numbered with the last axis fastest."""

    low: FloatArray  #: ``(d,)`` float32 lowest corner [m]
    scale: np.float32  #: ``()`` float32 one over the size of a cell [1/m]
    #: ``(2, d)`` float32 lowest and highest corner, infinite along an axis on which an obstacle has no end
    ends: FloatArray
    size: Ints  #: ``(d,)`` int32 cells along each axis; all zero in a world without obstacles
    #: ``()`` float32 by how much the clearance at the centre of its cell and that at a point may differ [m], rounding
    #: included
    slack: np.float32
    clearance: FloatArray  #: ``(C,)`` float32 at the centres [m], negative inside an obstacle
    first: Ints  #: ``(levels C + 1,)`` int32 where each cell's part of ``items`` begins
    #: int32 numbers of the obstacles, as in :class:`~d4orm_env.geometry.shapes.Shapes`, those of a cell by their
    #: distance from its centre
    items: Ints
    longest: np.int32  #: ``()`` int32 the most obstacles of any cell
    nearest: np.int32  #: ``()`` int32 how many of the nearest obstacles of any of its points a cell is sure to have
    #: ``()`` int32 for how many grids, one round the other, there are lists: each has ``C`` cells about one middle,
    #: ``WIDER`` times as large as those of the one inside it. All else is said of the first.
    levels: np.int32

    @property
    def num_bytes(self) -> int:
        """Memory of the grid."""
        return self.clearance.nbytes + self.first.nbytes + self.items.nbytes


def build_index(
    shapes: Shapes, cell: float, max_distance: float, nearest: int = 1, levels: int = 1, within: float = 0.0
) -> WorldIndex:
    """The index of some obstacles, in ``levels`` grids, one round the other.

    Cells have a size ``cell`` [m], or larger where there would be more than is worthwhile. The grid covers what is
    within ``max_distance`` of the obstacles [m], at least to where none of them counts. A cell's list is sure to hold
    the ``nearest`` obstacles of any of its points, and all ``within`` a distance [m].
    """
    if not shapes.count:
        nothing = np.zeros(0)
        corner = np.zeros(shapes.dimension)
        ends = np.stack([corner, corner])
        return _frozen(corner, 1.0, ends, corner, 0.0, nothing, nothing, nothing, 0, nearest, levels)
    while True:
        low, size, cell = _layout(shapes, cell, max_distance)
        index = _filled(shapes, low, size, cell, nearest, levels, within)
        if index.num_bytes <= MAX_BYTES or index.size.max() == 1:
            return index
        cell *= 1.5


def nearest_distance(shapes: Shapes, index: WorldIndex, points: Floats) -> Floats:
    """``(N,)`` signed distance from points ``(N, d)`` to the nearest of the obstacles [m]; there must be some."""
    distance = np.empty(len(points))
    inside, cell = _cells_of(points, index)
    # Beyond the grid every obstacle may be the nearest.
    begin = np.where(inside, index.first[cell], 0)
    count = np.where(inside, index.first[cell + 1] - begin, shapes.count)
    ends = np.cumsum(count)
    done = 0
    while done < len(points):
        before = ends[done - 1] if done else 0
        last = max(done + 1, int(np.searchsorted(ends, before + PAIRS_AT_ONCE)))
        own, starts = count[done:last], ends[done:last] - count[done:last] - before
        number = np.arange(own.sum()) - np.repeat(starts, own) + np.repeat(begin[done:last], own)
        items = np.where(
            np.repeat(inside[done:last], own), index.items[np.minimum(number, len(index.items) - 1)], number
        )
        gaps = shapes.signed_distance(np.repeat(points[done:last], own, axis=0), items)
        distance[done:last] = np.minimum.reduceat(gaps, starts)
        done = last
    return distance


def is_farther(shapes: Shapes, index: WorldIndex, points: Floats, distance: float) -> NDArray[np.bool_]:
    """``(N,)`` true where :func:`nearest_distance` is more than ``distance``, which the index must reach."""
    inside, cell = _cells_of(points, index)
    clearance, slack = index.clearance[cell], index.slack
    # Beyond the grid all is clear, but for obstacles without an end.
    beyond: NDArray[np.bool_] = np.any((points < index.ends[0]) | (points > index.ends[1]), axis=1)
    farther: NDArray[np.bool_] = beyond | (inside & (clearance - slack > distance))
    undecided = np.flatnonzero(~farther & ~(inside & (clearance + slack < distance)))
    farther[undecided] = nearest_distance(shapes, index, points[undecided]) > distance
    return farther


def _cells_of(points: Floats, index: WorldIndex) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """``(N,)`` true where a point lies within the grid, and the number of its cell, 0 elsewhere."""
    position = (points - index.low) * index.scale
    inside: NDArray[np.bool_] = np.all((position > 0) & (position < index.size), axis=1)
    cell = np.zeros(len(points), np.int64)
    cell[inside] = np.ravel_multi_index(tuple(position[inside].astype(np.int64).T), tuple(index.size))
    return inside, cell


def _layout(shapes: Shapes, cell: float, max_distance: float) -> tuple[Floats, NDArray[np.int64], float]:
    lower, upper = shapes.extent()
    most = min(MAX_CELLS, FREE_CELLS + CELLS_PER_OBSTACLE * shapes.count)
    while True:
        # So far that even a point beyond the grid is found to be clear in the outermost cell next to it.
        pad = max_distance + (1.5 + 2 * np.sqrt(len(lower)) / 2) * cell + 1e-3 * cell
        size = np.ceil((upper - lower + 2 * pad) / cell)
        if size.prod() <= most:
            return (lower + upper - size * cell) / 2, size.astype(np.int64), cell
        cell *= 1.1 * max(1.0, (size.prod() / most) ** (1 / len(lower)))


def _filled(
    shapes: Shapes, low: Floats, size: NDArray[np.int64], cell: float, nearest: int, levels: int, within: float
) -> WorldIndex:
    middle, half = low + size * cell / 2, size * cell / 2
    largest = np.abs([middle - half, middle + half]).max()
    rounding = 1e-3 * cell + 16 * _EPSILON * largest
    slack = cell * np.sqrt(len(low)) / 2 + rounding
    grids = []
    for level in range(levels):
        wider = WIDER**level
        # What the grid inside this one answers need not be worked out again.
        hole = half * wider / WIDER - 0.01 * cell if level else np.zeros(len(low))
        grids.append(fill_grid(shapes, middle, hole, size, cell * wider, rounding * wider, nearest, within))
    clearance, counts = grids[0].clearance, np.concatenate([grid.counts for grid in grids])
    first, items = np.concatenate([[0], np.cumsum(counts)]), np.concatenate([grid.items for grid in grids])
    ends = np.stack([low, low + size * cell])
    endless = ~np.isfinite(shapes.boxes[:, : len(low)]).all(axis=0)
    ends[:, endless] = [[-np.inf], [np.inf]]
    longest = grids[0].counts.max()
    return _frozen(low, 1 / cell, ends, size, slack, clearance, first, items, longest, nearest, levels)


_KINDS: tuple[Any, ...] = (*(np.float32,) * 3, np.int32, *(np.float32,) * 2, *(np.int32,) * 5)
"""Of the fields of :class:`WorldIndex`, in their order."""


def _frozen(*parts: ArrayLike) -> WorldIndex:
    """The index of these parts, as engines read it."""
    return read_only(WorldIndex(*(kind(part) for kind, part in zip(_KINDS, parts, strict=True))))
