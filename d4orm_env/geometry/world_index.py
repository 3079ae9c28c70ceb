"""Index of the obstacles: a grid that tells for any point which of them can be nearest, however many there are.

Every cell keeps the clearance at its centre and the obstacles that are nearest to some point in it. Clearance changes
by no more than the distance between two points (it is 1-Lipschitz), so what it is at the centre decides nearly every
question about a point of the cell; where it does not, the cell's few obstacles do. Nothing is approximated.

The grid is refined from coarse to fine: what cannot be nearest in a cell cannot be so in its parts. A world too large
for cells of the size asked for gets larger ones, which cost time and no exactness.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import FloatArray, Floats, Ints
from d4orm_env.geometry.shapes import Shapes

MAX_BYTES = 64 * 2**20
"""Memory of an index."""

MAX_CELLS = 2**21

FREE_CELLS, CELLS_PER_OBSTACLE = 2**15, 2**8
"""No more cells than these allow: more would take longer to make than they save."""

WIDER = 4
"""Ratio of the cell sizes of one grid of an index and the next."""

CROWDED = 8
"""Obstacles of a cell beyond which it is worthwhile to look closer at which of them count."""

FEW = 8
"""Ranks up to which it is quicker to take the nearest away one by one than to sort."""

_CORNERS = {d: np.array(list(product((-0.5, 0.5), repeat=d))) for d in (2, 3)}

_PAIRS_AT_ONCE = 2**16
"""Cells times obstacles whose distances are worked out in one go, in a processor's cache."""

_EPSILON = float(np.finfo(np.float32).eps)


class WorldIndex(NamedTuple):
    """A grid over a world of dimension ``d``; cells are numbered with the last axis fastest.

    Attributes:
        low: ``(d,)`` float32 lowest corner [m].
        scale: ``()`` float32 one over the size of a cell [1/m].
        ends: ``(2, d)`` float32 lowest and highest corner, infinite along an axis on which an obstacle has no end.
        size: ``(d,)`` int32 cells along each axis; all zero in a world without obstacles.
        slack: ``()`` float32 by how much the clearance at the centre of its cell and that at a point may differ [m],
            rounding included.
        clearance: ``(C,)`` float32 at the centres [m], negative inside an obstacle.
        first: ``(levels C + 1,)`` int32 where each cell's part of ``items`` begins.
        items: int32 numbers of the obstacles, as in :class:`~d4orm_env.geometry.shapes.Shapes`, those of a cell by
            their distance from its centre.
        longest: ``()`` int32 the most obstacles of any cell.
        nearest: ``()`` int32 how many of the nearest obstacles of any of its points a cell is sure to have.
        levels: ``()`` int32 for how many grids, one round the other, there are lists: each has ``C`` cells about the
            same middle, ``WIDER`` times as large as those of the one inside it. All else is said of the first.
    """

    low: FloatArray
    scale: np.float32
    ends: FloatArray
    size: Ints
    slack: np.float32
    clearance: FloatArray
    first: Ints
    items: Ints
    longest: np.int32
    nearest: np.int32
    levels: np.int32

    @property
    def num_bytes(self) -> int:
        """Memory of the grid."""
        return self.clearance.nbytes + self.first.nbytes + self.items.nbytes


class _Cells(NamedTuple):
    """Cells of one size: ``place`` ``(C, d)``, and pairs of a cell and an obstacle, sorted by cell."""

    place: NDArray[np.int64]
    cell: NDArray[np.int64]
    item: NDArray[np.int64]


def build_index(
    shapes: Shapes, cell: float, reach: float, nearest: int = 1, levels: int = 1, within: float = 0.0
) -> WorldIndex:
    """The index of some obstacles.

    Args:
        shapes: The obstacles.
        cell: Size of a cell [m]; larger where there would be more cells than is worthwhile.
        reach: Distance from the obstacles that the grid covers [m]; at least to where none of them counts.
        nearest: Number of nearest obstacles of any point that a cell's list is sure to hold.
        levels: Number of grids, one round the other.
        within: Distance of all those that a cell's list is sure to hold [m]; zero for the nearest only.
    """
    if not shapes.count:
        nothing = np.zeros(0)
        corner = np.zeros(shapes.dimension)
        ends = np.stack([corner, corner])
        return _frozen(corner, 1.0, ends, corner, 0.0, nothing, nothing, nothing, 0, nearest, levels)
    while True:
        low, size, cell = _layout(shapes, cell, reach)
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
        last = max(done + 1, int(np.searchsorted(ends, before + _PAIRS_AT_ONCE)))
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
    place = (points - index.low) * index.scale
    inside: NDArray[np.bool_] = np.all((place > 0) & (place < index.size), axis=1)
    cell = np.zeros(len(points), np.int64)
    cell[inside] = np.ravel_multi_index(tuple(place[inside].astype(np.int64).T), tuple(index.size))
    return inside, cell


