"""Independent repairs: robots without conflicts among them at once, around all others; no robot gets worse."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import Trajectory
from d4orm_planners.base.candidate import Graph, components
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan, approach_goals
from d4orm_planners.engine.sampling_types import SamplingTask, moving_robots

if TYPE_CHECKING:
    from d4orm_planners.d4orm_d.planner import D4ormD

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
    """The team's plan, by default that of the search's present candidate, some robots' controls deformed around all
    others.
    """

    def __init__(self, planner: D4ormD, search: SolveRun, trajectory: Trajectory | None = None) -> None:
        if trajectory is None:
            super().__init__(search, search.current.trajectory, search.current.report)
        else:
            super().__init__(search, trajectory)
        self.planner = planner
        self._denoising_steps = self._excluded = self._runs = 0

    def deformed(
        self, robots: Sequence[int], horizon: int, num_samples: int, noise_scale: FloatArray, **scoring: Any
    ) -> tuple[Problem, FloatArray, Trajectory]:
        """Deform these robots' first ``horizon`` controls around all others.

        Their problem alone, their new controls as planned, and the rollout of those in it.
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

    def repair(self, team: DeformedPlan) -> Repairs:
        """Deform some robots that fail, accept what is no worse, and improve final approaches once none fails."""
        after, everybody = self._copy(), np.arange(team.problem.num_robots)
        failed, _ = team.faults(everybody)
        if failed.any() and not team.search.should_stop():
            after._deform(team, np.flatnonzero(failed))
            failed, _ = team.faults(everybody)
        # Detours are longer than necessary at first.
        return after if failed.any() else after.improve(team)

    def improve(self, team: DeformedPlan) -> Repairs:
        """Let all robots turn to their goals as soon as that is no worse."""
        after, problem = self._copy(), team.problem
        for _ in range(SHORTENINGS):
            if team.search.should_stop():
                break
            trajectory = team.search.engine.rollout(problem, team.controls)
            after._accept(team, np.arange(problem.num_robots), problem, trajectory)
        return after

    def _copy(self) -> Repairs:
        """A copy that one iteration of repairs may change."""
        return Repairs(self.failures.copy(), self.recency.copy())

    def _deform(self, team: DeformedPlan, failed: IntArray) -> None:
        """Deform the controls of some of the robots that fail."""
        problem, config = team.problem, team.planner.config
        robots, credit = self._next_robots(team, failed)
        moving = (team.positions[1:, robots] != team.positions[:-1, robots]).any(axis=2)
        horizon = min(int(moving.any(axis=1).nonzero()[0].max(initial=0)) + 1 + SLACK, problem.horizon)
        distance = np.linalg.norm(problem.goal - problem.start[:, : problem.dimension], axis=1)
        wider = NOISE_FACTORS[team.search.iteration % len(NOISE_FACTORS)]
        part, _, trajectory = team.deformed(
            robots,
            horizon,
            config.repair_samples,
            config.noise_scale(config.repair_steps) * np.float32(wider),
            credit=credit,
            penalty=config.repair_penalty,
            # Else a robot that starts next to its goal would lose far more by yielding than others.
            reference_distance=float(max(distance.mean(), problem.goal_radius)),
        )
        self._accept(team, np.array(robots), part, trajectory)

    def _next_robots(self, team: DeformedPlan, failed: IntArray) -> tuple[tuple[int, ...], str]:
        """Choose the robots to repair, and the credit.

        They are robots that fail and have no conflicts among them, the least recently repaired first, each by its own
        reward. Every :data:`JOINT_INTERVAL` iterations a group of stuck robots is repaired by its team's reward.
        """
        search, graph = team.search, team.conflicts()
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
        self.recency[list(robots)] += RECENCY_GAIN
        self.recency[:] *= RECENCY_DECAY
        return robots, "robot"

    def _accept(self, team: DeformedPlan, robots: IntArray, part: Problem, trajectory: Trajectory) -> None:
        """Give robots their motions in the trajectory, or turns to their goals, and count the failures."""
        approach_goals(team, robots, part, trajectory, or_longer=True)
        faults, _ = team.faults(robots)
        self.failures[robots] = np.where(faults > 0, self.failures[robots] + 1, 0)


def independent_robots(candidates: Iterable[int], graph: Graph) -> tuple[int, ...]:
    """Candidates, taken in order, that conflict with none taken before; sorted."""
    taken: set[int] = set()
    for robot in candidates:
        if taken.isdisjoint(graph[robot]):
            taken.add(int(robot))
    return tuple(sorted(taken))
