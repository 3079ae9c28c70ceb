"""Measured times and states, made usable."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray, numbers_of, short_repr
from d4orm_env.core.problem import Problem
from d4orm_env.core.winding import MAX_ANGLE
from d4orm_planners.tracking.steering import by_model

BEYOND = 4
"""Distance beyond the state space at which measured numbers are cut off, in sizes of the space."""
LATEST = 1e12
"""Largest time [s]; one in nanoseconds since 1970 is larger."""

Bounds = tuple[FloatArray, ...]
"""Lowest and highest states ``(K, n)``."""


def seconds(time: object) -> float:
    """Return a time of a clock [s].

    Raises:
        ValueError: If it is none.
    """
    if isinstance(time, Real) and not isinstance(time, bool):
        with suppress(OverflowError):
            if abs(value := float(time)) <= LATEST:
                return value
    raise ValueError(f"time is {short_repr(time)}; give the seconds of one clock")


def completed(
    problem: Problem, bounds: Bounds, states: ArrayLike, reference: FloatArray, expected: Callable[[], FloatArray]
) -> tuple[FloatArray, BoolArray]:
    """``(K, n)`` measured states, and ``(K,)`` whose position and heading are finite.

    Others are where the ``reference`` is. What else of a robot is not finite, as it has no sensor for it, is as
    ``expected``. Whole turns of angles say nothing, and numbers far beyond the state space are cut off.

    Raises:
        ValueError: If the states have another shape.
    """
    measured = numbers_of(states, "states must be an array of numbers")
    if measured.shape != reference.shape:
        raise ValueError(f"states have shape {measured.shape}; expected (K, n) = {reference.shape}")
    finite = np.isfinite(measured)
    known: BoolArray = np.all(finite[:, : problem.dimension], axis=1)
    for model, robots in by_model(problem):
        if model.heading_index is not None:
            known[robots] &= finite[robots, model.heading_index]
    whole = np.where(known[:, None], measured if finite.all() else np.where(finite, measured, expected()), reference)
    for model, robots in by_model(problem):
        for index in model.angles:
            angle = whole[robots, index]
            whole[robots, index] = np.where(abs(angle) > MAX_ANGLE, np.remainder(angle, 2 * np.pi), angle)
    low, high = bounds
    return np.clip(whole, low - BEYOND * (high - low), high + BEYOND * (high - low)), known
