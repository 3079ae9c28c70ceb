"""Wall-clock measurements, repeated and in turn."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

Measurement: TypeAlias = dict[str, Any]
"""Measurement of one case, by column: numbers, texts and :class:`Spread`."""


@dataclass(frozen=True)
class Spread:
    """A sample of measurements in five numbers, in the unit of what was measured."""

    median: float
    lower_quartile: float
    upper_quartile: float
    smallest: float
    largest: float
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """The spread of some values, at least one."""
        smallest, lower, median, upper, largest = (float(v) for v in np.percentile(values, [0, 25, 50, 75, 100]))
        return cls(median, lower, upper, smallest, largest, len(values))

    def times(self, factor: float) -> Spread:
        """The same measurements in another unit; the factor is positive."""
        return replace(self, **{name: value * factor for name, value in vars(self).items() if name != "count"})


def measure(work: Callable[[], object], repetitions: int, time_limit: float) -> Spread:
    """Seconds that ``work`` takes, after one call that does not count.

    Args:
        work: Function to time.
        repetitions: Calls at most, at least one.
        time_limit: No further call begins once the counted ones have taken this long [s].
    """
    return Spread.of(in_turn((work,), repetitions, time_limit)[0])


def in_turn(works: Sequence[Callable[[], object]], repetitions: int, time_limit: float) -> list[list[float]]:
    """Seconds that each of several functions takes, called in turn; see :func:`measure`."""
    for work in works:
        work()
    seconds: list[list[float]] = [[] for _ in works]
    while not seconds[0] or (len(seconds[0]) < repetitions and sum(map(sum, seconds)) < time_limit):
        for work, taken in zip(works, seconds, strict=True):
            begin = time.perf_counter()
            work()
            taken.append(time.perf_counter() - begin)
    return seconds
