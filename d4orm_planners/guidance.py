"""The coarse guidance of D4orm-C2F: a path for the whole team, and where on it the team is (paper, section VI)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Guidance:
    """A coarse plan and the path made from it.

    Attributes:
        problem: The coarse problem: larger time steps from where the plan begins.
        controls: ``(H_c, K, m)`` of the coarse plan.
        states: ``(H_c+1, K, n)``.
        path: ``(H+1, K, d)`` waypoints, one per time step of the control loop [m].
    """

    problem: Problem
    controls: FloatArray
    states: FloatArray
    path: FloatArray


def coarse_problem(problem: Problem, factor: int) -> Problem:
    """The problem with steps ``factor`` times as long and as many fewer of them (paper, Algorithm 4, line 1)."""
    return problem.moment(
        problem.start, problem.goal, horizon=max(-(-problem.horizon // factor), 1), dt=problem.dt * factor
    )


def interpolate(path: FloatArray, factor: int) -> FloatArray:
    """Waypoints between those of a coarse path, evenly spaced (paper, Algorithm 4, line 3).

    Args:
        path: ``(H_c+1, K, d)`` [m].
        factor: Fine steps per coarse step.

    Returns:
        ``(factor * H_c + 1, K, d)``; every ``factor``-th is one of the path.
    """
    share = (np.arange(factor, dtype=path.dtype) / factor)[None, :, None, None]
    between = path[:-1, None] * (1 - share) + path[1:, None] * share
    return np.concatenate([between.reshape(-1, *path.shape[1:]), path[-1:]])


def passes_checks(trajectory: Trajectory, interval: int) -> bool:
    """Whether everyone arrives, and nobody violates the margin at any ``interval``-th step (paper, section VI-A)."""
    arrives = bool(trajectory.arrived[-1].all())
    return arrives and not trajectory.margin_violated[interval::interval].any()


def mean_index(path: FloatArray, positions: FloatArray, moving: BoolArray, last: int, window: int) -> int:
    """Where the team is on its path: the mean of the indices of the waypoints nearest to the robots, rounded.

    Args:
        path: ``(H+1, K, d)`` [m].
        positions: ``(K, d)`` [m].
        moving: ``(K,)`` robots that count; those that have arrived are near their last waypoints for ever.
        last: Index found before. The search goes on from there, because a path may cross itself.
        window: Waypoints after ``last`` that are looked at.

    Returns:
        At least ``last``, at most ``H``.
    """
    if not moving.any():
        return last
    ahead = path[last : last + window + 1, moving]
    gap2 = ((ahead - positions[moving]) ** 2).sum(axis=2)
    return last + round(float(gap2.argmin(axis=0).mean()))


def rest_of(guidance: Guidance, index: int, factor: int) -> tuple[Problem, Any]:
    """The coarse problem that is left from a waypoint on, and the controls of the coarse plan for it."""
    step = min(-(-index // factor), len(guidance.controls) - 1)
    coarse = guidance.problem
    left = coarse.moment(guidance.states[step], coarse.goal, horizon=coarse.horizon - step)
    return left, guidance.controls[step:]
