"""Replanning of the robots that fail, around all others (paper, section V, Algorithm 3).

Group by group, as in the paper; in one run weighted by groups, as in the code that its authors published; or, by
default, in independent repairs: robots without conflicts among them at once, and no robot gets worse.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import Trajectory
from d4orm_planners.base.candidate import Graph, Groups, components, team_conflicts
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan, approach_goals
from d4orm_planners.engine.sampling_types import SamplingTask, moving_robots
from d4orm_planners.sampling.weights import GroupWeights

if TYPE_CHECKING:
    from d4orm_planners.d4orm_d.planner import D4ormD

NOISE_FACTORS = (1.0, 2.0)  #: Noise factors of successive repairs: wider noise may get around what ordinary does not
SLACK = 40
"""Steps of a repair beyond the latest arrival of its robots. Later ones have nothing to search, and would dilute the
rewards."""
RECENCY_GAIN, RECENCY_DECAY = 0.3, 0.7  #: What a repair adds to a robot's recency, and its decay per iteration
CROWDING = 0.2  #: Priority of a robot for every robot that it meets: it blocks the most
JOINT_INTERVAL, JOINT_FAILURES, JOINT_ROBOTS = 3, 2, 3
"""Iterations between joint repairs by the team's reward, failed repairs in a row of each robot before one, and largest
number of robots: some can get out of each other's way only together."""
SHORTENINGS = 2  #: Number of successive searches for shorter final approaches


class DeformedPlan(WorkingPlan):
    """The team's plan, by default the search's present candidate, some robots deformed around all others."""

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
        return Repairs(self.failures.copy(), self.recency.copy())

    def _deform(self, team: DeformedPlan, failed: IntArray) -> None:
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


class Grouping(NamedTuple):
    """A team's groups, and the conflicts that they come from."""

    graph: Graph  #: The conflicts
    groups: Groups  #: Components of the graph after :func:`reconnected`, singletons included


def regrouped(graph: Graph, previous: Grouping | None) -> Grouping:
    """The groups of a graph of conflicts that follows a previous one."""
    return Grouping(graph, components(reconnected(graph, previous)))


def reconnected(graph: Graph, previous: Grouping | None) -> Graph:
    """The graph of conflicts with those of the previous iteration added that are likely to come back.

    A robot of a previous group that now conflicts with a robot outside that group is joined again to those of its
    previous direct neighbours that are free of conflicts now.
    """
    if previous is None:
        return graph
    joined = [set(neighbours) for neighbours in graph]
    for group in previous.groups:
        for robot in group if len(group) > 1 else ():
            if not graph[robot] <= set(group):
                for other in previous.graph[robot]:
                    if not graph[other]:
                        joined[robot].add(other)
                        joined[other].add(robot)
    return tuple(map(frozenset, joined))


def failure_groups(failed: BoolArray, groups: Groups) -> Groups:
    """Groups to replan: those, of all with singletons included, that hold a robot that failed ``(K,)``."""
    return tuple(group for group in groups if failed[list(group)].any())


@dataclass(frozen=True, eq=False)
class GroupRuns:
    """The state of the search by groups."""

    grouping: Grouping | None = None  #: Groups of the last iteration by groups, or ``None`` before the first

    def replan(self, team: DeformedPlan) -> GroupRuns:
        """Replan every group with a failed robot in turn, the robots outside it as moving obstacles."""
        planner, search, problem = team.planner, team.search, team.problem
        grouping = grouping_of(search, self.grouping)
        team.controls = planner.config.continued(search.current).copy()
        for group in failure_groups(search.current.unsolved, grouping.groups):
            if search.should_stop():
                break
            robots = list(group)
            _, controls, trajectory = team.deformed(
                robots, problem.horizon, planner.config.num_samples, planner.noise_scale(), credit="team"
            )
            team.move(robots, controls, trajectory.states, trajectory.arrived[-1])
        return GroupRuns(grouping)


def grouping_of(search: SolveRun, previous: Grouping | None) -> Grouping:
    """Return the groups of the present candidate, at the steps that are checked."""
    problem, positions = search.problem, search.current.trajectory.positions
    graph = team_conflicts(problem, positions[:: search.check_interval])
    return regrouped(graph, previous)


@dataclass(frozen=True, eq=False)
class JointRun:
    """The state of the search by joint runs."""

    penalties: FloatArray  #: ``(K,)`` factors of the problem's collision penalty
    resets: bool  #: Whether the next run starts from zero controls
    grouping: Grouping | None  #: Groups of the last run, or ``None`` before the first
    labels: IntArray  #: ``(K,)`` each robot's failure before the last run, see :func:`failure_labels`
    repeats: IntArray  #: ``(K,)`` how often in a row each had that failure again

    @classmethod
    def of(cls, num_robots: int, penalty: float, resets: bool) -> JointRun:
        """The state before the first run."""
        nothing = np.zeros(num_robots, int)
        return cls(np.full(num_robots, penalty, np.float32), resets, None, nothing, nothing)

    def replan(self, planner: D4ormD, search: SolveRun) -> tuple[JointRun, Iteration]:
        """Deform all failed robots at once, each by the reward of its group; the others keep their controls."""
        config, problem, failed = planner.config, search.problem, search.current.unsolved
        grouping, penalties = grouping_of(search, self.grouping), self._penalties(planner, search)
        labels = failure_labels(grouping.groups, failed)
        repeats = np.where((labels != 0) & (labels == self.labels), self.repeats + 1, 0)
        base = config.continued(search.current).copy()
        if config.clip_after is not None:
            stagnant = repeats >= config.clip_after
            base[:, stagnant], repeats[stagnant] = search.current.controls[:, stagnant], 0
        if self.resets:
            base[:] = 0
        deformed = failed[None, :, None].astype(np.float32)
        task = SamplingTask(
            problem, base, credit="robot", penalty=penalties, penalty_per_pair=config.penalty_per_pair,
            noise_factor=deformed,
        )  # fmt: skip
        rules = planner.rules()
        rules = rules._replace(weights=GroupWeights(rules.weights, grouping.groups))
        start = deformed * planner.start(search, base, problem.team)
        iteration, _ = planner.sampled(search, task, rules, start, planner.stages(search))
        return JointRun(penalties, False, grouping, labels, repeats), iteration

    def _penalties(self, planner: D4ormD, search: SolveRun) -> FloatArray:
        """``(K,)`` higher for robots that the last run left in contact, as at first for the others."""
        if not search.denoising_steps:
            return self.penalties
        config, touching = planner.config, search.current.trajectory.margin_violated[1:].any(axis=0)
        risen = np.minimum(self.penalties + config.penalty_rise, config.penalty_limit)
        return np.where(touching, risen, config.penalty).astype(np.float32)


def failure_labels(groups: Groups, failed: BoolArray) -> IntArray:
    """``(K,)`` number of a robot's group from 1, if it is not alone there; -1 if it fails alone, 0 if it succeeds."""
    labels = np.where(failed, -1, 0)
    for number, group in enumerate((group for group in groups if len(group) > 1), start=1):
        labels[list(group)] = number
    return labels
