"""Paths round robots that have arrived, for policies that have learned to head straight for their goals."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.tracking.steering import goals_along_paths


class Detours:
    """Shortest paths round arrived robots, in one episode.

    A robot without memory that heads straight for its goal stops behind others that have arrived. A path is found when
    a robot first needs it, and again when another one has arrived.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._arrived = np.zeros(problem.num_robots, np.bool_)
        self._alone: dict[int, Problem] = {}

    def goals(self, joint: JointState, positions: FloatArray) -> FloatArray:
        """Return where robots should head: their goals, or along their paths where an arrived robot is in the way.

        Args:
            joint: The team.
            positions: ``(K, d)`` where the robots are [m].

        Returns:
            ``(K, d)`` [m].
        """
        if (joint.arrived != self._arrived).any():
            self._arrived, self._alone, world = joint.arrived, {}, self._problem.world
            balls = np.column_stack([joint.states[self._arrived, : world.dimension], self._radius[self._arrived]])
            kind = "circles" if world.dimension == 2 else "spheres"
            self._world = world.replace(**{kind: np.concatenate([world.balls, balls])})
        heads = joint.goals.copy()
        for robot in self._blocked(joint, positions).tolist():
            if robot not in self._alone:
                one = self._problem.select([robot])
                start = joint.states[[robot], : one.state_size]
                self._alone[robot] = one.with_state(start, joint.goals[[robot]], world=self._world)
            heads[robot] = goals_along_paths(self._alone[robot], positions[[robot]], joint.goals[[robot]])[0]
        return heads

    @property
    def _radius(self) -> FloatArray:
        return self._problem.team.radius

    def _blocked(self, joint: JointState, positions: FloatArray) -> IntArray:
        """Numbers of the robots that an arrived one is in the way of."""
        arrived, ahead = self._arrived, joint.goals - positions
        offsets = joint.states[arrived, : self._problem.dimension] - positions[:, None]
        along = (
            np.einsum("kd,knd->kn", ahead, offsets)
            / np.maximum((ahead * ahead).sum(axis=1), np.finfo(np.float32).tiny)[:, None]
        )
        distances = np.linalg.norm(offsets - np.clip(along, 0, 1)[..., None] * ahead[:, None], axis=2)
        safety_distance = self._radius[:, None] + self._radius[arrived] + self._problem.margin
        return np.flatnonzero((distances < safety_distance).any(axis=1) & ~arrived)
