"""Controls and what they lead to, as every planner's results are evaluated: faults, and conflicts between robots."""

from __future__ import annotations

from collections.abc import Iterator, Set
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import LARGEST, LARGEST_NUMBER, BoolArray, FloatArray, IntArray
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine.types import Engine
from d4orm_env.verify import VerificationReport, verify

if TYPE_CHECKING:
    from d4orm_planners.engine import path_index
else:
    path_index = LazyModule("d4orm_planners.engine.path_index")

Graph: TypeAlias = tuple[frozenset[int], ...]  #: The robots that each robot is in conflict with
Groups: TypeAlias = tuple[tuple[int, ...], ...]  #: Robots by the group that they are in
MOST_OF_LIMIT = LARGEST_NUMBER / LARGEST
"""Largest multiple of its limit that a planned control may be, so that its square does not overflow."""


@dataclass(frozen=True)
class Candidate:
    """Controls and what they lead to."""

    #: ``(H, K, m)`` as the method left them, at most :data:`MOST_OF_LIMIT` times the limits; zero after arrival
    planned: FloatArray
    controls: FloatArray  #: ``(H, K, m)`` as executed: inside the limits, zero after arrival
    trajectory: Trajectory  #: Their rollout
    failed: BoolArray  #: ``(K,)`` robots that do not arrive, or violate the margin at some step that was checked
    report: VerificationReport | None  #: :func:`d4orm_env.verify`'s; ``None`` where a robot fails, or it was not asked
    solved: bool  #: Whether all arrive, the margin is kept at every step, and the report, if there is one, agrees

    @property
    def unsolved(self) -> BoolArray:
        """``(K,)`` robots that fail, or that the report names."""
        unsolved = self.failed.copy()
        for violation in () if self.report is None else self.report.violations:
            unsolved[list(violation.robots)] = True
        return unsolved

    @property
    def reward(self) -> float:
        """Mean reward of all robots and steps."""
        return float(self.trajectory.rewards.mean())

    @property
    def rank(self) -> tuple[bool, int, float]:
        """Larger is better: solved before unsolved, then fewer unsolved robots, then more reward."""
        return (True, 0, self.reward) if self.solved else (False, -int(self.unsolved.sum()), self.reward)


def evaluate_controls(
    engine: Engine, problem: Problem, controls: FloatArray, check_interval: int = 1, judged: bool = True
) -> Candidate:
    """Roll out and evaluate controls ``(H, K, m)``: failures at every ``check_interval``-th step, a solution at all.

    It is ``judged`` by :func:`d4orm_env.verify` too, or what happens between steps does not count.
    """
    bound = MOST_OF_LIMIT * problem.team.control_limits
    bounded = np.clip(controls, -bound, bound)
    trajectory = engine.rollout(problem, bounded)
    at_rest = trajectory.arrived[:-1, :, None] & problem.docks
    planned = np.where(at_rest, np.float32(0), bounded)
    failed = failed_robots(trajectory, check_interval)
    solved = not failed_robots(trajectory).any()
    report = verify(problem, trajectory.controls) if solved and judged else None
    return Candidate(planned, trajectory.controls, trajectory, failed, report, solved and (report is None or report.ok))


def failed_robots(trajectory: Trajectory, check_interval: int = 1) -> BoolArray:
    """``(K,)`` robots that do not arrive, or violate the margin at some ``check_interval``-th step.

    The start itself cannot be planned away, so it does not count.
    """
    violated = trajectory.margin_violated[check_interval::check_interval]
    failed: BoolArray = ~trajectory.arrived[-1] | violated.any(axis=0)
    return failed


def step_faults(problem: Problem, trajectory: Trajectory, unreachable: Set[int]) -> dict[int, list[str]]:
    """Faults of each failing robot at the steps; ``unreachable`` are those without a path to their goals."""
    near = team_conflicts(problem, trajectory.positions)
    rounding = ["comes so near to the margin of something that rounding decides"]
    faults = {}
    for robot in np.flatnonzero(failed_robots(trajectory)).tolist():
        missed = _missed_goal(problem, trajectory, robot, robot in unreachable)
        faults[robot] = [*missed, *_too_near(problem, trajectory, robot, near)] or rounding
    return faults


def _missed_goal(problem: Problem, trajectory: Trajectory, robot: int, unreachable: bool) -> Iterator[str]:
    if not trajectory.arrived[-1, robot]:
        gap = np.linalg.norm(trajectory.positions[-1, robot] - problem.goal[robot])
        turns = (problem.team.headings(trajectory.states[-1]) - problem.goal_heading)[robot] / (2 * np.pi)
        missed = 2 * np.pi * abs(turns - np.round(turns))
        yield f"ends {gap:.2g} m from its goal" + (f", {missed:.2g} rad off" if missed > 0 else "")
        way = np.linalg.norm(problem.goal[robot] - problem.start[robot, : problem.dimension]) - problem.goal_radius
        steps = int(np.ceil(way / (problem.team.max_speed[robot] * problem.dt)))
        if steps > problem.horizon:
            yield f"needs {steps} steps at full speed, where the horizon is {problem.horizon}; give a longer horizon"
    if unreachable:
        safety_distance = problem.team.wall_radius[robot] + problem.margin
        yield f"has no path from start to goal that is {safety_distance:.4g} m clear of obstacles"


def _too_near(problem: Problem, trajectory: Trajectory, robot: int, near: Graph) -> Iterator[str]:
    if problem.team.shapes:  # the discs round them do not tell what touches what
        if trajectory.margin_violated[1:, robot].any():
            yield "comes within the margin of something"
        return
    if near[robot]:
        yield f"comes within the margin of {', '.join(f'robot_{other}' for other in sorted(near[robot]))}"
    safety_distance = problem.team.radius[robot] + problem.margin
    if problem.world.clearance(trajectory.positions[1:, robot]).min() <= safety_distance:
        yield "comes within the margin of an obstacle or the bounds"


def conflicts(positions: FloatArray, radius: ArrayLike, margin: float) -> Graph:
    """Find the robots that come within the margin of each other at any step after the start.

    Of ``positions`` ``(H+1, K, d)`` and ``radius`` ``(K,)``, all in metres.
    """
    return graph_of(positions.shape[1], path_index.PathIndex(positions, radius, margin).pairs())


def team_conflicts(problem: Problem, positions: FloatArray) -> Graph:
    """The same of a problem's robots, as far as the upright cylinders or discs round them tell."""
    return graph_of(problem.num_robots, path_index.team_index(problem.team, positions, problem.margin).pairs())


def graph_of(num_robots: int, pairs: IntArray) -> Graph:
    """The graph of conflicts between pairs ``(P, 2)``."""
    neighbours: list[set[int]] = [set() for _ in range(num_robots)]
    for first, second in pairs.tolist():
        neighbours[first].add(second)
        neighbours[second].add(first)
    return tuple(map(frozenset, neighbours))


def components(graph: Graph) -> Groups:
    """Connected components, singletons included, in order of their first members."""
    seen: set[int] = set()
    groups = []
    for first in range(len(graph)):
        if first in seen:
            continue
        members, frontier = {first}, {first}
        while frontier:
            frontier = set().union(*(graph[robot] for robot in frontier)) - members
            members |= frontier
        seen |= members
        groups.append(tuple(sorted(members)))
    return tuple(groups)
