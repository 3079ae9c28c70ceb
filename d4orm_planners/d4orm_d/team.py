"""A team's controls in the course of an iteration, changed for some robots after others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine.base import MovingObstacles, SamplingTask
from d4orm_planners.d4orm import D4orm
from d4orm_planners.grouping import conflicts
from d4orm_planners.planner import Iteration
from d4orm_planners.search import Search


class TeamPaths:
    """What the team does, to be changed for some robots around all others.

    Args:
        planner: Whose rules deformations go by.
        search: The search.
        trajectory: What the team does at first.

    Attributes:
        controls: ``(H, K, m)``.
        positions: ``(H+1, K, d)`` [m].
        arrived: ``(K,)`` whether each ends at its goal.
        graph: ``(K, K)`` who comes within the margin of whom.
    """

    def __init__(self, planner: D4orm, search: Search, trajectory: Trajectory) -> None:
        self.planner, self.search, self.problem = planner, search, search.problem
        self.controls = trajectory.controls.copy()
        self.positions = trajectory.positions.copy()
        self.arrived: BoolArray = trajectory.arrived[-1].copy()
        self.graph = self.conflicts(self.positions)
        self._denoising_steps = self._excluded = self._runs = 0

    def conflicts(self, positions: FloatArray) -> BoolArray:
        """``(K, K)`` who comes within the margin of whom after the start."""
        return conflicts(positions[1:], self.problem.team.radius, self.problem.margin)

    def deformed(
        self, robots: Sequence[int], horizon: int, num_samples: int, noise_scale: FloatArray, **scoring: Any
    ) -> tuple[Problem, FloatArray, Trajectory]:
        """Deform these robots' first ``horizon`` controls around all others.

        Returns:
            The problem of these robots alone, their new controls as planned, and the rollout of those in it.
        """
        planner, search, problem = self.planner, self.search, self.problem
        part = problem.select(robots)
        others = [robot for robot in range(problem.num_robots) if robot not in set(robots)]
        moving = None
        if others:
            radius = np.asarray(problem.team.radius)[others]
            moving = MovingObstacles(self.positions[1 : horizon + 1, others], radius)
        base = np.ascontiguousarray(self.controls[:horizon, robots, : part.control_size])
        task = SamplingTask(part.resumed_at(part.start, part.goal, horizon=horizon), base, moving=moving, **scoring)
        self._runs += 1
        start, seed = planner.start(search, base, self._runs), search.iteration_seed(Stream.REPAIR, self._runs)
        result = search.denoise(task, planner.rules(), start, noise_scale, num_samples, seed)
        self._denoising_steps += len(result.rewards)
        self._excluded += result.excluded
        controls = np.zeros((problem.horizon, len(robots), part.control_size), np.float32)
        controls[:horizon] = base + result.mean
        return part, controls, search.engine.rollout(part, controls)

    def iteration(self) -> Iteration:
        """What came of it."""
        return Iteration(self.controls, self._denoising_steps, self._excluded)
