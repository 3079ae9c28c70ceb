"""The last minutes of a team, for replays."""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.render.replay import ReplayMotion, motion

MOST_STEPS = 6000
"""Ten minutes at the usual time step; what is older is forgotten."""


class _Moment(NamedTuple):
    states: FloatArray
    goals: FloatArray
    arrived: BoolArray
    collided: BoolArray
    violated: BoolArray


class Recording:
    """What happened since team, world or policies last changed; one thread may add while others make replays."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._moments: deque[_Moment] = deque(maxlen=MOST_STEPS)
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._moments)

    def add(self, *moment: np.ndarray) -> None:
        """Remember states ``(K, n)``, goals ``(K, d)``, and ``(K,)`` who has arrived, collided and come too close."""
        with self._lock:
            self._moments.append(_Moment(*moment))

    def motion(self, policy: str) -> ReplayMotion:
        """What happened, for a replay."""
        with self._lock:
            problem, moments = self._problem, list(self._moments)
        states = np.stack([moment.states for moment in moments])
        steps = len(moments) - 1
        trajectory = Trajectory(
            states=states,
            positions=states[..., : problem.dimension],
            controls=np.zeros((steps, problem.num_robots, problem.control_size), np.float32),
            rewards=np.zeros((steps, problem.num_robots), np.float32),
            arrived=np.stack([moment.arrived for moment in moments]),
            collided=np.stack([moment.collided for moment in moments]),
            margin_violated=np.stack([moment.violated for moment in moments]),
        )
        goals = np.stack([moment.goals for moment in moments])
        return motion(problem, trajectory, f"{policy}, {steps * problem.dt:.1f} s", goals=goals)
