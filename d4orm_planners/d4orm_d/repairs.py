"""Independent repairs: robots without conflicts among them at once, around all others; whoever gets worse stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.metrics import arrival_steps
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import Trajectory
from d4orm_planners.d4orm_d.costs import path_costs, way_costs
from d4orm_planners.d4orm_d.settings import RULES, D4ormDConfig
from d4orm_planners.d4orm_d.team import TeamPaths
from d4orm_planners.grouping import components, independent_robots
from d4orm_planners.steering import Drives, closing_stretches, detours


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

    def repair(self, team: TeamPaths, config: D4ormDConfig) -> Repairs:
        """Deform some of the failed robots' controls, and take over what is no worse."""
        repair = _Repair(team, self)
        repair.run(config)
        return Repairs(repair.failures, repair.recency)

    def shorten(self, team: TeamPaths) -> Repairs:
        """Let everybody turn home as soon as that is no worse."""
        repair = _Repair(team, self)
        repair.shorten()
        return Repairs(repair.failures, repair.recency)


class _Repair:
    """One iteration of repairs."""

    def __init__(self, team: TeamPaths, before: Repairs) -> None:
        self.team, self.search, self.problem = team, team.search, team.problem
        self.failures, self.recency = before.failures.copy(), before.recency
        self.detours = 0

    def run(self, config: D4ormDConfig) -> None:
        """Repair, and shorten the ways home once nobody is in anybody's way."""
        problem, current = self.problem, self.search.current.trajectory
        robots, credit = self.next_robots()
        arrival = np.where(self.team.arrived, arrival_steps(current.arrived), problem.horizon)
        horizon = min(int(arrival[list(robots)].max()) + RULES.slack, problem.horizon)
        distance = np.linalg.norm(problem.goal - problem.start[:, : problem.dimension], axis=1)
        wider = RULES.noise_factors[self.search.iteration % len(RULES.noise_factors)]
        part, _, trajectory = self.team.deformed(
            robots,
            horizon,
            config.repair_samples,
            config.noise_scale(config.repair_steps) * np.float32(wider),
            credit=credit,
            penalty=config.penalty,
            # A robot that starts next to its goal has little to lose by making way, but would lose it many times over.
            reference_distance=float(max(distance.mean(), problem.goal_radius)),
        )
        self.take_over(robots, part, trajectory)
        if not self.team.graph.any() and self.team.arrived.all():
            # The detours that got robots out of each other's way are longer than they need be.
            self.shorten()

    def shorten(self) -> None:
        """Let everybody turn home as soon as that is no worse."""
        for _ in range(RULES.shortenings):
            if self.search.should_stop():
                break
            trajectory = self.search.engine.rollout(self.problem, self.team.controls)
            self.take_over(range(self.problem.num_robots), self.problem, trajectory)

    def next_robots(self) -> tuple[tuple[int, ...], str]:
        """Whom to repair, and by whose reward.

        Failed robots without conflicts among them, those that were not repaired lately first, each by its own reward.
        Now and then a few robots that only together can get out of each other's way, by their team's.
        """
        search, graph = self.search, self.team.graph
        random = np.random.default_rng(search.iteration_seed(Stream.REPAIR_ORDER)).random(len(self.recency))
        order = np.argsort(self.recency + random - RULES.crowding * graph.sum(axis=1), kind="stable")
        if search.iteration % RULES.joint_interval == 0:
            stuck = [
                group
                for group in components(graph)
                if 1 < len(group) <= RULES.joint_robots and self.failures[list(group)].min() >= RULES.joint_failures
            ]
            if stuck:
                return stuck[search.iteration // RULES.joint_interval % len(stuck)], "team"
        robots = independent_robots([k for k in order if search.current.failed[k]], graph)
        self.recency = self.recency.copy()
        self.recency[list(robots)] += RULES.recency_gain
        self.recency *= RULES.recency_decay
        return robots, "robot"

    def take_over(self, robots: Sequence[int], part: Problem, trajectory: Trajectory) -> None:
        """Let robots do as in the trajectory, or turn to their goals in time; whoever gets worse stays as it was."""
        team, index = self.team, list(robots)
        controls, positions, arrived = self.with_closing_stretches(robots, part, trajectory)
        changed = team.positions.copy()
        changed[:, robots] = positions
        graph = team.conflicts(changed)
        before = self.costs_of(index)
        after = path_costs(self.problem, index, positions, graph[index], arrived)
        for i in np.flatnonzero(after <= before):
            robot = index[int(i)]
            team.controls[:, robot, : controls.shape[2]] = controls[:, i]
            team.positions[:, robot] = positions[:, i]
            team.arrived[robot] = arrived[i]
        team.graph = team.conflicts(team.positions)
        self.failures[index] = np.where(self.costs_of(index) > 0, self.failures[index] + 1, 0)

    def costs_of(self, robots: list[int]) -> NDArray[np.float64]:
        """``(R,)`` costs of what robots do at present."""
        team = self.team
        return path_costs(self.problem, robots, team.positions[:, robots], team.graph[robots], team.arrived[robots])

    def with_closing_stretches(
        self, robots: Sequence[int], part: Problem, trajectory: Trajectory
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """The trajectory's ``(controls, positions, arrived)``, with robots turning straight to their goals if better.

        A deformation ends metres from where it was aimed at after a long way: arriving is what sampling does worst, and
        steering does at once. After some failed repairs a robot may take a random detour instead.
        """
        arrived = trajectory.arrived[-1].copy()
        gap = np.linalg.norm(trajectory.positions - part.goal, axis=2)
        nearest = np.where(trajectory.arrived.any(axis=0), trajectory.arrived.argmax(axis=0), gap.argmin(axis=0))
        switch = np.maximum(nearest[:, None] - np.array(RULES.earlier), 0)
        as_it_is = Drives(trajectory.controls[:, :, None], trajectory.positions[:, :, None], arrived[:, None])
        ways = as_it_is.joined(closing_stretches(part, trajectory.states, trajectory.controls, switch))
        paths = self.team.positions.copy()
        paths[:, robots] = trajectory.positions
        controls, positions = trajectory.controls.copy(), trajectory.positions.copy()
        for i in np.argsort(-nearest, kind="stable"):
            if self.search.should_stop():
                break
            robot = robots[int(i)]
            own = ways.of(int(i))
            cost = way_costs(self.problem, robot, own, paths)
            if self.failures[robot] >= RULES.detour_failures and cost.min() >= 1:
                own = self.with_detours(part.select([int(i)]), own)
                cost = way_costs(self.problem, robot, own, paths)
            best = int(np.argmin(cost))
            controls[:, i] = own.controls[:, best]
            positions[:, i] = paths[:, robot] = own.positions[:, best]
            arrived[i] = own.arrived[best]
        return controls, positions, arrived

    def with_detours(self, alone: Problem, ways: Drives) -> Drives:
        """One robot's ways and some more, each by a random point."""
        start, goal = alone.start[0, : alone.dimension], alone.goal[0]
        random = np.random.default_rng(self.search.iteration_seed(Stream.DETOURS, self.detours))
        self.detours += 1
        spread = 0.5 * np.linalg.norm((goal - start)[None], axis=1) + 1
        vias = (
            start
            + random.random((RULES.detours, 1)) * (goal - start)
            + spread * portable.standard_normal(random, (RULES.detours, alone.dimension))
        )
        return ways.joined(detours(alone, vias[None].astype(np.float32)).of(0))
