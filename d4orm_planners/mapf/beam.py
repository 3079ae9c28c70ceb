"""Queries of a beam search, whom their paths meet, and the paths found so far: those in the beam, and all that ever
were. Compiled with numba.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray, Whole
from d4orm_env.engine.compiling import compiled
from d4orm_planners.engine.path_table import BLOCK, PathTable, count_near, steps_of


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
    #: ``(R,)`` what their paths must cost less than [s]: the step at which one ends, and what contacts cost
    limits: Floats
    others: OtherAgents  #: Agents that they mind, or do not mind


class Beam(NamedTuple):
    """Up to ``N`` paths as far as they have come."""

    states: FloatArray  #: ``(N, n)``
    velocities: FloatArray  #: ``(N, d)``
    faults: Floats  #: ``(N,)`` robots met, block by block
    costs: Floats  #: ``(N,)`` what they cost at least, as it seems, but for that [s]
    bounds: Floats  #: ``(N,)`` what they cost at least, robots met so far included [s]
    before: IntArray  #: ``(N,)`` number of the path that each goes on from: in the beam before, or ever
    moves: IntArray  #: ``(N,)`` what was done in the last block
    paths: FloatArray  #: ``(N, BLOCK, d)`` positions in it [m]


class PathTree(NamedTuple):
    """All paths ever kept."""

    before: IntArray  #: ``(N,)`` what each goes on from ...
    moves: IntArray  #: ``(N,)`` ... and by what
    used: IntArray  #: ``(1,)`` how many there are


class BeamSpace(NamedTuple):
    """Workspace of a search."""

    beam: Beam  #: The paths kept after the last block
    numbers: IntArray  #: ``(width,)`` their numbers among all ever kept
    new: Beam  #: Those that go on from there, and room for one more
    heap: IntArray  #: ``(N,)`` numbers of these that may still be kept, the most promising first
    #: ``(N, 2)`` bool, those of which it is known what they do wrong by themselves in the last block, and whom they
    #: meet there
    counted: BoolArray
    ever: PathTree  #: All ever kept
    did: IntArray  #: ``(B,)`` the moves of the path found, the last first
    lanes: FloatArray  #: Workspace of :mod:`~d4orm_planners.mapf.motion_primitives`


def _make_beam(size: int, n: int, d: int, steps: int) -> Beam:
    return Beam(
        np.empty((size, n), np.float32), np.empty((size, d), np.float32), np.empty(size), np.empty(size),
        np.empty(size), np.empty(size, np.int64), np.empty(size, np.int64), np.empty((size, steps, d), np.float32),
    )  # fmt: skip


def make_beam_space(width: int, num_moves: int, num_blocks: int, n: int, d: int, lanes: int) -> BeamSpace:
    """Workspace for a beam of so many paths, moves and blocks of steps, with so many numbers for block drives."""
    before, moves = np.empty((2, width * num_blocks), np.int64)
    most = width * num_moves
    return BeamSpace(
        _make_beam(width, n, d, 0), np.empty(width, np.int64), _make_beam(most + 1, n, d, BLOCK),
        np.empty(most, np.int64), np.empty((most, 2), np.bool_), PathTree(before, moves, np.empty(1, np.int64)),
        np.empty(num_blocks, np.int64), np.zeros(lanes, np.float32),
    )  # fmt: skip


@compiled
def is_like_another(new: Beam, node: Whole, kept: Beam, size: Whole, dedup2: float) -> bool:
    """Check whether a path is about where one of those kept is, and about as fast."""
    for other in range(size):
        gap2, change2 = 0.0, 0.0
        for axis in range(new.velocities.shape[1]):
            gap = new.states[node, axis] - kept.states[other, axis]
            change = new.velocities[node, axis] - kept.velocities[other, axis]
            gap2 += gap * gap
            change2 += change * change
        if gap2 < dedup2 and change2 < 4 * dedup2:
            return True
    return False


@compiled
def keep(new: Beam, node: Whole, kept: Beam, size: Whole, numbers: IntArray, ever: PathTree) -> None:
    """Keep a path as the next one of the beam, with its number among all ever kept, which ``numbers`` is told."""
    for i in range(new.states.shape[1]):
        kept.states[size, i] = new.states[node, i]
    for axis in range(new.velocities.shape[1]):
        kept.velocities[size, axis] = new.velocities[node, axis]
    kept.faults[size], number = new.faults[node], ever.used[0]
    ever.before[number], ever.moves[number], numbers[size] = new.before[node], new.moves[node], number
    ever.used[0] = number + 1


@compiled
def sink(bounds: Floats, heap: IntArray, position: Whole, size: Whole) -> None:
    """Let the entry at a position of a heap sink below all that come before it: lower bounds, then lower numbers."""
    node = heap[position]
    while 2 * position + 1 < size:
        child = 2 * position + 1
        if child + 1 < size:
            left, right = heap[child], heap[child + 1]
            if bounds[right] < bounds[left] or (bounds[right] == bounds[left] and right < left):
                child += 1
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
                gap2 += gap * gap
            if gap2 <= safety_distance * safety_distance:
                count += 1
                break
    return count


@compiled
def count_met(table: PathTable, queries: Queries, r: int, path: FloatArray, block: Whole) -> int:
    """Count the robots that a path meets in a block."""
    robot, (first, last) = queries.robots[r], steps_of(table, block)
    count = count_near(table, robot, queries.others.exclude[r], path, first, block)
    return count + _count_extra(table, robot, queries.others, r, path, first, last)


@compiled
def count_passing(table: PathTable, queries: Queries, r: int, path: FloatArray, block: Whole) -> int:
    """Count the robots that come by after a block that ended at the goal, where this one stays; ``path`` is changed."""
    robot, others, (first, last) = queries.robots[r], queries.others, steps_of(table, block)
    for row in range(path.shape[0]):
        for axis in range(path.shape[1]):
            path[row, axis] = path[last - first - 1, axis]
    # In the block after the last in which anybody moves all are where they stay.
    count, last_busy = 0, min(table.first.shape[0] - 1, table.moving[0] + 1)
    for later in range(block + 1, last_busy + 1):
        count += count_near(table, robot, others.exclude[r], path, steps_of(table, later)[0], later)
    return count + _count_extra(table, robot, others, r, path, last, len(table.positions))
