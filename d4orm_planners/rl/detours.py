"""Paths round robots that have docked, for policies that have learned to head straight for their goals."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.tracking.steering import goals_along_paths


class Detours:
    """Shortest paths round docked robots, in one episode.

    Who has no memory and heads straight for its goal stands still behind others that have docked. A path is found when
    a robot first needs it, and again when another one has docked.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._docked = np.zeros(problem.num_robots, np.bool_)
        self._alone: dict[int, Problem] = {}

    def goals(self, joint: JointState, positions: FloatArray) -> FloatArray:
        """Return where robots should head: their goals, or along their paths where a docked robot is in the way.

        Args:
            joint: The team.
            positions: ``(K, d)`` where the robots are [m].

        Returns:
            ``(K, d)`` [m].
        """
        if (joint.arrived != self._docked).any():
            self._docked, self._alone, world = joint.arrived, {}, self._problem.world
            round_ones = np.column_stack([joint.states[self._docked, : world.dimension], self._radius[self._docked]])
            kind = "circles" if world.dimension == 2 else "spheres"
            self._world = world.replace(**{kind: np.concatenate([world.balls, round_ones])})
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
        """Numbers of the robots that a docked one is in the way of."""
        arrived, ahead = self._docked, joint.goals - positions
        beside = joint.states[arrived, : self._problem.dimension] - positions[:, None]
        along = (
            np.einsum("kd,knd->kn", ahead, beside)
            / np.maximum((ahead * ahead).sum(axis=1), np.finfo(np.float32).tiny)[:, None]
        )
        gaps = np.linalg.norm(beside - np.clip(along, 0, 1)[..., None] * ahead[:, None], axis=2)
        reach = self._radius[:, None] + self._radius[arrived] + self._problem.margin
        return np.flatnonzero((gaps < reach).any(axis=1) & ~arrived)
