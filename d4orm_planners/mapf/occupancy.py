"""Positions of a team at every step, as the search for one robot's path among all others reads them.

What every search needs of a robot's motion is worked out once: its boxes in blocks of steps, and its visits to nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, Floats, IntArray, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined
from d4orm_planners.mapf.near_neighbours import Cells, cells_about, items_in

BLOCK = 16  #: Steps for which it is known at once whether a robot is about
WIDER = 1 + 2.0**-20  #: Factor by which distances are stretched for rounding
EVER = 1 << 30  #: Step after the last visit of a robot that stays


class Others(NamedTuple):
    """Motions of all robots around one."""

    positions: Floats  #: ``(K, T + 1, 3)`` float64, flattened; afterwards they stay where they are [m]
    #: ``(K,)`` how far the robot that is replanned keeps from each [m]; zero from whom it does not mind, and from
    #: itself
    need: Floats
    boxes: Floats  #: ``(B, K, 6)`` the lowest and the highest positions in every block of steps [m]
    visits: NDArray[np.int32]  #: ``(K, V, 3)`` int32 nodes that each comes near to, first step and one after the last
    counts: IntArray  #: ``(K,)`` int64 the number of visits of each


class Occupancy:
    """Positions ``(T + 1, K, 3)`` of a team, float64 [m], not copied, changed robot by robot; and cells of nodes.

    Distances are measured between ``flatten(positions)``, see :meth:`Team.flattened`.
    """

    def __init__(self, cells: Cells, positions: Floats, flatten: Callable[[Floats], Floats] = np.asarray) -> None:
        rows, num_robots, _ = positions.shape
        self._cells, self.positions, self._flatten = cells, positions, flatten
        # Searches look at a robot at many steps in turn.
        self._paths = np.ascontiguousarray(flatten(positions).swapaxes(0, 1))
        self._boxes = np.empty((-(-rows // BLOCK), num_robots, 6))
        self._visits, self._counts = np.empty((num_robots, 64, 3), np.int32), np.zeros(num_robots, np.int64)
        self._known = np.zeros(num_robots)

    def put(self, robots: IntArray | BoolArray | int, positions: Floats | float) -> None:
        """Let robots, by number or mask, move otherwise: ``(T + 1, 3)`` or ``(T + 1, R, 3)`` positions [m]."""
        self.positions[:, robots] = positions
        self._paths[robots] = self._flatten(self.positions[:, robots]).swapaxes(0, -2)
        self._known[robots] = 0.0

    def around(self, need: Floats) -> Others:
        """Return the motions around a robot that keeps so far ``(K,)`` from each [m]."""
        waiting = np.flatnonzero((need > 0) & (need != self._known))
        while True:
            done = note_motions(self._cells, self._paths, waiting, need, self._boxes, self._visits, self._counts)
            self._known[waiting[:done]] = need[waiting[:done]]
            if done == len(waiting):
                return Others(self._paths, need, self._boxes, self._visits, self._counts)
            waiting = waiting[done:]
            self._visits = np.concatenate([self._visits, np.empty_like(self._visits)], axis=1)


@compiled
def _enclosed(
    positions: Floats, first: Whole, last: Whole
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Lowest and highest corner of a box around some positions ``(S, 3)``, ``last`` not among them."""
    low_x, low_y, low_z = positions[first, 0], positions[first, 1], positions[first, 2]
    high_x, high_y, high_z = low_x, low_y, low_z
    for i in range(first + 1, last):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        low_x, low_y, low_z = min(low_x, x), min(low_y, y), min(low_z, z)
        high_x, high_y, high_z = max(high_x, x), max(high_y, y), max(high_z, z)
    return (low_x, low_y, low_z), (high_x, high_y, high_z)


@compiled
def _fill_boxes(path: Floats, boxes: Floats) -> None:
    for block in range(boxes.shape[0]):
        box = boxes[block]
        low, high = _enclosed(path, np.int64(block * BLOCK), min((block + 1) * BLOCK, path.shape[0]))
        (box[0], box[1], box[2]), (box[3], box[4], box[5]) = low, high


@compiled
def _fill_visits(cells: Cells, path: Floats, need: float, visits: NDArray[np.int32], last: NDArray[np.int32]) -> int:
    """Number of a robot's visits; as many as there is room for are written. ``last`` ``(N,)`` is -1, and is again."""
    nodes, rows, used, step = cells.points, path.shape[0], 0, 0
    while step < rows:
        position = path[step]
        # Who stands still is looked at once.
        end = step + 1
        while end < rows and (
            path[end, 0] == position[0] and path[end, 1] == position[1] and path[end, 2] == position[2]
        ):
            end += 1
        (low_i, high_i), (low_j, high_j), (low_k, high_k) = cells_about(cells, position, position, need)
        for ci in range(low_i, high_i):
            for cj in range(low_j, high_j):
                first, after_last = items_in(cells, ci, cj, low_k, high_k)
                for number in range(first, after_last):
                    n = cells.items[number]
                    dx, dy, dz = nodes[n, 0] - position[0], nodes[n, 1] - position[1], nodes[n, 2] - position[2]
                    if dx * dx + dy * dy + dz * dz >= need * need:
                        continue
                    v = last[n]
                    if v < 0 or visits[v, 2] < step:
                        if used == visits.shape[0]:
                            return used + 1
                        v, used = np.int32(used), used + 1
                        visits[v, 0], visits[v, 1], last[n] = n, step, v
                    visits[v, 2] = end if end < rows else EVER
        step = end
    for v in range(used):
        last[visits[v, 0]] = -1
    return used


