"""A team's controls in the course of an iteration, deformed for some robots after others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.verify import VerificationReport
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.engine.sampling_types import SamplingTask, moving_robots
from d4orm_planners.sampling.d4orm import DeformingPlanner


class DeformedPlan(WorkingPlan):
    """The team's plan, some robots' controls deformed around all others.

    Args:
        planner: Planner with the rules of deformations.
        search: The search.
        trajectory: The team's motion at first.
        report: Report of :func:`~d4orm_env.verify` on that, if it was asked.
    """

    def __init__(
        self,
        planner: DeformingPlanner,
        search: SolveRun,
        trajectory: Trajectory,
        report: VerificationReport | None = None,
    ) -> None:
        super().__init__(search, trajectory, report)
        self.planner = planner
        self._denoising_steps = self._excluded = self._runs = 0

    def deformed(
        self, robots: Sequence[int], horizon: int, num_samples: int, noise_scale: FloatArray, **scoring: Any
    ) -> tuple[Problem, FloatArray, Trajectory]:
        """Deform these robots' first ``horizon`` controls around all others.

        Returns:
            The problem of these robots alone, their new controls as planned, and the rollout of those in it.
        """
        planner, search, problem = self.planner, self.search, self.problem
        part = problem.select(robots)
        others = np.setdiff1d(np.arange(problem.num_robots), robots)
        moving = None
        if len(others):
            moving = moving_robots(problem.team.select(others.tolist()), self.states[1 : horizon + 1, others])
        base = np.ascontiguousarray(self.controls[:horizon, robots, : part.control_size])
        task = SamplingTask(
            part.with_state(part.start, part.goal, horizon=horizon), base, moving=moving,
            penalty_per_pair=planner.config.penalty_per_pair, **scoring,
        )  # fmt: skip
        self._runs += 1
        start, seed = (
            planner.start(search, base, part.team, self._runs),
            search.iteration_seed(Stream.REPAIR, self._runs),
        )
        result = search.denoise(task, planner.rules(), start, noise_scale, num_samples, seed)
        self._denoising_steps += len(result.rewards)
        self._excluded += result.excluded
        controls = np.zeros((problem.horizon, len(robots), part.control_size), np.float32)
        controls[:horizon] = base + result.mean
        return part, controls, search.engine.rollout(part, controls)

    def iteration(self) -> Iteration:
        """Return the result."""
        return Iteration(self.controls, self._denoising_steps, self._excluded)
