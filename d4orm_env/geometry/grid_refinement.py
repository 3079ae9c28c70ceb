"""The obstacles that may be nearest in each cell of a grid, found from coarse to fine.

What cannot be nearest in a cell cannot be so in its parts.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import Floats, Ints
from d4orm_env.geometry.shapes import Shapes

CROWDED = 8
"""Obstacles of a cell beyond which it is worthwhile to look closer at which of them count."""

FEW = 8
"""Ranks up to which it is quicker to take the nearest away one by one than to sort."""

_CORNERS = {d: np.array(list(product((-0.5, 0.5), repeat=d))) for d in (2, 3)}

PAIRS_AT_ONCE = 2**16
"""Cells times obstacles whose distances are worked out in one go, in a processor's cache."""


class _Cells(NamedTuple):
    """Cells of one size: ``grid_index`` ``(C, d)``, and pairs of a cell and an obstacle, sorted by cell."""

    grid_index: NDArray[np.int64]
    cell: NDArray[np.int64]
    item: NDArray[np.int64]


class FilledGrid(NamedTuple):
    """``(C,)`` clearance at the cells' centres and numbers of their obstacles, and these, cell by cell."""

    clearance: Floats
    counts: NDArray[np.int64]
    items: Ints


def fill_grid(
    shapes: Shapes, middle: Floats, hole: Floats, size: NDArray[np.int64], cell: float, rounding: float, nearest: int,
    within: float,
) -> FilledGrid:  # fmt: skip
    """The grid of cells of this size about a middle; see :func:`_refined`."""
    leaves = list(_refined(shapes, middle, hole, size, cell, rounding, nearest, within))
    number = [np.ravel_multi_index(tuple(part.grid_index.T), tuple(size)) for part, _ in leaves]
    clearance, counts = np.empty(size.prod()), np.empty(size.prod(), np.int64)
    for own, (part, gap) in zip(number, leaves, strict=True):
        clearance[own], counts[own] = gap, np.bincount(part.cell, minlength=len(own))
    first = np.concatenate([[0], np.cumsum(counts)])
    items = np.empty(first[-1], np.int32)
    for own, (part, _) in zip(number, leaves, strict=True):
        before = np.arange(len(part.cell)) - np.searchsorted(part.cell, part.cell)
        items[first[own[part.cell]] + before] = part.item
    return FilledGrid(clearance, counts, items)


def _refined(
    shapes: Shapes, middle: Floats, hole: Floats, size: NDArray[np.int64], cell: float, rounding: float, nearest: int,
    within: float,
) -> Iterator[tuple[_Cells, Floats]]:  # fmt: skip
    """All cells of a grid with the obstacles that count there, and the clearance at their centres, part by part.

    Cells no farther than ``hole`` from the middle get hardly any.
    """
    low, turn = middle - size * cell / 2, _Turn.of(shapes)
    levels = 0
    while shapes.count * np.ceil(size / 2**levels).prod() > PAIRS_AT_ONCE and 2**levels < size.max():
        levels += 1
    coarse = np.stack(np.meshgrid(*(np.arange(np.ceil(n / 2**levels)) for n in size), indexing="ij"), axis=-1)
    grid_index = coarse.reshape(-1, len(size)).astype(np.int64)
    every = np.repeat(np.arange(len(grid_index)), shapes.count)
    waiting = [(levels, _Cells(grid_index, every, np.tile(np.arange(shapes.count), len(grid_index))))]
    while waiting:
        level, cells = waiting.pop()
        width = cell * 2**level
        centre = low + (cells.grid_index + 0.5) * width
        # Side by side along each axis, which is quicker to read.
        points = np.stack([column.take(cells.cell) for column in centre.T]).T
        distance = shapes.signed_distance(points, cells.item)
        bounds = np.searchsorted(cells.cell, np.arange(len(cells.grid_index)))
        clearance, diagonal = np.minimum.reduceat(distance, bounds), width * np.sqrt(len(size))
        bar = _smallest(distance, cells.cell, bounds, nearest) + diagonal * turn.at_most(centre, diagonal / 2)
        bar = np.maximum(bar, within + diagonal / 2) if within else bar
        unasked: NDArray[np.bool_] = np.all(np.abs(centre - middle) <= hole - width / 2, axis=1)
        bar = np.where(unasked, clearance, bar) + 2 * rounding
        near = np.flatnonzero(distance <= bar.take(cells.cell))
        cells = _Cells(cells.grid_index, cells.cell.take(near), cells.item.take(near))
        if level == 0:
            distance = distance.take(near)
            if nearest == 1 and not within:
                keep = ~_hidden(shapes, centre, cells, distance, width, 2 * rounding)
                cells, distance = _Cells(cells.grid_index, cells.cell[keep], cells.item[keep]), distance[keep]
            yield _nearest_first(cells, distance), clearance
            continue
        for part in _halved(cells):
            waiting.append((level - 1, _split(part, np.ceil(size / 2 ** (level - 1)))))


def _nearest_first(cells: _Cells, distance: Floats) -> _Cells:
    """Return cells with the obstacles of each in the order of their distance."""
    # Most cells have one only.
    several = np.flatnonzero(np.bincount(cells.cell, minlength=len(cells.grid_index))[cells.cell] > 1)
    items = cells.item.copy()
    items[several] = items[several[np.lexsort((distance[several], cells.cell[several]))]]
    return _Cells(cells.grid_index, cells.cell, items)


