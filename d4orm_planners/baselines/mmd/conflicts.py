"""Conflicts of robots that drive along known paths, compiled with numba."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import Floats, IntArray, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS


@cached_kernel(variant="count", **OPTIONS)
def count_conflicts(places: Floats, others: Floats, distances: Floats, counts: IntArray) -> None:
    """Fill ``counts`` ``(B, 2)`` int64 with how many others each of some paths conflicts with, and at how many steps.

    Args:
        places: ``(B, T, 3)`` the paths [m].
        others: ``(S, T, 3)`` where the others are [m].
        distances: ``(S,)`` to keep from each [m].
        counts: Output.
    """
    counts[:] = 0
    for b in range(places.shape[0]):
        for other in range(others.shape[0]):
            steps = 0
            square = distances[other] * distances[other]
            for t in range(places.shape[1]):
                dx = places[b, t, 0] - others[other, t, 0]
                dy = places[b, t, 1] - others[other, t, 1]
                dz = places[b, t, 2] - others[other, t, 2]
                if dx * dx + dy * dy + dz * dz <= square:
                    steps += 1
            if steps > 0:
                counts[b, 0] += 1
                counts[b, 1] += steps


@cached_kernel(variant="first", **OPTIONS)
def first_conflict(places: Floats, distances: Floats) -> tuple[Whole, Whole, Whole, Whole]:
    """``(pairs, step, robot, robot)``: how many pairs conflict, and the earliest conflict; robots are -1 if none does.

    Args:
        places: ``(K, T, 3)`` [m].
        distances: ``(K, K)`` to keep [m].
    """
    robots, steps = places.shape[0], places.shape[1]
    pairs, earliest, one, another = 0, steps, -1, -1
    for k in range(1, robots):
        for other in range(k):
            square = distances[k, other] * distances[k, other]
            for t in range(steps):
                dx = places[k, t, 0] - places[other, t, 0]
                dy = places[k, t, 1] - places[other, t, 1]
                dz = places[k, t, 2] - places[other, t, 2]
                if dx * dx + dy * dy + dz * dz <= square:
                    pairs += 1
                    if t < earliest:
                        earliest, one, another = t, k, other
                    break
    return np.int64(pairs), np.int64(earliest), np.int64(one), np.int64(another)
