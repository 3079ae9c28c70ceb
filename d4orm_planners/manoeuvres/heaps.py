"""A binary heap in arrays, compiled with numba."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import Floats, IntArray, Whole
from d4orm_env.engine.compiling import compiled


class Heap(NamedTuple):
    """Numbers by their values, the least first.

    Attributes:
        value: ``(N,)``.
        item: ``(N,)``.
        filled: ``(1,)`` how many there are.
    """

    value: Floats
    item: IntArray
    filled: IntArray

    @classmethod
    def of(cls, size: int) -> Heap:
        """One with room for so many."""
        return cls(np.empty(size), np.empty(size, np.int64), np.zeros(1, np.int64))


@compiled
def push(heap: Heap, value: float, item: Whole) -> None:
    """Put a number in; there must be room."""
    at = heap.filled[0]
    heap.filled[0] = at + 1
    while at > 0:
        above = (at - 1) >> 1
        if heap.value[above] <= value:
            break
        heap.value[at], heap.item[at] = heap.value[above], heap.item[above]
        at = above
    heap.value[at], heap.item[at] = value, item


@compiled
def pop(heap: Heap) -> tuple[float, int]:
    """Take the first one out, and its value; there must be one."""
    least, first = heap.value[0], heap.item[0]
    count = heap.filled[0] - 1
    heap.filled[0] = count
    value, item, at = heap.value[count], heap.item[count], 0
    while 2 * at + 1 < count:
        below = 2 * at + 1
        if below + 1 < count and heap.value[below + 1] < heap.value[below]:
            below += 1
        if heap.value[below] >= value:
            break
        heap.value[at], heap.item[at] = heap.value[below], heap.item[below]
        at = below
    heap.value[at], heap.item[at] = value, item
    return least, first
