"""Contacts of a tile with obstacles and bounds, compiled with numba: a lookup a sample, however many there are.

The clearance at the centre of a sample's cell decides for nearly all of them. Where it does not, the cell's obstacles
are tested one by one, with the arithmetic of :mod:`d4orm_env.dynamics.collision`: the outcome is that of testing all.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import collision
from d4orm_env.engine.compiling import ONE, ZERO, compiled, inlined, to_fixed_tuple, trailing_zeros
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.simd import BIT, CHUNK, NOWHERE, TILE, at_most, use_wide_registers
from d4orm_env.geometry.world_index import WorldIndex

_HALF = np.float32(0.5)


@inlined
def _count_steps(index: WorldIndex, axis: int, row: FloatArray, cells: NDArray[np.uint32]) -> None:
    """Carry the numbers of the cells that hold some points on by the next axis, along which they lie at ``row``.

    Points beyond the grid count as in its outermost cells, not a number as in the first one.
    """
    low, scale, size = index.low[axis], index.scale, np.uint32(index.size[axis])
    last = np.float32(size - 1)
    for s in range(cells.shape[0]):
        position = (row[s] - low) * scale
        position = position if position > ZERO else ZERO
        cells[s] = cells[s] * size + np.uint32(np.int32(position if position < last else last))


@inlined
def _touches_box(box: FloatArray, i: int, radius: np.float32, x: np.float32, y: np.float32, z: np.float32) -> bool:
    d = box.shape[1] // 2
    gap = collision.axis_gap(x, box[i, 0], box[i, d], ZERO, OPS)
    gap2 = gap * gap
    gap = collision.axis_gap(y, box[i, 1], box[i, 1 + d], ZERO, OPS)
    gap2 += gap * gap
    if d == 3:
        gap = collision.axis_gap(z, box[i, 2], box[i, 2 + d], ZERO, OPS)
        gap2 += gap * gap
    total = radius + box[i, 2 * d]
    return gap2 <= total * total


@inlined
def _touches(
    index: WorldIndex,
    boxes: FloatArray,
    triangles: FloatArray,
    cell: Whole,
    radius: np.float32,
    x: np.float32,
    y: np.float32,
    z: np.float32,
) -> bool:
    """Check whether a body of this radius touches one of the obstacles that its cell knows."""
    for number in range(index.first[cell], index.first[cell + 1]):
        item = index.items[number]
        if item < boxes.shape[0]:
            if _touches_box(boxes, item, radius, x, y, z):
                return True
        elif collision.meets_triangle(to_fixed_tuple(triangles[item - boxes.shape[0]], 6), x, y, radius, ZERO, OPS):
            return True
    return False


@inlined
def is_closed(arrays: ProblemArrays) -> bool:
    """Check whether there are obstacles or bounds at all."""
    closed = arrays.grid.clearance.shape[0] > 0
    for axis in range(arrays.goal.shape[1]):
        closed |= arrays.bounds[0, axis] > -np.inf or arrays.bounds[1, axis] < np.inf
    return closed


@inlined
def cell_at(index: WorldIndex, position: Any, dimension: int) -> np.int64:
    """The number of the cell that holds a position, of the outermost one beyond the grid."""
    cell = np.int64(0)
    for axis in range(dimension):
        steps = np.int64(max((position[axis] - index.low[axis]) * index.scale, ZERO))
        cell = cell * index.size[axis] + min(steps, np.int64(index.size[axis]) - 1)
    return cell


@inlined
def touches_static(arrays: ProblemArrays, radius: np.float32, position: FloatArray) -> bool:
    """Check whether a body of this radius, centred at ``position`` ``(d,)``, touches an obstacle or the bounds."""
    index = arrays.grid
    for axis in range(position.shape[0]):
        if collision.leaves(position[axis], radius, arrays.bounds[0, axis], arrays.bounds[1, axis]):
            return True
    if index.clearance.shape[0] == 0:
        return False
    cell = cell_at(index, position, position.shape[0])
    clearance = index.clearance[cell]
    if clearance > radius + index.slack or clearance <= radius - index.slack:
        return clearance <= radius
    x, y, z = position[0], position[1], position[position.shape[0] - 1]
    return _touches(index, arrays.boxes, arrays.triangles, cell, radius, x, y, z)


@compiled
def _near_indexed(
    index: WorldIndex,
    boxes: FloatArray,
    triangles: FloatArray,
    radius: np.float32,
    positions: FloatArray,
    buffer: FloatArray,
) -> np.uint64:
    """Mask of contacts of a body of this radius, centred at the first rows of ``positions``, with obstacles."""
    use_wide_registers()
    third = 2 * TILE if index.low.shape[0] == 3 else 0
    cells = buffer[TILE : 2 * TILE].view(np.uint32)
    for s in range(TILE):
        cells[s] = 0
    for axis in range(index.low.shape[0]):
        _count_steps(index, axis, positions[axis * TILE : (axis + 1) * TILE], cells)
    for s in range(TILE):
        buffer[s] = index.clearance[cells[s]]
    near = at_most(buffer, 0, radius + index.slack)
    if near == NOWHERE:
        return near
    sure = at_most(buffer, 0, radius - index.slack)
    unsure = near & ~sure
    while unsure != NOWHERE:
        sample = np.int64(trailing_zeros(unsure))
        unsure &= unsure - BIT
        x, y, z = positions[sample], positions[TILE + sample], positions[third + sample]
        if _touches(index, boxes, triangles, np.int64(cells[sample]), radius, x, y, z):
            sure |= BIT << np.uint64(sample)
    return sure


@inlined
def near_obstacles(arrays: ProblemArrays, radius: np.float32, positions: FloatArray, buffer: FloatArray) -> np.uint64:
    """Mask of contacts of a body of this radius, centred at the first rows of ``positions``, with obstacles or bounds.

    ``buffer`` is two rows to overwrite.
    """
    mask = NOWHERE
    if arrays.grid.clearance.shape[0] > 0:
        mask = _near_indexed(arrays.grid, arrays.boxes, arrays.triangles, radius, positions, buffer)
    for axis in range(arrays.goal.shape[1]):
        lower, upper = arrays.bounds[0, axis], arrays.bounds[1, axis]
        if lower > -np.inf or upper < np.inf:
            row = positions[axis * TILE : (axis + 1) * TILE]
            for s in range(TILE):
                buffer[s] = ZERO if collision.leaves(row[s], radius, lower, upper) else ONE
            mask |= at_most(buffer, 0, ZERO)
    return mask


@compiled
def may_touch(
    index: WorldIndex,
    radius: np.float32,
    widening: np.float32,
    boxes: FloatArray,
    begin: Whole,
    axis_step: int,
    buffer: FloatArray,
) -> bool:
    """Check whether a body may touch an obstacle, of which there are some, in the lanes of
    :func:`~d4orm_env.engine.simd.enclose`.

    The lanes of the first axis are in ``boxes`` from ``begin`` on, those of the next ``axis_step`` later, each
    ``widening`` larger than its positions. ``buffer`` is two rows to overwrite.
    """
    use_wide_registers()
    middles, squares, beyond = buffer[:CHUNK], buffer[CHUNK : 2 * CHUNK], buffer[2 * CHUNK : 3 * CHUNK]
    cells = buffer[3 * CHUNK : 4 * CHUNK].view(np.uint32)
    for lane in range(CHUNK):
        squares[lane] = beyond[lane] = ZERO
        cells[lane] = 0
    for axis in range(index.low.shape[0]):
        low, high = index.ends[0, axis], index.ends[1, axis]
        lows, highs = boxes[begin : begin + CHUNK], boxes[begin + CHUNK : begin + 2 * CHUNK]
        for lane in range(CHUNK):
            half, middles[lane] = _HALF * (highs[lane] - lows[lane]) - widening, _HALF * (highs[lane] + lows[lane])
            squares[lane] += half * half
            outside = collision.axis_gap(middles[lane], low, high, ZERO, OPS)
            beyond[lane] += outside * outside
        _count_steps(index, axis, middles, cells)
        begin += axis_step
    unclear = False
    for lane in range(CHUNK):
        # Seen from beyond the grid all obstacles lie behind its nearest point, at no less than a right angle; but not
        # along an axis on which some have no end.
        clearance, far2 = index.clearance[cells[lane]], beyond[lane]
        clearance = np.sqrt(far2 + clearance * clearance) if far2 > ZERO else clearance
        unclear |= not clearance > radius + index.slack + np.sqrt(squares[lane])
    return unclear
