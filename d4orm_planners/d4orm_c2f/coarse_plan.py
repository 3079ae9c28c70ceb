"""The coarse guidance of D4orm-C2F: a path for the whole team, and where on it the team is (paper, section VI)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.problem import Problem


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarseWaypoints:
    """Path that a team follows.

    Attributes:
        path: ``(H+1, K, d)`` waypoints, one per time step of the control loop [m].
        ordered: Whether the path was found on a roadmap, where precedence decides.
    """

    path: FloatArray
    ordered: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarsePlan(CoarseWaypoints):
    """A coarse plan and the path made from it.

    Attributes:
        problem: The coarse problem: larger time steps from where the plan begins.
        controls: ``(H_c, K, m)`` of the coarse plan.
        states: ``(H_c+1, K, n)``.
    """

    problem: Problem
    controls: FloatArray
    states: FloatArray


def coarse_problem(problem: Problem, factor: int) -> Problem:
    """The problem with steps ``factor`` times as long and as many fewer of them (paper, Algorithm 4, line 1)."""
    return problem.with_state(
        problem.start,
        problem.goal,
        horizon=max(-(-problem.horizon // factor), 1),
        dt=problem.dt * factor,
        goal_speed=problem.goal_speed * np.float32(factor),
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


def nearest_indices(path: FloatArray, positions: FloatArray, last: IntArray, window: int) -> IntArray:
    """Return each robot's position on its path: the index of its nearest waypoint.

    Args:
        path: ``(H+1, K, d)`` [m].
        positions: ``(K, d)`` [m].
        last: ``(K,)`` indices found before. The search goes on from there, because a path may cross itself.
        window: Waypoints after those that are looked at.

    Returns:
        ``(K,)`` indices, at least ``last``, at most ``H``.
    """
    index = np.minimum(np.asarray(last)[:, None] + np.arange(window + 1), len(path) - 1)
    ahead = path[index, np.arange(len(index))[:, None]]
    return index[:, 0] + ((ahead - positions[:, None]) ** 2).sum(axis=2).argmin(axis=1)


def subgoal_indices(indices: IntArray, mean: int, offset: int, lag: int, last: int) -> IntArray:
    """The waypoint that every robot heads for (paper, Algorithm 4, line 7).

    The paper's is the same for all robots: the mean of their indices and an offset. A robot that was held up would then
    leave its path, straight into whatever the path leads around; it keeps to its own instead.

    Args:
        indices: ``(K,)`` where the robots are.
        mean: Their mean over the robots that count.
        offset: ``m``, waypoints from the mean to the subgoal.
        lag: Waypoints that a robot may be behind the mean and still head for the same subgoal.
        last: ``H``, the last waypoint.

    Returns:
        ``(K,)`` indices, at most ``last``.
    """
    return np.minimum(np.minimum(mean, indices + lag) + offset, last)


def rest_of(guidance: CoarsePlan, index: int, factor: int) -> tuple[Problem, FloatArray]:
    """The coarse problem that is left from a waypoint on, and the controls of the coarse plan for it."""
    step = min(-(-index // factor), len(guidance.controls) - 1)
    coarse = guidance.problem
    left = coarse.with_state(guidance.states[step], coarse.goal, horizon=coarse.horizon - step)
    return left, guidance.controls[step:]
