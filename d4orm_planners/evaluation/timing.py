"""Repeated wall-clock measurements, and the machine they were made on."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

LIBRARIES = ("d4orm-env", "numpy", "numba", "jax", "gymnasium", "pettingzoo")


@dataclass(frozen=True)
class Spread:
    """A sample of measurements in five numbers, in the unit of what was measured.

    Attributes:
        median: The middle.
        lower_quartile: A quarter lie below it.
        upper_quartile: A quarter lie above it.
        smallest: The smallest.
        largest: The largest.
        count: How many there were.
    """

    median: float
    lower_quartile: float
    upper_quartile: float
    smallest: float
    largest: float
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """The spread of some values.

        Raises:
            ValueError: If there are none.
        """
        if not len(values):
            raise ValueError("there are no measurements to summarise; measure at least once")
        smallest, lower, median, upper, largest = (float(v) for v in np.percentile(values, [0, 25, 50, 75, 100]))
        return cls(median, lower, upper, smallest, largest, len(values))

    def times(self, factor: float) -> Spread:
        """The same measurements in another unit.

        Raises:
            ValueError: If the factor is not positive, which would turn the order around.
        """
        if not factor > 0:
            raise ValueError(f"factor is {factor:g}; it must be positive")
        return Spread(
            median=self.median * factor,
            lower_quartile=self.lower_quartile * factor,
            upper_quartile=self.upper_quartile * factor,
            smallest=self.smallest * factor,
            largest=self.largest * factor,
            count=self.count,
        )


def measure(work: Callable[[], Any], repetitions: int, time_limit: float) -> Spread:
    """Seconds that ``work`` takes, after one call that does not count.

    Args:
        work: What to time.
        repetitions: Calls at most, at least one.
        time_limit: No further call begins once the counted ones have taken this long [s].
    """
    work()
    seconds: list[float] = []
    while not seconds or (len(seconds) < repetitions and sum(seconds) < time_limit):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return Spread.of(seconds)


def describe_machine() -> dict[str, Any]:
    """Processor, cores, system, load at this moment and the versions of the libraries that matter."""
    from d4orm_env.engine.threads import available_cores

    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "cores_used": available_cores(),
        "system": platform.platform(),
        "load_average": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "libraries": {name: _version(name) for name in LIBRARIES},
    }


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    """The model name, which :func:`platform.processor` does not tell on Linux."""
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        for line in listing.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