def _hidden(
    shapes: Shapes, centre: Floats, cells: _Cells, distance: Floats, width: float, rounding: float
) -> NDArray[np.bool_]:
    """Mark the pairs of a crowded cell and a box that do not count: the obstacle nearest to the cell's centre,
    or to one of its corners, is nearer everywhere in the cell.

    Distance from a convex shape is a convex function: no less than its tangent at the centre. Another one's, taken
    from that tangent, leaves a concave function, whose least value over the cell is at a corner of it.
    """
    hidden = np.zeros(len(cells.cell), bool)
    asked = np.flatnonzero(np.bincount(cells.cell, minlength=len(centre))[cells.cell] > CROWDED)
    if not len(asked):
        return hidden
    cell, item, offsets = cells.cell[asked], cells.item[asked], width * _CORNERS[centre.shape[1]]
    at_corners = np.stack([shapes.signed_distance(centre[cell] + offset, item) for offset in offsets], axis=1)
    boxes = np.flatnonzero(item < len(shapes.boxes))
    tangent = distance[asked[boxes], None] + shapes.box_slope(centre[cell[boxes]], item[boxes]) @ offsets.T
    bounds, own = np.unique(cell, return_index=True, return_inverse=True)[1:]
    for gap in (distance[asked], *at_corners.T):
        nearest = at_corners[np.lexsort((gap, cell))[bounds]]
        hidden[asked[boxes]] |= (tangent - nearest[own[boxes]]).min(axis=1) > rounding
    return hidden


class _Turn(NamedTuple):
    """Bound on the angle between the directions to two obstacles. All lie in a ball of this middle and radius, along
    the axes on which they end.
    """

    axes: NDArray[np.bool_]
    middle: Floats
    radius: float

    @classmethod
    def of(cls, shapes: Shapes) -> _Turn:
        lower, upper = shapes.extent()
        ended = np.isfinite(shapes.boxes[:, : shapes.dimension])
        axes: NDArray[np.bool_] = np.all(ended, axis=0)
        # Where some end and others do not, the directions may be anything.
        radius = np.inf if (ended.any(axis=0) & ~axes).any() else float(np.linalg.norm((upper - lower)[axes])) / 2
        return cls(axes, (lower + upper) / 2, radius)

    def at_most(self, positions: Floats, max_distance: float) -> Floats:
        """``(N,)`` half of the length of the difference of two such directions, as unit vectors, anywhere within
        ``max_distance`` of positions ``(N, d)``: no two obstacles' distances change more differently than by twice it.
        """
        distance = np.linalg.norm((positions - self.middle)[:, self.axes], axis=1) - max_distance
        return np.minimum(1.0, self.radius / np.maximum(distance, 1e-9))


def _smallest(distance: Floats, cell: NDArray[np.int64], bounds: NDArray[np.int64], nearest: int) -> Floats:
    """``(C,)`` distance of the obstacle of this rank in every cell; of the last one where there are fewer."""
    smallest: Floats = np.minimum.reduceat(distance, bounds)
    if nearest == 1:
        return smallest
    if nearest > FEW:
        ordered = distance[np.lexsort((distance, cell))]
        last = np.append(bounds[1:], len(cell)) - 1
        return ordered[np.minimum(bounds + nearest - 1, last)]
    left = distance.copy()
    for _ in range(nearest - 1):
        # Without the first one of every cell that is as near as its nearest.
        at = np.flatnonzero(left == smallest[cell])
        left[at[np.diff(cell[at], prepend=-1) > 0]] = np.inf
        next_ones = np.minimum.reduceat(left, bounds)
        smallest = np.where(np.isfinite(next_ones), next_ones, smallest)
    return smallest


def _halved(cells: _Cells) -> Iterator[_Cells]:
    """The cells, in parts small enough to be split."""
    parts = -(-(len(cells.item) << cells.grid_index.shape[1]) // PAIRS_AT_ONCE)
    ends = np.searchsorted(
        cells.cell, np.linspace(0, len(cells.grid_index), min(parts, len(cells.grid_index)) + 1).astype(int)
    )
    for begin, end in pairwise(ends):
        if begin < end:
            first, last = cells.cell[begin], cells.cell[end - 1]
            yield _Cells(cells.grid_index[first : last + 1], cells.cell[begin:end] - first, cells.item[begin:end])


def _split(cells: _Cells, size: Floats) -> _Cells:
    """Every cell cut in two along each axis; parts beyond the grid are left out."""
    indices, owners, items, count = [], [], [], 0
    for corner in product((0, 1), repeat=len(size)):
        grid_index = 2 * cells.grid_index + corner
        inside: NDArray[np.bool_] = np.all(grid_index < size, axis=1)
        kept = inside[cells.cell]
        indices.append(grid_index[inside])
        owners.append(count + (np.cumsum(inside) - 1)[cells.cell[kept]])
        items.append(cells.item[kept])
        count += int(inside.sum())
    return _Cells(np.concatenate(indices), np.concatenate(owners), np.concatenate(items))
