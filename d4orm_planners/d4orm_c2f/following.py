"""Following the coarse path itself: in its own time, or slowly where sampling leaves robots stuck."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.engine.base import Engine
from d4orm_env.joint_state import JointState
from d4orm_planners.steering import preferred_velocities, track_velocities

STUCK_WITHIN, STUCK_AFTER = 3, 25
"""How many waypoints a robot has to get on in so many time steps not to be stuck."""

WAITING_WITHIN = 0.15
"""A robot this near to where it should be by now waits [m]."""

CAREFUL_FOR = 30
"""Steps for which a robot that was stuck follows its path."""

SPEED, REACHED = 0.3, 0.05
"""How fast it does [m/s], and how near to a waypoint it turns to the next one [m]."""

CATCHING_UP = 2.0
"""What of its lag a robot makes good in a second [1/s]."""


class Patience:
    """Watches an episode for robots that do not get on along their paths.

    Args:
        joint: Where they begin.
    """

    def __init__(self, joint: JointState) -> None:
        self._indices = np.zeros(len(joint.goals), int)
        self._since = np.full(len(joint.goals), joint.steps)
        self._careful_until = np.full(len(joint.goals), joint.steps)

    def observe(self, step: int, indices: IntArray, waiting: BoolArray) -> tuple[BoolArray, BoolArray]:
        """``(K,)`` who is stuck now, and who is or was not long ago, so that it follows its path slowly.

        Args:
            step: Time step.
            indices: ``(K,)`` waypoints that the robots are at; lower ones than before are of another path.
            waiting: ``(K,)`` who is where it should be by now, or ahead of the team.
        """
        moved = (indices >= self._indices + STUCK_WITHIN) | (indices < self._indices) | waiting
        self._indices[moved], self._since[moved] = indices[moved], step
        late = step - self._since > STUCK_AFTER
        self._careful_until[late] = step + CAREFUL_FOR
        return late, self._careful_until > step


def follow_slowly(
    problem: Problem, engine: Engine, joint: JointState, path: FloatArray, indices: IntArray, horizon: int
) -> FloatArray:
    """``(horizon, K, m)`` controls that take every robot along its path, slowly.

    Args:
        problem: The robots.
        engine: What moves them.
        joint: Where they are.
        path: ``(H+1, K, d)`` waypoints [m].
        indices: ``(K,)`` where on it they are.
        horizon: Steps.
    """
    every, at = np.arange(len(indices)), indices.copy()

    def velocities(t: int, states: FloatArray) -> FloatArray:
        for _ in range(2):
            gap = np.linalg.norm(path[at, every] - states[:, : path.shape[2]], axis=1)
            at[:] = np.minimum(at + (gap < REACHED), len(path) - 1)
        ahead = np.where((at == len(path) - 1)[:, None], joint.goals, path[at, every])
        wanted = preferred_velocities(problem, states, ahead)
        speed = np.linalg.norm(wanted, axis=1, keepdims=True)
        slow: FloatArray = wanted * np.minimum(1, SPEED / np.maximum(speed, SPEED))
        return slow

    return _tracking(problem, engine, joint, velocities, horizon)


def keep_time(
    problem: Problem, engine: Engine, joint: JointState, path: FloatArray, indices: IntArray, horizon: int
) -> FloatArray:
    """The same in the path's own time, which has a waypoint per time step; at ``indices`` each robot should be now."""
    every, last = np.arange(len(indices)), len(path) - 1

    def velocities(t: int, states: FloatArray) -> FloatArray:
        now = path[np.minimum(indices + t, last), every]
        after = path[np.minimum(indices + t + 1, last), every]
        wanted = (after - now) / problem.dt + CATCHING_UP * (now - states[:, : path.shape[2]])
        return wanted.astype(np.float32)

    return _tracking(problem, engine, joint, velocities, horizon)


def _tracking(
    problem: Problem,
    engine: Engine,
    joint: JointState,
    velocities: Callable[[int, FloatArray], FloatArray],
    horizon: int,
) -> FloatArray:
    """``(horizon, K, m)`` controls that track ``velocities(t, states)`` ``(K, d)``, as if nobody docked."""
    states, arrays = joint.states, problem.resumed_at(joint.states, joint.goals).arrays
    nobody = np.zeros(problem.num_robots, bool)
    controls = np.empty((horizon, problem.num_robots, problem.control_size), np.float32)
    for t in range(horizon):
        controls[t] = track_velocities(problem, states, velocities(t, states))
        states = engine.step(arrays, states, nobody, controls[t]).states
    return controls
