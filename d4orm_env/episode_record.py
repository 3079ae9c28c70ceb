"""Running numbers of an episode."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray


class EpisodeRecord:
    """Counts what happens to a team from step to step.

    Args:
        num_robots: ``K``.
        dt: Time step [s].
        lifelong: Whether robots go on to new goals when they arrive.
    """

    def __init__(self, num_robots: int, dt: float, lifelong: bool) -> None:
        self._dt = dt
        self._lifelong = lifelong
        self._steps = 0
        self._reward = 0.0
        self._arrival_step = np.full(num_robots, np.inf)
        self._goals_reached = np.zeros(num_robots, np.int64)
        self._collisions = np.zeros(num_robots, np.int64)
        self._margin_violations = np.zeros(num_robots, np.int64)

    def add(self, rewards: FloatArray, arrived: BoolArray, collided: BoolArray, margin_violated: BoolArray) -> None:
        """Count one step; all arguments are ``(K,)``."""
        self._steps += 1
        self._reward += float(np.add.reduce(rewards))
        # Most steps see none of these, and counting is much cheaper than adding.
        if np.count_nonzero(margin_violated):
            self._collisions += collided
            self._margin_violations += margin_violated
        if np.count_nonzero(arrived):
            new = arrived if self._lifelong else arrived & np.isinf(self._arrival_step)
            self._goals_reached += new
            self._arrival_step[new] = np.minimum(self._arrival_step[new], self._steps)

    def metrics(self) -> dict[str, float]:
        """The episode so far.

        Returns:
            ``steps``; ``reward``: mean over steps and robots; ``goals_reached``; ``goals_per_robot_minute``;
            ``collisions`` and ``margin_violations``: robot-steps in contact, or within the margin; ``collided`` and
            ``margin_violated``: robots that ever were. Unless lifelong also ``arrived``: robots docked; ``success``:
            1.0 when all have docked and none was ever in contact; ``travel_time`` and ``makespan``: mean and latest
            arrival [s], with the time so far for a robot that has not docked.
        """
        team_size, elapsed = len(self._collisions), self._steps * self._dt
        goals = int(self._goals_reached.sum())
        collided = int(np.count_nonzero(self._collisions))
        metrics = {
            "steps": float(self._steps),
            "reward": self._reward / (team_size * self._steps) if self._steps else 0.0,
            "goals_reached": float(goals),
            "goals_per_robot_minute": goals / (team_size * elapsed / 60) if self._steps else 0.0,
            "collisions": float(self._collisions.sum()),
            "margin_violations": float(self._margin_violations.sum()),
            "collided": float(collided),
            "margin_violated": float(np.count_nonzero(self._margin_violations)),
        }
        if not self._lifelong:
            times = np.minimum(self._arrival_step * self._dt, elapsed)
            metrics |= {
                "arrived": float(goals),
                "success": float(goals == team_size and not collided),
                "travel_time": float(times.mean()),
                "makespan": float(times.max()),
            }
        return metrics
