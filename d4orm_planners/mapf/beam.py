"""Paths that a beam search has found so far, compiled with numba: those in the beam, and all that ever were."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Whole
from d4orm_env.engine.compiling import compiled, inlined


class Beam(NamedTuple):
    """Up to ``N`` paths as far as they have come.

    Attributes:
        states: ``(N, n)``.
        velocities: ``(N, d)``.
        faults: ``(N,)`` robots met, block by block.
        bounds: ``(N,)`` what they cost at least, as it seems [s].
        before: ``(N,)`` number of the path that each goes on from: in the beam before, or ever.
        moves: ``(N,)`` what was done in the last block.
    """

    states: FloatArray
    velocities: FloatArray
    faults: Floats
    bounds: Floats
    before: IntArray
    moves: IntArray


class PathTree(NamedTuple):
    """All paths ever kept.

    Attributes:
        before: ``(N,)`` what each goes on from ...
        moves: ``(N,)`` ... and by what.
        used: ``(1,)`` how many there are.
    """

    before: IntArray
    moves: IntArray
    used: IntArray


class Space(NamedTuple):
    """Workspace of a search.

    Attributes:
        beam: The paths kept after the last block.
        numbers: ``(width,)`` their numbers among all ever kept.
        new: Those that go on from there.
        order: ``(N,)`` a heap of these.
        ever: All ever kept.
        did: ``(B,)`` the moves of the path found, the last first.
        path: ``(block, d)`` places in a block.
    """

    beam: Beam
    numbers: IntArray
    new: Beam
    order: IntArray
    ever: PathTree
    did: IntArray
    path: FloatArray


def _make_beam(size: int, n: int, d: int) -> Beam:
    return Beam(
        np.empty((size, n), np.float32), np.empty((size, d), np.float32), np.empty(size), np.empty(size),
        np.empty(size, np.int64), np.empty(size, np.int64),
    )  # fmt: skip


def make_space(width: int, num_moves: int, num_blocks: int, block: int, n: int, d: int) -> Space:
    """Space for a beam of so many paths, moves and blocks of steps."""
    before, moves = np.empty((2, width * num_blocks), np.int64)
    return Space(
        _make_beam(width, n, d), np.empty(width, np.int64), _make_beam(width * num_moves, n, d),
        np.empty(width * num_moves, np.int64), PathTree(before, moves, np.empty(1, np.int64)),
        np.empty(num_blocks, np.int64), np.empty((block, d), np.float32),
    )  # fmt: skip


@compiled
def _is_like_another(new: Beam, node: Whole, kept: Beam, size: Whole, dedup2: float) -> bool:
    """Check whether a path is about where one of those kept is, about as fast."""
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
def _keep(new: Beam, node: Whole, kept: Beam, number: Whole) -> None:
    for i in range(new.states.shape[1]):
        kept.states[number, i] = new.states[node, i]
    for axis in range(new.velocities.shape[1]):
        kept.velocities[number, axis] = new.velocities[node, axis]
    kept.faults[number] = new.faults[node]
    kept.before[number], kept.moves[number] = new.before[node], new.moves[node]


@compiled
def _sink(bounds: Floats, heap: IntArray, place: Whole, size: Whole) -> None:
    """Let what is at a place of a heap sink below all that comes before it: lower bounds, then lower numbers."""
    node = heap[place]
    while 2 * place + 1 < size:
        child = 2 * place + 1
        if child + 1 < size:
            left, right = heap[child], heap[child + 1]
            if bounds[right] < bounds[left] or (bounds[right] == bounds[left] and right < left):
                child += 1
        other = heap[child]
        if bounds[node] < bounds[other] or (bounds[node] == bounds[other] and node < other):
            break
        heap[place], place = other, child
    heap[place] = node


@inlined
def keep_best(space: Space, count: Whole, best: float, dedup2: float) -> Whole:
    """Keep the most promising of ``count`` paths, of those that are alike the better one.

    Args:
        space: The paths, and the beam, output.
        count: How many paths there are.
        best: Cost that a path must come below [s].
        dedup2: Square of the distance within which two are alike.

    Returns:
        How many are kept.
    """
    new, ever, numbers, heap = space.new, space.ever, space.numbers, space.order
    root = size = np.int64(0)  # literals would compile what they are passed to once more
    for node in range(count):
        heap[node] = node
    for place in range(count // 2 - 1, -1, -1):
        _sink(new.bounds, heap, place, count)
    while count > 0:
        node = heap[0]
        if size == numbers.shape[0] or new.bounds[node] >= best:
            break
        count -= 1
        heap[0] = heap[count]
        _sink(new.bounds, heap, root, count)
        if not _is_like_another(new, node, space.beam, size, dedup2):
            _keep(new, node, space.beam, size)
            number = ever.used[0]
            ever.before[number], ever.moves[number], numbers[size] = new.before[node], new.moves[node], number
            ever.used[0], size = number + 1, size + 1
    return size


@compiled
def trace_back(ever: PathTree, number: Whole, move: Whole, did: IntArray) -> int:
    """Write what a path did, from the last block to the first, to ``did``; return how many blocks that are."""
    did[0], length = move, 1
    while number >= 0:
        did[length], number, length = ever.moves[number], ever.before[number], length + 1
    return length
