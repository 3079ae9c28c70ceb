"""Independent repairs: robots without conflicts among them at once, around all others; no robot gets worse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.verify import VerificationReport
from d4orm_planners.base.conflict_groups import components, independent_robots
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan, approach_goals
from d4orm_planners.d4orm_d.settings import D4ormDConfig
from d4orm_planners.engine.sampling_types import SamplingTask, moving_robots
from d4orm_planners.sampling.d4orm import DeformingPlanner

NOISE_FACTORS = (1.0, 2.0)
"""Noise factors of successive repairs: wider noise may get around what ordinary noise does not."""
SLACK = 40
"""Steps of a repair beyond the latest arrival of its robots. Later ones have nothing to search, and would dilute the
rewards."""
RECENCY_GAIN, RECENCY_DECAY = 0.3, 0.7
"""Increase of a robot's recency by a repair, and its decay per iteration; the least recent are repaired first."""
CROWDING = 0.2
"""Priority of a robot for every robot that it meets: it blocks the most."""
JOINT_INTERVAL, JOINT_FAILURES, JOINT_ROBOTS = 3, 2, 3
"""Iterations between joint repairs by the team's reward, failed repairs in a row of each robot before one, and largest
number of robots: some can get out of each other's way only together."""
SHORTENINGS = 2
"""Number of successive searches for shorter final approaches."""


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
        start = planner.start(search, base, part.team, self._runs)
        seed = search.iteration_seed(Stream.REPAIR, self._runs)
        result = search.denoise(task, planner.rules(), start, noise_scale, num_samples, seed)
        self._denoising_steps += len(result.rewards)
        self._excluded += result.excluded
        controls = np.zeros((problem.horizon, len(robots), part.control_size), np.float32)
        controls[:horizon] = base + result.mean
        return part, controls, search.engine.rollout(part, controls)

    def iteration(self) -> Iteration:
        """Return the result."""
        return Iteration(self.controls, self._denoising_steps, self._excluded)


@dataclass(frozen=True, eq=False)
class Repairs:
    """The state of the search by independent repairs."""

    failures: IntArray  #: ``(K,)`` failed repairs in a row of each robot
    recency: Floats  #: ``(K,)`` how often each was repaired, decaying with every iteration

    @classmethod
    def of(cls, num_robots: int) -> Repairs:
        """The state before the first repair."""
        return cls(np.zeros(num_robots, int), np.zeros(num_robots))

    def repair(self, team: DeformedPlan, config: D4ormDConfig) -> Repairs:
        """Deform the controls of some robots that fail, and accept what is no worse."""
        repair = _Repair(team, self)
        repair.run(config)
        return Repairs(repair.failures, repair.recency)

    def improve(self, team: DeformedPlan) -> Repairs:
        """Let all robots turn to their goals as soon as that is no worse."""
        repair = _Repair(team, self)
        repair.improve()
        return Repairs(repair.failures, repair.recency)


class _Repair:
    """One iteration of repairs."""

    def __init__(self, team: DeformedPlan, before: Repairs) -> None:
        self.team, self.search, self.problem = team, team.search, team.problem
        self.failures, self.recency = before.failures.copy(), before.recency

    def run(self, config: D4ormDConfig) -> None:
        """Deform the robots that fail, and improve final approaches once none does."""
        everybody = np.arange(self.problem.num_robots)
        failed, _ = self.team.faults(everybody)
        if failed.any() and not self.search.should_stop():
            self.deform(np.flatnonzero(failed), config)
            failed, _ = self.team.faults(everybody)
        if not failed.any():
            # Detours are longer than necessary at first.
            self.improve()

    def deform(self, failed: IntArray, config: D4ormDConfig) -> None:
        """Deform the controls of some of the robots that fail."""
        problem = self.problem
        robots, credit = self.next_robots(failed)
        moving = (self.team.positions[1:, robots] != self.team.positions[:-1, robots]).any(axis=2)
        horizon = min(int(moving.any(axis=1).nonzero()[0].max(initial=0)) + 1 + SLACK, problem.horizon)
        distance = np.linalg.norm(problem.goal - problem.start[:, : problem.dimension], axis=1)
        wider = NOISE_FACTORS[self.search.iteration % len(NOISE_FACTORS)]
        part, _, trajectory = self.team.deformed(
            robots,
            horizon,
            config.repair_samples,
            config.noise_scale(config.repair_steps) * np.float32(wider),
            credit=credit,
            penalty=config.repair_penalty,
            # Else a robot that starts next to its goal would lose far more by yielding than others.
            reference_distance=float(max(distance.mean(), problem.goal_radius)),
        )
        self.accept(robots, part, trajectory)

    def improve(self) -> None:
        """Let all robots turn to their goals as soon as that is no worse."""
        for _ in range(SHORTENINGS):
            if self.search.should_stop():
                break
            trajectory = self.search.engine.rollout(self.problem, self.team.controls)
            self.accept(range(self.problem.num_robots), self.problem, trajectory)

    def next_robots(self, failed: IntArray) -> tuple[tuple[int, ...], str]:
        """Choose the robots to repair, and the credit.

        They are robots that fail and have no conflicts among them, the least recently repaired first, each by its own
        reward. Every :data:`JOINT_INTERVAL` iterations a group of stuck robots is repaired by its team's reward.
        """
        search, graph = self.search, self.team.conflicts()
        degree = np.array([len(neighbours) for neighbours in graph])
        random = np.random.default_rng(search.iteration_seed(Stream.REPAIR_ORDER)).random(len(self.recency))
        order = np.argsort(self.recency + random - CROWDING * degree, kind="stable")
        if search.iteration % JOINT_INTERVAL == 0:
            stuck = [
                group
                for group in components(graph)
                if 1 < len(group) <= JOINT_ROBOTS and self.failures[list(group)].min() >= JOINT_FAILURES
            ]
            if stuck:
                return stuck[search.iteration // JOINT_INTERVAL % len(stuck)], "team"
        robots = independent_robots(order[np.isin(order, failed)].tolist(), graph)
        self.recency = self.recency.copy()
        self.recency[list(robots)] += RECENCY_GAIN
        self.recency *= RECENCY_DECAY
        return robots, "robot"

    def accept(self, robots: Sequence[int], part: Problem, trajectory: Trajectory) -> None:
        """Give robots their motions in the trajectory, or turns to their goals, and count the failures."""
        index = np.array(robots)
        approach_goals(self.team, index, part, trajectory, or_longer=True)
        faults, _ = self.team.faults(index)
        self.failures[index] = np.where(faults > 0, self.failures[index] + 1, 0)
