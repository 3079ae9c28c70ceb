"""Following the coarse path itself, where precedence decides or sampling leaves robots stuck."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.engine.types import Engine
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.tracking.steering import track_team

STUCK_WITHIN, STUCK_AFTER = 3, 25
"""Progress without which a robot is stuck: so many waypoints in so many time steps."""

BARRED_AFTER = 8
"""The same for robots whose paths lead through those at rest for good."""

WAITING_WITHIN = 1.0
"""A robot this near to where it should be by now waits, in radii of the largest one."""

CAREFUL_FOR = 30
"""Steps for which a robot that was stuck follows its path."""

CATCHING_UP = 2.0
"""Share of its lag that a robot makes good in a second [1/s]."""


class StagnationMonitor:
    """Watches an episode for robots that do not get on along their paths.

    Args:
        joint: Their first state.
    """

    def __init__(self, joint: JointState) -> None:
        self._indices = np.zeros(len(joint.goals), int)
        self._since = np.full(len(joint.goals), joint.steps)
        self._careful_until = np.full(len(joint.goals), joint.steps)

    def observe(self, step: int, indices: IntArray, waiting: BoolArray) -> tuple[IntArray, BoolArray]:
        """``(K,)`` steps without progress, and robots that are stuck, or were not long ago, and so follow their paths.

        Args:
            step: Time step.
            indices: ``(K,)`` waypoints that the robots are at; lower ones than before are of another path.
            waiting: ``(K,)`` robots that are where they should be by now, or ahead of the team.
        """
        moved = (indices >= self._indices + STUCK_WITHIN) | (indices < self._indices) | waiting
        self._indices[moved], self._since[moved] = indices[moved], step
        idle = step - self._since
        self._careful_until[idle > STUCK_AFTER] = step + CAREFUL_FOR
        return idle, self._careful_until > step


def keep_time(
    problem: Problem, engine: Engine, joint: JointState, path: FloatArray, indices: IntArray, horizon: int
) -> FloatArray:
    """Controls that take every robot along its path in the path's own time, as if none docked.

    Args:
        problem: The robots; the path has a waypoint per time step of it.
        engine: Engine for rollouts.
        joint: Their state.
        path: ``(H+1, K, d)`` waypoints [m].
        indices: ``(K,)`` where on it they should be now; from elsewhere they catch up.
        horizon: Steps.

    Returns:
        ``(horizon, K, m)``.
    """
    every, last, d = np.arange(len(indices)), len(path) - 1, path.shape[2]

    def wanted(t: int, states: FloatArray) -> FloatArray:
        now, after = (path[np.minimum(indices + step, last), every] for step in (t, t + 1))
        velocities: FloatArray = (after - now) / problem.dt + CATCHING_UP * (now - states[:, :d])
        return velocities

    controls = track_team(problem.with_state(joint.states, joint.goals), engine, horizon, wanted, each_alone=True)
    assert controls is not None
    return controls