@cached_kernel(variant="note", **OPTIONS)
def note_motions(
    cells: Cells, positions: Floats, robots: IntArray, need: Floats, boxes: Floats, visits: NDArray[np.int32],
    counts: IntArray,
) -> int:  # fmt: skip
    """Work out what :class:`Others` says of robots; the last three are output.

    Returns how many of the robots are done; there is no room for the visits of the next one.
    """
    last = np.full(cells.points.shape[0], -1, np.int32)
    for number in range(robots.shape[0]):
        i = robots[number]
        counts[i] = _fill_visits(cells, positions[i], need[i], visits[i], last)
        if counts[i] > visits.shape[1]:
            return number
        _fill_boxes(positions[i], boxes[:, i])
    return robots.shape[0]


@compiled
def find_near_boxes(
    others: Others, block: Whole, low: tuple[float, float, float], high: tuple[float, float, float], near: IntArray
) -> int:
    """Find robots that may be too near to a box in a block, and return how many; ``near`` ``(K + 1,)`` is output."""
    boxes, count = others.boxes[block], 0
    for i in range(others.need.shape[0]):
        need = others.need[i]
        near[count] = i
        count += (
            (need > 0)
            & (boxes[i, 0] - need <= high[0])
            & (boxes[i, 3] + need >= low[0])
            & (boxes[i, 1] - need <= high[1])
            & (boxes[i, 4] + need >= low[1])
            & (boxes[i, 2] - need <= high[2])
            & (boxes[i, 5] + need >= low[2])
        )
    return count


@cached_kernel(variant="meetings", **OPTIONS)
def find_meetings(others: Others, positions: Floats, met: BoolArray) -> None:
    """Find the robots that positions ``(S + 1, 3)`` are too near to, after the start; ``met`` ``(K,)`` is output."""
    met[:], near = False, np.empty(others.need.shape[0] + 1, np.int64)
    for block in range((positions.shape[0] - 1) // BLOCK + 1):
        first, last = max(block * BLOCK, 1), min((block + 1) * BLOCK, positions.shape[0])
        if first == last:
            break
        low, high = _enclosed(positions, first, last)
        for number in range(find_near_boxes(others, block, low, high, near)):
            i = near[number]
            for step in range(first, last):
                other = others.positions[i, step]
                dx, dy, dz = other[0] - positions[step, 0], other[1] - positions[step, 1], other[2] - positions[step, 2]
                if dx * dx + dy * dy + dz * dz < others.need[i] * others.need[i]:
                    met[i] = True
                    break


class Buckets(NamedTuple):
    """Robots by where lines must have their middles in order to come near to them, in a grid over the plane."""

    low: tuple[float, float]  #: Lowest corner [m]
    width: float  #: Size of a cell [m]
    size: tuple[int, int]  #: Cells along both axes
    first: IntArray  #: ``(B C + 1,)`` int64 where the robots of each cell in each block begin in ``items``
    items: NDArray[np.int32]  #: int32 numbers of robots


@inlined
def _range_of(low: float, width: float, size: int, lowest: float, highest: float) -> tuple[int, int]:
    """The first cell along an axis that a stretch touches, and the one after its last; beyond the grid none."""
    first, last = (lowest - low) / width, (highest - low) / width
    if first >= size or last < 0:
        return 0, 0
    return int(max(first, 0.0)), int(min(last, size - 1.0)) + 1


@register_jitable(nogil=True, **OPTIONS)
def sort_boxes(others: Others, points: Floats, half: float, num_blocks: int) -> Buckets:
    """Sort the boxes in so many blocks, for lines between some of these points that are no longer than ``2 half``."""
    (x, y, _), (high_x, high_y, _) = _enclosed(points, np.int64(0), points.shape[0])
    spread = half * WIDER + others.need.max()
    width = 2 * spread
    size = (int((high_x - x) / width) + 1, int((high_y - y) / width) + 1)
    boxes, count = others.boxes, size[0] * size[1]
    first, items = np.zeros(num_blocks * count + 1, np.int64), np.empty(0, np.int32)
    # First they are counted, then entered from the end of each cell's part.
    for entered in range(2):
        for block in range(num_blocks):
            for i in range(others.need.shape[0]):
                if others.need[i] <= 0:
                    continue
                low_i, high_i = _range_of(x, width, size[0], boxes[block, i, 0] - spread, boxes[block, i, 3] + spread)
                low_j, high_j = _range_of(y, width, size[1], boxes[block, i, 1] - spread, boxes[block, i, 4] + spread)
                for ci in range(low_i, high_i):
                    for cj in range(low_j, high_j):
                        cell = block * count + ci * size[1] + cj
                        if entered:
                            first[cell] -= 1
                            items[first[cell]] = i
                        else:
                            first[cell] += 1
        if not entered:
            for cell in range(1, first.shape[0]):
                first[cell] += first[cell - 1]
            items = np.empty(first[-1], np.int32)
    return Buckets((x, y), width, size, first, items)


@inlined
def bucket_of(buckets: Buckets, block: Whole, x: float, y: float) -> Whole:
    """The cell in a block that the middle of a line lies in."""
    i = int((x - buckets.low[0]) / buckets.width)
    return (block * buckets.size[0] + i) * buckets.size[1] + int((y - buckets.low[1]) / buckets.width)


@compiled
def last_visit(others: Others, node: Whole) -> Whole:
    """The last step at which another comes too near to a node; -1 if none does."""
    latest = np.int64(-1)
    for i in range(others.need.shape[0]):
        for number in range(others.counts[i] if others.need[i] > 0 else 0):
            if others.visits[i, number, 0] == node:
                latest = max(latest, np.int64(others.visits[i, number, 2]) - 1)
    return latest
