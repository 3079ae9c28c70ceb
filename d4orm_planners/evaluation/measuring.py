"""Measuring of a benchmark: its settings, in full and for a first look, and a stopwatch whose readings are samples."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import Field

from d4orm_env.dynamics.models import COMMON, get_model
from d4orm_planners.base.settings import CheckedSettings, Count, Positive, Samples, Steps, Whole, one_of

ENGINES = ("cpu", "jax", "plain")
SECTIONS = (
    "denoising", "threads", "environments", "obstacles", "index", "robots", "startup", "memory", "plans", "big teams",
    "improvement", "big loops",
)  # fmt: skip
MODELS = (
    *COMMON, "unicycle", "unicycle1", "unicycle2", "car", "car_first_order", "holonomic2d_jerk", "holonomic3d_drag",
)  # fmt: skip

Robots = Annotated[Count, Field(le=10_000)]  #: Number of robots, as many as scenarios make


@dataclass(frozen=True, kw_only=True)
class BenchmarkSettings(CheckedSettings):
    """Settings of a benchmark."""

    sections: tuple[Annotated[str, one_of(SECTIONS)], ...] = SECTIONS  #: Parts to measure, of :data:`SECTIONS`
    num_robots: tuple[Robots, ...] = (4, 8, 16, 32, 64, 100)  #: Team sizes
    models: tuple[str, ...] = MODELS  #: Robot models
    #: Of :data:`ENGINES`; ``"plain"`` is :mod:`d4orm_planners.reference`, which has the common models
    engines: tuple[Annotated[str, one_of(ENGINES)], ...] = ENGINES
    num_samples: Samples = 1024  #: ``M``
    horizon: Steps = 100  #: ``H``
    num_steps: Steps = 100  #: Denoising steps in an iteration
    repetitions: Count = 20  #: Calls per measurement at most
    time_limit: Positive = 2.0  #: Seconds per measurement, after which no further call begins
    iteration_limit: Positive = 20.0  #: Whole iterations expected to take longer than this are left out [s]
    most_robots_slow: Annotated[Whole, Field(ge=0)] = 16  #: Largest team but on the CPU engine and accelerators
    env_steps: Count = 2000  #: Environment steps per repetition
    num_worlds: Steps = 1024  #: Worlds in the batched environment
    plan_robots: tuple[Robots, ...] = (4, 8, 12, 16)  #: Team sizes for the first feasible plan
    seeds: Count = 20  #: Seeds ``0, 1, ...`` per team size
    plan_time_limit: Positive = 20.0  #: Seconds per plan
    thread_robots: tuple[Robots, ...] = (8, 16, 64)  #: Teams whose iterations are timed with several threads and one
    memory_robots: Robots = 64  #: Team size of the memory measurement
    obstacles: tuple[Count, ...] = (4, 200, 1000, 5000)  #: Numbers of boxes among the paths of 8 robots
    far_obstacles: tuple[Count, ...] = (200,)  #: The same of boxes far away; also what environments are stepped among
    map_cells: tuple[Count, ...] = (32, 256)  #: Cells along a side of the maps whose index of obstacles is timed
    big_random: tuple[Robots, ...] = (1000, 2000)  #: Team sizes for the default planner's first plan on open ground
    big_warehouse: tuple[Robots, ...] = (100, 200)  #: The same in warehouses
    big_drives: tuple[Robots, ...] = (100,)  #: The same of differential drives
    big_boxes: tuple[Robots, ...] = (16, 50)  #: The same of rectangles with goal headings in warehouses
    big_free_boxes: tuple[Robots, ...] = (100,)  #: The same of rectangles without
    big_seeds: Count = 3  #: Seeds of these, and of the plans that are improved
    big_time_limit: Positive = 120.0  #: Seconds per plan of these
    improved_robots: tuple[Robots, ...] = (8, 24)  #: Team sizes whose first plans are improved
    improving_limit: Positive = 0.05  #: Time that this may take [s]
    loop_robots: tuple[Robots, ...] = (64, 512)  #: Team sizes for control loops of D4orm-C2F
    loops: Count = 30  #: Their number

    def __post_init__(self) -> None:
        super().__post_init__()
        for model in self.models:
            get_model(model)


QUICK: Mapping[str, object] = {
    "sections": tuple(section for section in SECTIONS if section not in {"robots", "startup"}), "engines": ("cpu",),
    "num_robots": (4, 8), "models": ("holonomic2d", "differential_drive"), "num_steps": 20, "repetitions": 3,
    "time_limit": 0.5, "iteration_limit": 2.0, "most_robots_slow": 8, "env_steps": 500, "num_worlds": 128,
    "plan_robots": (4, 8), "seeds": 2, "plan_time_limit": 5.0, "thread_robots": (8,), "memory_robots": 16,
    "obstacles": (4, 200), "map_cells": (32,), "big_random": (100,), "big_warehouse": (16,), "big_drives": (8,),
    "big_boxes": (4,), "big_free_boxes": (8,), "big_seeds": 2, "big_time_limit": 10.0, "improved_robots": (8,),
    "loop_robots": (16,), "loops": 10,
}  # fmt: skip
"""Settings of a benchmark of about a minute, for a first look; starts and controllers take as long by themselves."""

Measurement: TypeAlias = dict[str, Any]  #: Measurement of one case, by column: numbers, texts and :class:`Spread`


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


def measure(settings: BenchmarkSettings, work: Callable[[], object]) -> Spread:
    """Seconds that ``work`` takes, after one call that does not count, by the settings' repetitions and time limit."""
    return Spread.of(in_turn(settings, work)[0])


def in_turn(settings: BenchmarkSettings, *works: Callable[[], object]) -> list[list[float]]:
    """Seconds that each of several functions takes, called in turn; see :func:`measure`."""
    for work in works:
        work()
    seconds: list[list[float]] = [[] for _ in works]
    while not seconds[0] or (len(seconds[0]) < settings.repetitions and sum(map(sum, seconds)) < settings.time_limit):
        for work, taken in zip(works, seconds, strict=True):
            begin = time.perf_counter()
            work()
            taken.append(time.perf_counter() - begin)
    return seconds
