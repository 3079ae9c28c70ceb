"""The coarse guidance of D4orm-C2F: a path for the team, and each robot's waypoint and subgoal (paper, section VI)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.tracking.tracker import follow_reference


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarseWaypoints:
    """Path that a team follows."""

    path: FloatArray  #: ``(H+1, K, d)`` waypoints, one per time step of the control loop [m]
    ordered: bool  #: Whether the path was found on a roadmap, where precedence decides


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarsePlan(CoarseWaypoints):
    """A coarse plan and the path made from it."""

    problem: Problem  #: The coarse problem: larger time steps from where the plan begins
    controls: FloatArray  #: ``(H_c, K, m)`` of the coarse plan
    states: FloatArray  #: ``(H_c+1, K, n)``


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
    """``(factor * H_c + 1, K, d)`` evenly spaced waypoints, of which every ``factor``-th is one of a coarse path
    ``(H_c+1, K, d)`` (paper, Algorithm 4, line 3).
    """
    share = (np.arange(factor, dtype=path.dtype) / factor)[None, :, None, None]
    between = path[:-1, None] * (1 - share) + path[1:, None] * share
    return np.concatenate([between.reshape(-1, *path.shape[1:]), path[-1:]])


def nearest_indices(path: FloatArray, positions: FloatArray, last: IntArray, window: int) -> IntArray:
    """``(K,)`` indices of the waypoints on ``path`` ``(H+1, K, d)`` nearest to robots at ``positions`` ``(K, d)``.

    As a path may cross itself, only ``window`` waypoints are searched, from those found ``last`` ``(K,)`` on.
    """
    index = np.minimum(np.asarray(last)[:, None] + np.arange(window + 1), len(path) - 1)
    ahead = path[index, np.arange(len(index))[:, None]]
    return index[:, 0] + ((ahead - positions[:, None]) ** 2).sum(axis=2).argmin(axis=1)


def subgoal_indices(indices: IntArray, mean: int, offset: int, lag: int, last: int) -> IntArray:
    """``(K,)`` the waypoint, at most the ``last``, that every robot heads for (paper, Algorithm 4, line 7).

    The paper's is the same for all robots: the ``mean`` of their ``indices`` ``(K,)`` and an ``offset``. A robot that
    lags by more than ``lag`` waypoints would then leave its path, straight into obstacles that the path avoids; its
    subgoal stays behind with it instead.
    """
    return np.minimum(np.minimum(mean, indices + lag) + offset, last)


def rest_of(guidance: CoarsePlan, index: int, factor: int) -> tuple[Problem, FloatArray]:
    """The coarse problem that is left from a waypoint on, and the controls of the coarse plan for it."""
    step = min(-(-index // factor), len(guidance.controls) - 1)
    coarse = guidance.problem
    left = coarse.with_state(guidance.states[step], coarse.goal, horizon=coarse.horizon - step)
    return left, guidance.controls[step:]


LEAST = 5
"""Least number of waypoints that a subgoal is ahead: nearer ones hardly attract."""

_SHARES = np.linspace(0, 1, 9)[1:]
"""Shares of the straight line at which its clearance from obstacles is looked at."""


def visible_subgoals(
    problem: Problem, positions: FloatArray, path: FloatArray, indices: IntArray, targets: IntArray, arrived: BoolArray,
    walls: bool,
) -> IntArray:  # fmt: skip
    """``(K,)`` the furthest waypoint up to its subgoal that each robot can drive to straight, past all that is at rest.

    A robot would get stuck on its way to a subgoal behind a corner, or behind a robot that has arrived.

    Args:
        problem: The problem.
        positions: ``(K, d)`` of the robots [m].
        path: ``(H+1, K, d)`` waypoints [m].
        indices: ``(K,)`` the robots' own.
        targets: ``(K,)`` their subgoals.
        arrived: ``(K,)`` robots at rest.
        walls: Whether obstacles count too.
    """
    radius, resting = np.asarray(problem.team.radius), np.flatnonzero(arrived)
    result = targets.copy()
    waiting = np.flatnonzero(~arrived & (targets > indices + LEAST))
    while len(waiting):
        offset = path[result[waiting], waiting] - positions[waiting]
        width = radius[waiting] + problem.margin / 2
        blocked = _meets_resting(positions[waiting], offset, width, positions[resting], radius[resting])
        if walls:
            points = positions[waiting] + _SHARES[:, None, None] * offset
            clearance = problem.world.clearance(points.reshape(-1, points.shape[-1])).reshape(points.shape[:-1])
            blocked |= (clearance <= width).any(axis=0)
        waiting = waiting[blocked]
        result[waiting] -= 1
        waiting = waiting[result[waiting] > indices[waiting] + LEAST]
    return result


def _meets_resting(
    begin: FloatArray, offset: FloatArray, width: FloatArray, others: FloatArray, radius: FloatArray
) -> BoolArray:
    """``(N,)`` whether a straight path from ``begin`` by ``offset``, so wide to either side, meets another robot."""
    gap = others - begin[:, None]
    square = (offset**2).sum(axis=1)[:, None]
    share = np.clip((gap * offset[:, None]).sum(axis=2) / np.where(square > 0, square, 1), 0, 1)
    away = ((gap - share[:, :, None] * offset[:, None]) ** 2).sum(axis=2)
    meets: BoolArray = (away <= (width[:, None] + radius) ** 2).any(axis=1)
    return meets


STUCK_WITHIN, STUCK_AFTER = 3, 25
"""Waypoints that a robot must pass in so many time steps, or else is stuck."""
BARRED_AFTER = 8
"""The same number of steps for robots whose paths lead through others at rest for good."""
WAITING_WITHIN = 1.0
"""Distance from its present waypoint within which a robot waits, in radii of the largest one."""
CAREFUL_FOR = 30
"""Steps for which a robot that was stuck follows its path."""
CATCHING_UP = 2.0
"""Share of its lag that a robot makes up for in a second [1/s]."""


class StagnationMonitor:
    """Detects robots that make no progress along their paths.

    Args:
        joint: Their first state.
    """

    def __init__(self, joint: JointState) -> None:
        self._indices = np.zeros(len(joint.goals), int)
        self._since = np.full(len(joint.goals), joint.steps)
        self._careful_until = np.full(len(joint.goals), joint.steps)

    def observe(self, step: int, indices: IntArray, waiting: BoolArray) -> tuple[IntArray, BoolArray]:
        """``(K,)`` steps without progress, and ``(K,)`` robots that are stuck or were so recently.

        Args:
            step: Time step.
            indices: ``(K,)`` waypoints that the robots are at; lower ones than before are of another path.
            waiting: ``(K,)`` robots that are on time, or ahead of the team.
        """
        moved = (indices >= self._indices + STUCK_WITHIN) | (indices < self._indices) | waiting
        self._indices[moved], self._since[moved] = indices[moved], step
        idle = step - self._since
        self._careful_until[idle > STUCK_AFTER] = step + CAREFUL_FOR
        return idle, self._careful_until > step


def keep_time(problem: Problem, joint: JointState, path: FloatArray, indices: IntArray, horizon: int) -> FloatArray:
    """``(horizon, K, m)`` controls that take every robot along its path in the path's own time, as if it had no goal.

    Of ``path`` ``(H+1, K, d)``, which has a waypoint per time step of the problem [m], they should be at ``indices``
    ``(K,)`` now; from elsewhere they catch up.
    """
    due = path[np.minimum(indices + np.arange(horizon + 1)[:, None], len(path) - 1), np.arange(len(indices))]
    return follow_reference(problem, joint.states, due[:-1], np.diff(due, axis=0) / problem.dt, CATCHING_UP)