def _layout(shapes: Shapes, cell: float, reach: float) -> tuple[Floats, NDArray[np.int64], float]:
    lower, upper = shapes.extent()
    most = min(MAX_CELLS, FREE_CELLS + CELLS_PER_OBSTACLE * shapes.count)
    while True:
        # So far that even a point beyond the grid is found to be clear in the outermost cell next to it.
        pad = reach + (1.5 + 2 * np.sqrt(len(lower)) / 2) * cell + 1e-3 * cell
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
        grids.append(_grid(shapes, middle, hole, size, cell * wider, rounding * wider, nearest, within))
    clearance, counts = grids[0].clearance, np.concatenate([grid.counts for grid in grids])
    first, items = np.concatenate([[0], np.cumsum(counts)]), np.concatenate([grid.items for grid in grids])
    ends = np.stack([low, low + size * cell])
    endless = ~np.isfinite(shapes.boxes[:, : len(low)]).all(axis=0)
    ends[:, endless] = [[-np.inf], [np.inf]]
    longest = grids[0].counts.max()
    return _frozen(low, 1 / cell, ends, size, slack, clearance, first, items, longest, nearest, levels)


class _Grid(NamedTuple):
    """``(C,)`` clearance at the cells' centres and numbers of their obstacles, and these, cell by cell."""

    clearance: Floats
    counts: NDArray[np.int64]
    items: Ints


def _grid(
    shapes: Shapes, middle: Floats, hole: Floats, size: NDArray[np.int64], cell: float, rounding: float, nearest: int,
    within: float,
) -> _Grid:  # fmt: skip
    leaves = list(_refined(shapes, middle, hole, size, cell, rounding, nearest, within))
    number = [np.ravel_multi_index(tuple(part.place.T), tuple(size)) for part, _ in leaves]
    clearance, counts = np.empty(size.prod()), np.empty(size.prod(), np.int64)
    for own, (part, gap) in zip(number, leaves, strict=True):
        clearance[own], counts[own] = gap, np.bincount(part.cell, minlength=len(own))
    first = np.concatenate([[0], np.cumsum(counts)])
    items = np.empty(first[-1], np.int32)
    for own, (part, _) in zip(number, leaves, strict=True):
        before = np.arange(len(part.cell)) - np.searchsorted(part.cell, part.cell)
        items[first[own[part.cell]] + before] = part.item
    return _Grid(clearance, counts, items)


