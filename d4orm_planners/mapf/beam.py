"""Paths that a beam search has found so far, compiled with numba: those in the beam, and all that ever were."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Whole
from d4orm_env.engine.compiling import OPTIONS, compiled


class Beam(NamedTuple):
    """Up to ``N`` paths as far as they have come.

    Attributes:
        states: ``(N, n)``.
        velocities: ``(N, d)``.
        faults: ``(N,)`` robots met, block by block.
        costs: ``(N,)`` what they cost at least, as it seems, but for that [s].
        bounds: ``(N,)`` what they cost at least, robots met so far included [s].
        before: ``(N,)`` number of the path that each goes on from: in the beam before, or ever.
        moves: ``(N,)`` what was done in the last block.
        paths: ``(N, BLOCK, d)`` positions in it [m].
    """

    states: FloatArray
    velocities: FloatArray
    faults: Floats
    costs: Floats
    bounds: Floats
    before: IntArray
    moves: IntArray
    paths: FloatArray


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


@register_jitable(nogil=True, **OPTIONS)
def make_beam(size: int, n: int, d: int, steps: int) -> Beam:
    return Beam(
        np.empty((size, n), np.float32), np.empty((size, d), np.float32), np.empty(size), np.empty(size),
        np.empty(size), np.empty(size, np.int64), np.empty(size, np.int64), np.empty((size, steps, d), np.float32),
    )  # fmt: skip


@compiled
def is_like_another(new: Beam, node: Whole, kept: Beam, size: int, dedup2: float) -> bool:
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
def keep(new: Beam, node: Whole, kept: Beam, size: int, numbers: IntArray, ever: PathTree) -> None:
    """Keep a path as the next one of the beam, with its number among all ever kept, which ``numbers`` is told."""
    for i in range(new.states.shape[1]):
        kept.states[size, i] = new.states[node, i]
    for axis in range(new.velocities.shape[1]):
        kept.velocities[size, axis] = new.velocities[node, axis]
    kept.faults[size], number = new.faults[node], ever.used[0]
    ever.before[number], ever.moves[number], numbers[size] = new.before[node], new.moves[node], number
    ever.used[0] = number + 1


@compiled
def trace_back(ever: PathTree, number: Whole, move: Whole, did: IntArray) -> int:
    """Write what a path did, from the last block to the first, to ``did``; return how many blocks that are."""
    did[0], length = move, 1
    while number >= 0:
        did[length], number, length = ever.moves[number], ever.before[number], length + 1
    return length
