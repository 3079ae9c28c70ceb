"""Contacts of a tile with obstacles and bounds, compiled with numba: a lookup a sample, however many there are.

The clearance at the centre of a sample's cell decides for nearly all of them. Where it does not, the cell's obstacles
are tested one by one, with the arithmetic of :mod:`d4orm_env.core.collision`: the outcome is that of testing all.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from d4orm_env.core import collision
from d4orm_env.engine.lanes import CHUNK, TILE, at_most
from d4orm_env.engine.tiles import NOWHERE, ONE, OPS, ZERO, compiled, inlined, to_fixed_tuple

_HALF = np.float32(0.5)
_BIT = np.uint64(1)


@compiled
def _steps_along(x: Any, low: Any, scale: Any, count: Any) -> Any:
    """Number along one axis of the cell that holds ``x``, of the outermost one beyond the grid; 0 for no number."""
    place, last = (x - low) * scale, np.float32(count - 1)
    place = place if place > ZERO else ZERO
    return np.int64(np.int32(place if place < last else last))


@inlined
def _cell(index: Any, x: Any, y: Any, z: Any) -> Any:
    """Number of the cell that holds a point; ``z`` is not looked at in the plane."""
    low, scale, size = index.low, index.scale, index.size
    cell = _steps_along(x, low[0], scale, size[0]) * size[1] + _steps_along(y, low[1], scale, size[1])
    if low.shape[0] == 2:
        return cell
    return cell * size[2] + _steps_along(z, low[2], scale, size[2])


@inlined
def _touches_box(box: Any, i: Any, reach: Any, x: Any, y: Any, z: Any) -> Any:
    d = box.shape[1] // 2
    gap = collision.axis_gap(x, box[i, 0], box[i, d], ZERO, OPS)
    gap2 = gap * gap
    gap = collision.axis_gap(y, box[i, 1], box[i, 1 + d], ZERO, OPS)
    gap2 += gap * gap
    if d == 3:
        gap = collision.axis_gap(z, box[i, 2], box[i, 2 + d], ZERO, OPS)
        gap2 += gap * gap
    total = reach + box[i, 2 * d]
    return gap2 <= total * total


@inlined
def _touches(index: Any, boxes: Any, triangles: Any, reach: Any, x: Any, y: Any, z: Any) -> Any:
    """Whether a body of this reach touches one of the obstacles that its cell knows."""
    cell = _cell(index, x, y, z)
    for number in range(index.first[cell], index.first[cell + 1]):
        item = index.items[number]
        if item < boxes.shape[0]:
            if _touches_box(boxes, item, reach, x, y, z):
                return True
        elif collision.meets_triangle(to_fixed_tuple(triangles[item - boxes.shape[0]], 6), x, y, reach, ZERO, OPS):
            return True
    return False


@inlined
def is_closed(arrays: Any) -> Any:
    """Whether there are obstacles or bounds at all."""
    closed = arrays.grid.clearance.shape[0] > 0
    for axis in range(arrays.goal.shape[1]):
        closed |= arrays.bounds[0, axis] > -np.inf or arrays.bounds[1, axis] < np.inf
    return closed


@inlined
def touches_static(arrays: Any, reach: Any, place: Any) -> Any:
    """Whether a body of this reach touches an obstacle or the bounds where its centre is at ``place`` ``(d,)``."""
    index = arrays.grid
    for axis in range(place.shape[0]):
        if collision.leaves(place[axis], reach, arrays.bounds[0, axis], arrays.bounds[1, axis]):
            return True
    if index.clearance.shape[0] == 0:
        return False
    x, y, z = place[0], place[1], place[place.shape[0] - 1]
    clearance = index.clearance[_cell(index, x, y, z)]
    if clearance > reach + index.slack or clearance <= reach - index.slack:
        return clearance <= reach
    return _touches(index, arrays.boxes, arrays.triangles, reach, x, y, z)


@compiled
def _near_indexed(index: Any, boxes: Any, triangles: Any, reach: Any, places: Any, spare: Any) -> Any:
    """Where a body of this reach, its centre in the first rows of ``places``, touches an obstacle."""
    third = 2 * TILE if index.low.shape[0] == 3 else 0
    clearance = index.clearance
    for s in range(TILE):
        spare[s] = clearance[_cell(index, places[s], places[TILE + s], places[third + s])]
    near = at_most(spare, 0, reach + index.slack)
    if near == NOWHERE:
        return near
    sure = at_most(spare, 0, reach - index.slack)
    unsure = near & ~sure
    for s in range(TILE):
        if unsure >> np.uint64(s) & _BIT != NOWHERE:
            x, y, z = places[s], places[TILE + s], places[third + s]
            if _touches(index, boxes, triangles, reach, x, y, z):
                sure |= _BIT << np.uint64(s)
    return sure


@inlined
def near_obstacles(arrays: Any, reach: Any, places: Any, spare: Any) -> Any:
    """Where a body of this reach, its centre in the first rows of ``places``, touches an obstacle or the bounds.

    ``spare`` is a row to overwrite.
    """
    mask = NOWHERE
    if arrays.grid.clearance.shape[0] > 0:
        mask = _near_indexed(arrays.grid, arrays.boxes, arrays.triangles, reach, places, spare)
    for axis in range(arrays.goal.shape[1]):
        lower, upper = arrays.bounds[0, axis], arrays.bounds[1, axis]
        if lower > -np.inf or upper < np.inf:
            row = places[axis * TILE : (axis + 1) * TILE]
            for s in range(TILE):
                spare[s] = ZERO if collision.leaves(row[s], reach, lower, upper) else ONE
            mask |= at_most(spare, 0, ZERO)
    return mask


@compiled
def may_touch(index: Any, reach: Any, widening: Any, boxes: Any, begin: Any, axis_step: Any) -> Any:
    """Whether a body may touch an obstacle anywhere in the lanes of :func:`~d4orm_env.engine.lanes.enclose`.

    Args:
        index: Where the obstacles are; there must be some.
        reach: The body's.
        widening: By how much its lanes are wider than its places.
        boxes: The lanes, those of the first axis from ``begin`` on, those of the next ``axis_step`` later.
        begin: See ``boxes``.
        axis_step: See ``boxes``.
    """
    d, unclear = index.low.shape[0], False
    third = 2 * axis_step if d == 3 else 0
    for lane in range(begin, begin + CHUNK):
        square, beyond = ZERO, ZERO
        for axis in range(d):
            low, high = boxes[lane + axis * axis_step], boxes[lane + axis * axis_step + CHUNK]
            half, middle = _HALF * (high - low) - widening, _HALF * (high + low)
            square += half * half
            outside: Any = collision.axis_gap(middle, index.ends[0, axis], index.ends[1, axis], ZERO, OPS)
            beyond += outside * outside
        x = _HALF * (boxes[lane] + boxes[lane + CHUNK])
        y = _HALF * (boxes[lane + axis_step] + boxes[lane + axis_step + CHUNK])
        z = _HALF * (boxes[lane + third] + boxes[lane + third + CHUNK])
        clearance = index.clearance[_cell(index, x, y, z)]
        # Seen from beyond the grid all obstacles lie behind its nearest point, at no less than a right angle; but not
        # along an axis on which some have no end.
        clearance = np.sqrt(beyond + clearance * clearance) if beyond > ZERO else clearance
        unclear |= not clearance > reach + index.slack + np.sqrt(square)
    return unclear
