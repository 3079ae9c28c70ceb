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


class _Snapshot(NamedTuple):
    states: FloatArray
    goals: FloatArray
    arrived: BoolArray
    collided: BoolArray
    violated: BoolArray
    bodies: FloatArray


class EpisodeBuffer:
    """Steps since team, world or policies last changed; one thread may add while others make replays."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._snapshots: deque[_Snapshot] = deque(maxlen=MOST_STEPS)
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._snapshots)

    def add(self, *snapshot: np.ndarray) -> None:
        """Remember a snapshot.

        Args:
            *snapshot: States ``(K, n)``, goals ``(K, d)``, ``(K,)`` who has arrived, who has collided and who has come
                too close, and ``(N, 2 d + 1)`` what moves about and is no robot.
        """
        with self._lock:
            self._snapshots.append(_Snapshot(*snapshot))

    def motion(self, policy: str) -> ReplayMotion:
        """Return the motion for a replay."""
        with self._lock:
            problem, snapshots = self._problem, list(self._snapshots)
        states = np.stack([snapshot.states for snapshot in snapshots])
        steps = len(snapshots) - 1
        trajectory = Trajectory(
            states=states,
            positions=states[..., : problem.dimension],
            controls=np.zeros((steps, problem.num_robots, problem.control_size), np.float32),
            rewards=np.zeros((steps, problem.num_robots), np.float32),
            arrived=np.stack([snapshot.arrived for snapshot in snapshots]),
            collided=np.stack([snapshot.collided for snapshot in snapshots]),
            margin_violated=np.stack([snapshot.violated for snapshot in snapshots]),
        )
        goals = np.stack([snapshot.goals for snapshot in snapshots])
        bodies = np.zeros(
            (len(snapshots), max(len(snapshot.bodies) for snapshot in snapshots), 2 * problem.dimension + 1), np.float32
        )
        for row, snapshot in zip(bodies, snapshots):
            row[: len(snapshot.bodies)] = snapshot.bodies
        return motion(problem, trajectory, f"{policy}, {steps * problem.dt:.1f} s", goals=goals, bodies=bodies)
