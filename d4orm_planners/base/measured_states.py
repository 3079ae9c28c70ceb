"""Measured times and states, and observations, made usable."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import (
    BoolArray,
    FloatArray,
    as_float32,
    frozen_array,
    frozen_per_robot,
    numbers_of,
    refuse_robots,
    short_repr,
)
from d4orm_env.core.problem import Problem
from d4orm_env.core.winding import MAX_ANGLE
from d4orm_planners.tracking.steering import advanced, by_model, short_way_round

OLDEST = 10  #: Age of a measured state at most, in periods
BEYOND = 4  #: Distance beyond the state space at which measured numbers are cut off, in sizes of the space
LATEST = 1e12  #: Largest time [s]; one in nanoseconds since 1970 is larger
Bounds = tuple[FloatArray, ...]  #: Lowest and highest states ``(K, n)``


def seconds(time: object) -> float:
    """Return a time of a clock [s]. Raises ValueError if it is none."""
    if isinstance(time, Real) and not isinstance(time, bool):
        with suppress(OverflowError):
            if abs(value := float(time)) <= LATEST:
                return value
    raise ValueError(f"time is {short_repr(time)}; give the seconds of one clock")


def brought_up(
    problem: Problem, states: FloatArray, known: BoolArray, driven: Sequence[FloatArray], age: ArrayLike
) -> FloatArray:
    """``(K, n)`` states of robots that are ``known`` after their ``age`` [s], as the models have it: by what they were
    ``driven`` by ``(K, m)`` in the last periods, at rest before. ValueError for an age above :data:`OLDEST` periods.
    """
    steps = frozen_per_robot(age, "age", len(known), zero_allowed=True) / np.float32(problem.dt)
    remedy = f"at most {OLDEST} periods; give NaN for what is older"
    refuse_robots(steps > OLDEST, "age", steps * np.float32(problem.dt), remedy, " s")
    steps = np.where(known, steps, np.float32(0))[:, None]
    for back in range(int(np.ceil(steps.max())), 0, -1):
        controls = driven[-back] if back <= len(driven) else np.zeros((len(known), problem.control_size), np.float32)
        moved = short_way_round(problem, advanced(problem, states, controls) - states)
        states = states + np.clip(steps - (back - 1), 0, 1) * moved
    return states


@cache
def robots_by_agent(num_robots: int) -> dict[str, int]:
    """Numbers of the robots of a team by the names of their agents."""
    return {f"robot_{robot}": robot for robot in range(num_robots)}


def acting_robots(policy: object, observations: Mapping[str, object]) -> list[int]:
    """Numbers of the robots asked for; ValueError if observations are not by agent, RuntimeError before reset."""
    problem: Problem | None = getattr(policy, "problem", None)
    if problem is None:
        raise RuntimeError("the policy has seen no environment yet; call reset(env) before act()")
    robots = robots_by_agent(problem.num_robots)
    with suppress(AttributeError, KeyError):
        return [robots[agent] for agent in observations.keys()]  # noqa: SIM118 - of a list this fails
    remedy = f"give them by agent, robot_0 to robot_{problem.num_robots - 1}, as env.step() returns them"
    if not isinstance(observations, Mapping):
        raise ValueError(f"observations are {short_repr(observations)}; {remedy}")
    unknown = next(agent for agent in observations if agent not in robots)
    raise ValueError(f"observations hold {short_repr(unknown)}, which is no agent of this team; {remedy}")


def stacked_observations(observations: Mapping[str, FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """``(N, *shape)`` observations of ``N`` robots. Raises ValueError if one has another shape or is not finite."""
    with suppress(ValueError):
        seen = as_float32([*observations.values()])
        if seen.shape == (len(observations), *shape) and np.isfinite(seen).all():
            return seen
    return np.stack([frozen_array(one, f"observation of {agent}", shape) for agent, one in observations.items()])


def completed(
    problem: Problem, bounds: Bounds, states: ArrayLike, reference: FloatArray, expected: Callable[[], FloatArray]
) -> tuple[FloatArray, BoolArray]:
    """``(K, n)`` measured states, and ``(K,)`` whose position and heading are finite; ValueError for another shape.

    Others are where the ``reference`` is. What else of a robot is not finite, as it has no sensor for it, is as
    ``expected``. Whole turns of angles say nothing, and numbers far beyond the state space are cut off.
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
