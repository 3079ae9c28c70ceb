"""Queries of a beam search, whom their paths meet, and the paths found so far: those in the beam, and all that ever
were. Compiled with numba.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray, Whole
from d4orm_env.engine.compiling import compiled
from d4orm_env.engine.simd import TILE
from d4orm_planners.engine.path_table import (
    BLOCK,
    Nearby,
    PathTable,
    count_among,
    count_near,
    make_nearby,
    steps_of,
)


class BeamRules(NamedTuple):
    """Rules by which the beam keeps paths."""

    width: int  #: Number of paths
    contact: float  #: Cost of being near another robot in a block [s]
    dedup_distance: float  #: Least distance between two, or else twice as much in speed [m, m/s]


class OtherAgents(NamedTuple):
    """Agents that robots which look for a path avoid, other than the team as it drives at present."""

    exclude: IntArray  #: ``(R, N)`` numbers of robots that each does not mind, its own among them
    extra: FloatArray  #: ``(R, M, H+1, d)`` paths that it minds as well [m]
    radius: Floats  #: ``(R, M)`` radii of the agents on them [m]


class Queries(NamedTuple):
    """Robots that look for paths."""

    robots: IntArray  #: ``(R,)`` their numbers in the team
    blocks: IntArray  #: ``(R,)`` the block at whose beginning their new paths begin,
    states: FloatArray  #: ``(R, n)`` and in which state
    limits: Floats  #: ``(R,)`` what their paths must cost less than [s]: step of the end, and contacts
    others: OtherAgents  #: Agents that they mind, or do not mind


class Beam(NamedTuple):
    """Up to ``N`` paths as far as they have come, and room for one more."""

    states: FloatArray  #: ``(N + 1, n)``
    motions: FloatArray  #: ``(N + 1, 2d)`` positions and velocities
    faults: Floats  #: ``(N + 1,)`` robots met, block by block
    numbers: IntArray  #: ``(N + 1,)`` their numbers among all ever kept


class Branches(NamedTuple):
    """Paths that go on from all in the beam by every move, ``N`` in whole tiles, path by path."""

    lanes: FloatArray  #: ``(T, LANES)`` workspace of :mod:`~d4orm_planners.mapf.block_drives`
    costs: Floats  #: ``(N,)`` what they cost at least, as it seems, but for robots met [s]
    bounds: Floats  #: ``(N,)`` what they cost at least, robots met so far included [s]
    faults: Floats  #: ``(N,)`` robots met, block by block
    #: ``(N, 2)`` bool, those of which it is known what they do wrong by themselves in the last block, and whom they
    #: meet there
    counted: BoolArray
    apart: IntArray  #: ``(N,)`` how many of those kept none of them is like
    heap: IntArray  #: ``(N,)`` numbers of those that may still be kept, the most promising first
    path: FloatArray  #: ``(BLOCK, d)`` positions of one of them in the block [m]
    nearby: Nearby  #: Robots that they may meet in it


class PathTree(NamedTuple):
    """All paths ever kept."""

    before: IntArray  #: ``(N,)`` number of what each goes on from ...
    moves: IntArray  #: ``(N,)`` ... and by what
    used: IntArray  #: ``(1,)`` how many there are


class BeamSpace(NamedTuple):
    """Workspace of a search."""

    beam: Beam  #: The paths kept after the last block
    before: IntArray  #: ``(width,)`` numbers of those kept after the block before
    new: Branches  #: Those that go on from there
    ever: PathTree  #: All ever kept
    did: IntArray  #: ``(B,)`` the moves of the path found, the last first


def make_beam_space(
    width: int, num_moves: int, num_blocks: int, n: int, d: int, lanes: int, num_robots: int
) -> BeamSpace:
    """Workspace for a beam of so many paths, moves and blocks of steps, with so many numbers for a tile's drives."""
    before, moves = np.empty((2, width * num_blocks), np.int64)
    tiles = -(-width * num_moves // TILE)
    most = tiles * TILE
    return BeamSpace(
        Beam(
            np.empty((width + 1, n), np.float32), np.empty((width + 1, 2 * d), np.float32), np.empty(width + 1),
            np.empty(width + 1, np.int64),
        ),
        np.empty(width, np.int64),
        Branches(
            np.zeros((tiles, lanes), np.float32), np.empty(most), np.empty(most), np.empty(most),
            np.empty((most, 2), np.bool_), np.empty(most, np.int64), np.empty(most, np.int64),
            np.empty((BLOCK, d), np.float32), make_nearby(num_robots),
        ),
        PathTree(before, moves, np.empty(1, np.int64)),
        np.empty(num_blocks, np.int64),
    )  # fmt: skip


@compiled
def is_like_another(kept: Beam, first: Whole, size: Whole, dedup2: float) -> bool:
    """Check whether the path after those kept is about where one of these from some on is, and about as fast."""
    d = kept.motions.shape[1] // 2
    for other in range(first, size):
        gap2, change2 = 0.0, 0.0
        for axis in range(d):
            gap = kept.motions[size, axis] - kept.motions[other, axis]
            change = kept.motions[size, d + axis] - kept.motions[other, d + axis]
            gap2 += gap * gap
            change2 += change * change
        if gap2 < dedup2 and change2 < 4 * dedup2:
            return True
    return False


@compiled
def keep(kept: Beam, size: Whole, faults: float, before: Whole, move: Whole, ever: PathTree) -> None:
    """Keep the path after so many of those kept, with its number among all ever kept."""
    number = ever.used[0]
    kept.faults[size], kept.numbers[size], ever.before[number], ever.moves[number] = faults, number, before, move
    ever.used[0] = number + 1


@compiled
def sink(bounds: Floats, heap: IntArray, position: Whole, size: Whole) -> None:
    """Let the entry at a position of a heap sink below all that come before it: lower bounds, then lower numbers."""
    node = heap[position]
    while 2 * position + 1 < size:
        child = 2 * position + 1
        if child + 1 < size:
            # Without a branch, which nobody could predict.
            left, right = heap[child], heap[child + 1]
            child += (bounds[right] < bounds[left]) | ((bounds[right] == bounds[left]) & (right < left))
        other = heap[child]
        if bounds[node] < bounds[other] or (bounds[node] == bounds[other] and node < other):
            break
        heap[position], position = other, child
    heap[position] = node


@compiled
def trace_back(ever: PathTree, number: Whole, move: Whole, did: IntArray) -> int:
    """Write what a path did, from the last block to the first, to ``did``; return how many blocks that are."""
    did[0], length = move, 1
    while number >= 0:
        did[length], number, length = ever.moves[number], ever.before[number], length + 1
    return length


@compiled
def _count_extra(
    table: PathTable, robot: Whole, others: OtherAgents, r: int, path: FloatArray, first: Whole, last: Whole
) -> int:
    """Count the extra paths that a path meets from one step to another; at its end it is at rest."""
    count, end = 0, path.shape[0] - 1
    for other in range(others.extra.shape[1]):
        safety_distance = table.radius[robot] + others.radius[r, other] + table.margin
        for t in range(first, last):
            gap2 = 0.0
            for axis in range(path.shape[1]):
                position = np.float64(path[min(t - first, end), axis])
                gap = position - np.float64(others.extra[r, other, t, axis])
                gap *= table.flattening if axis == 2 else 1.0
                gap2 += gap * gap
            if gap2 <= safety_distance * safety_distance:
                count += 1
                break
    return count


@compiled
def count_met(table: PathTable, queries: Queries, r: int, nearby: Nearby, path: FloatArray, block: Whole) -> int:
    """Count the robots that a path meets in a block."""
    robot, (first, last) = queries.robots[r], steps_of(table, block)
    count = count_among(table, robot, nearby, path, block)
    return count + _count_extra(table, robot, queries.others, r, path, first, last)


@compiled
def count_passing(
    table: PathTable, queries: Queries, r: int, path: FloatArray, block: Whole, contact: float, left: float
) -> int:
    """Count the robots that come by after a block that ended at the goal, where this one stays; ``path`` is changed.

    When those counted cost more than is ``left``, at so much ``contact`` each, the rest does not matter.
    """
    robot, others, (first, last) = queries.robots[r], queries.others, steps_of(table, block)
    for row in range(path.shape[0]):
        for axis in range(path.shape[1]):
            path[row, axis] = path[last - first - 1, axis]
    # In the block after the last in which anybody moves all are where they stay.
    count, last_busy = 0, min(table.first.shape[0] - 1, table.moving[0] + 1)
    for later in range(block + 1, last_busy + 1):
        if contact * (count - 1) > left:
            return count
        count += count_near(table, robot, others.exclude[r], path, steps_of(table, later)[0], later)
    return count + _count_extra(table, robot, others, r, path, last, len(table.positions))
