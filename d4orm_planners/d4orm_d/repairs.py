"""Independent repairs: robots without conflicts among them at once, around all others; no robot gets worse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import Trajectory
from d4orm_planners.base.conflict_groups import components, independent_robots
from d4orm_planners.base.final_approach import approach_goals
from d4orm_planners.d4orm_d.deformed_plan import DeformedPlan
from d4orm_planners.d4orm_d.settings import RULES, D4ormDConfig


@dataclass(frozen=True, eq=False)
class Repairs:
    """The state of the search by independent repairs.

    Attributes:
        failures: ``(K,)`` failed repairs in a row of each robot.
        recency: ``(K,)`` how often each was repaired, decaying with every iteration.
    """

    failures: IntArray
    recency: NDArray[np.float64]

    @classmethod
    def of(cls, num_robots: int) -> Repairs:
        """The state before the first repair."""
        return cls(np.zeros(num_robots, int), np.zeros(num_robots))

    def repair(self, team: DeformedPlan, config: D4ormDConfig) -> Repairs:
        """Deform some of the failed robots' controls, and take over what is no worse."""
        repair = _Repair(team, self)
        repair.run(config)
        return Repairs(repair.failures, repair.recency)

    def shorten(self, team: DeformedPlan) -> Repairs:
        """Let all robots turn to their goals as soon as that is no worse."""
        repair = _Repair(team, self)
        repair.shorten()
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
            # The detours that got robots out of each other's way are longer than they need be.
            self.shorten()

    def deform(self, failed: IntArray, config: D4ormDConfig) -> None:
        """Deform the controls of some of the robots that fail."""
        problem = self.problem
        robots, credit = self.next_robots(failed)
        moving = (self.team.positions[1:, robots] != self.team.positions[:-1, robots]).any(axis=2)
        horizon = min(int(moving.any(axis=1).nonzero()[0].max(initial=0)) + 1 + RULES.slack, problem.horizon)
        distance = np.linalg.norm(problem.goal - problem.start[:, : problem.dimension], axis=1)
        wider = RULES.noise_factors[self.search.iteration % len(RULES.noise_factors)]
        part, _, trajectory = self.team.deformed(
            robots,
            horizon,
            config.repair_samples,
            config.noise_scale(config.repair_steps) * np.float32(wider),
            credit=credit,
            penalty=config.repair_penalty,
            # A robot that starts next to its goal has little to lose by making way, but would lose it many times over.
            reference_distance=float(max(distance.mean(), problem.goal_radius)),
        )
        self.take_over(robots, part, trajectory)

    def shorten(self) -> None:
        """Let all robots turn to their goals as soon as that is no worse."""
        for _ in range(RULES.shortenings):
            if self.search.should_stop():
                break
            trajectory = self.search.engine.rollout(self.problem, self.team.controls)
            self.take_over(range(self.problem.num_robots), self.problem, trajectory)

    def next_robots(self, failed: IntArray) -> tuple[tuple[int, ...], str]:
        """Choose the robots to repair, and whose reward to use.

        Of those that fail some without conflicts among them, those that were not repaired lately first, each by its
        own reward.
        Now and then a few robots that only together can get out of each other's way, by their team's.
        """
        search, graph = self.search, self.team.conflicts()
        degree = np.array([len(neighbours) for neighbours in graph])
        random = np.random.default_rng(search.iteration_seed(Stream.REPAIR_ORDER)).random(len(self.recency))
        order = np.argsort(self.recency + random - RULES.crowding * degree, kind="stable")
        if search.iteration % RULES.joint_interval == 0:
            stuck = [
                group
                for group in components(graph)
                if 1 < len(group) <= RULES.joint_robots and self.failures[list(group)].min() >= RULES.joint_failures
            ]
            if stuck:
                return stuck[search.iteration // RULES.joint_interval % len(stuck)], "team"
        robots = independent_robots(order[np.isin(order, failed)].tolist(), graph)
        self.recency = self.recency.copy()
        self.recency[list(robots)] += RULES.recency_gain
        self.recency *= RULES.recency_decay
        return robots, "robot"

    def take_over(self, robots: Sequence[int], part: Problem, trajectory: Trajectory) -> None:
        """Let robots do as in the trajectory, or turn to their goals in time, and count the failures."""
        index = np.array(robots)
        approach_goals(self.team, index, part, trajectory, or_longer=True)
        faults, _ = self.team.faults(index)
        self.failures[index] = np.where(faults > 0, self.failures[index] + 1, 0)