def _refined(
    shapes: Shapes, middle: Floats, hole: Floats, size: NDArray[np.int64], cell: float, rounding: float, nearest: int,
    within: float,
) -> Iterator[tuple[_Cells, Floats]]:  # fmt: skip
    """All cells of a grid with the obstacles that count there, and the clearance at their centres, part by part.

    Cells no farther than ``hole`` from the middle get hardly any.
    """
    low, turn = middle - size * cell / 2, _Turn.of(shapes)
    levels = 0
    while shapes.count * np.ceil(size / 2**levels).prod() > _PAIRS_AT_ONCE and 2**levels < size.max():
        levels += 1
    coarse = np.stack(np.meshgrid(*(np.arange(np.ceil(n / 2**levels)) for n in size), indexing="ij"), axis=-1)
    place = coarse.reshape(-1, len(size)).astype(np.int64)
    every = np.repeat(np.arange(len(place)), shapes.count)
    waiting = [(levels, _Cells(place, every, np.tile(np.arange(shapes.count), len(place))))]
    while waiting:
        level, cells = waiting.pop()
        width = cell * 2**level
        centre = low + (cells.place + 0.5) * width
        # Side by side along each axis, which is quicker to read.
        points = np.stack([column.take(cells.cell) for column in centre.T]).T
        distance = shapes.signed_distance(points, cells.item)
        bounds = np.searchsorted(cells.cell, np.arange(len(cells.place)))
        clearance, diagonal = np.minimum.reduceat(distance, bounds), width * np.sqrt(len(size))
        bar = _smallest(distance, cells.cell, bounds, nearest) + diagonal * turn.at_most(centre, diagonal / 2)
        bar = np.maximum(bar, within + diagonal / 2) if within else bar
        unasked: NDArray[np.bool_] = np.all(np.abs(centre - middle) <= hole - width / 2, axis=1)
        bar = np.where(unasked, clearance, bar) + 2 * rounding
        near = np.flatnonzero(distance <= bar.take(cells.cell))
        cells = _Cells(cells.place, cells.cell.take(near), cells.item.take(near))
        if level == 0:
            distance = distance.take(near)
            if nearest == 1 and not within:
                keep = ~_hidden(shapes, centre, cells, distance, width, 2 * rounding)
                cells, distance = _Cells(cells.place, cells.cell[keep], cells.item[keep]), distance[keep]
            # Most cells have one only.
            several = np.flatnonzero(np.bincount(cells.cell, minlength=len(cells.place))[cells.cell] > 1)
            items = cells.item.copy()
            items[several] = items[several[np.lexsort((distance[several], cells.cell[several]))]]
            cells = _Cells(cells.place, cells.cell, items)
            yield cells, clearance
            continue
        for part in _halved(cells):
            waiting.append((level - 1, _split(part, np.ceil(size / 2 ** (level - 1)))))


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

    def at_most(self, places: Floats, reach: float) -> Floats:
        """``(N,)`` half of the length of the difference of two such directions, as unit vectors, within reach of places
        ``(N, d)``: by no more than twice this the distances of two obstacles change differently on the way there.
        """
        distance = np.linalg.norm((places - self.middle)[:, self.axes], axis=1) - reach
        return np.minimum(1.0, self.radius / np.maximum(distance, 1e-9))


def _smallest(distance: Floats, cell: NDArray[np.int64], bounds: NDArray[np.int64], nearest: int) -> Floats:
    """``(C,)`` distance of the obstacle of this rank in every cell; of the last one where there are fewer."""
    smallest: Floats = np.minimum.reduceat(distance, bounds)
    if nearest == 1:
        return smallest
    if nearest > FEW:
        ordered = distance[np.lexsort((distance, cell))]
        last = np.append(bounds[1:], len(cell)) - 1
        ranked: Floats = ordered[np.minimum(bounds + nearest - 1, last)]
        return ranked
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
    parts = -(-(len(cells.item) << cells.place.shape[1]) // _PAIRS_AT_ONCE)
    ends = np.searchsorted(cells.cell, np.linspace(0, len(cells.place), min(parts, len(cells.place)) + 1).astype(int))
    for begin, end in pairwise(ends):
        if begin < end:
            first, last = cells.cell[begin], cells.cell[end - 1]
            yield _Cells(cells.place[first : last + 1], cells.cell[begin:end] - first, cells.item[begin:end])


def _split(cells: _Cells, size: Floats) -> _Cells:
    """Every cell cut in two along each axis; parts beyond the grid are left out."""
    places, owners, items, count = [], [], [], 0
    for corner in product((0, 1), repeat=len(size)):
        place = 2 * cells.place + corner
        inside: NDArray[np.bool_] = np.all(place < size, axis=1)
        kept = inside[cells.cell]
        places.append(place[inside])
        owners.append(count + (np.cumsum(inside) - 1)[cells.cell[kept]])
        items.append(cells.item[kept])
        count += int(inside.sum())
    return _Cells(np.concatenate(places), np.concatenate(owners), np.concatenate(items))


_KINDS: dict[str, Any] = {
    "low": np.float32, "scale": np.float32, "ends": np.float32, "size": np.int32, "slack": np.float32,
    "clearance": np.float32, "first": np.int32, "items": np.int32, "longest": np.int32, "nearest": np.int32,
    "levels": np.int32,
}  # fmt: skip


def _frozen(*parts: ArrayLike) -> WorldIndex:
    """The index of these parts, as engines read it."""
    index = WorldIndex(*(kind(part) for kind, part in zip(_KINDS.values(), parts, strict=True)))
    for array in index:
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    return index
