"""Replanning of the robots that fail (paper, section V, Algorithm 3): group by group, or in one run weighted by groups.

The former is the paper's, the latter that of the code that its authors published.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_planners.base.candidate import Graph, Groups, components, team_conflicts
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d4orm_d.repairs import DeformedPlan
from d4orm_planners.engine.sampling_types import SamplingTask
from d4orm_planners.sampling.weights import GroupWeights

if TYPE_CHECKING:
    from d4orm_planners.d4orm_d.planner import D4ormD


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
