"""Path finding for a team on a roadmap: LaCAM, a search over the nodes of the whole team.

After K. Okumura, *LaCAM: search-based algorithm for quick multi-agent pathfinding* (AAAI 2023). What follows a
configuration is made by :mod:`pibt <d4orm_planners.mapf.pibt>`, at first without constraints; whenever a
configuration comes up again one more robot is told where to go next, so that in the end everything is tried.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_planners.mapf.pibt import PibtWorkspace, step_team
from d4orm_planners.mapf.roadmap import PAIR_SLACK, ROUNDING, Roadmap, RobotArrays, fill_costs, is_open


class SearchConstraint(NamedTuple):
    """Robots that must go to nodes in the next step."""

    robots: tuple[int, ...] = ()
    nodes: tuple[int, ...] = ()


@dataclass(eq=False)
class TeamConfiguration:
    """Nodes of the team, and what has been tried from there."""

    positions: IntArray  #: ``(K,)`` nodes
    parent: TeamConfiguration | None  #: Configuration that it came from; ``None`` for the start
    moves: IntArray  #: ``(M, 2)`` robots and edges in the order of the moves that led here
    priorities: Floats  #: ``(K,)`` the highest goes first
    order: IntArray = field(init=False)  #: ``(K,)`` robots in that order
    untried: deque[SearchConstraint] = field(default_factory=lambda: deque([SearchConstraint()]))  #: Constraints

    def __post_init__(self) -> None:
        self.order = np.argsort(-self.priorities, kind="stable").astype(np.int64)

    def next_constraint(self, roadmap: Roadmap) -> SearchConstraint:
        """Return the next constraint to try; those on one robot more come after all others."""
        constraint = self.untried.popleft()
        if len(constraint.robots) < len(self.order):
            robot = int(self.order[len(constraint.robots)])
            at = int(self.positions[robot])
            for node in (at, *roadmap.heads[roadmap.first[at] : roadmap.first[at + 1]].tolist()):
                self.untried.append(SearchConstraint((*constraint.robots, robot), (*constraint.nodes, node)))
        return constraint


@dataclass(frozen=True, eq=False)
class TeamMoves:
    """Result of a search."""

    moves: IntArray  #: ``(M, 2)`` robots and edges, in an order in which all can be made one after another
    arrived: BoolArray  #: ``(K,)`` robots at their goals in the end: all, unless the search was ended before


class TeamOnRoadmap:
    """The robots' paths to their goals around those that have arrived, and the order in which they may arrive."""

    def __init__(self, problem: Problem, roadmap: Roadmap) -> None:
        self.roadmap, num_robots, num_nodes = roadmap, problem.num_robots, len(roadmap.nodes)
        radius, wall_radius = (np.asarray(of, np.float64) for of in (problem.team.girth, problem.team.wall_radius))
        self.bodies = RobotArrays(
            radius=radius,
            size=problem.team.largest_radius,
            safety_distance=wall_radius * (1 - ROUNDING) + problem.margin,
            margin=float(problem.margin),
            slack=PAIR_SLACK * problem.team.largest_radius,
            goal_radius=float(problem.goal_radius),
            docks=problem.docks,
            starts=roadmap.starts,
            goals=roadmap.goals,
            costs=np.empty((num_robots, num_nodes), np.float32),
        )
        self.nobody = np.zeros(num_robots, bool)
        self.masks = [self.nobody] * num_robots
        self.holds = self.nobody.copy()
        for robot in range(num_robots):
            self.fill(robot, self.nobody)
        self.waits_for = [self.nobody] * num_robots

    def order_arrivals(self) -> None:
        """Find the order in which robots must arrive."""
        if self.bodies.docks:
            self.waits_for = [self.closed_by(robot) for robot in range(len(self.waits_for))]

    def closed_by(self, robot: int) -> BoolArray:
        """``(K,)`` robots without a path once a robot has docked, which must arrive before it."""
        alone, others = self.nobody.copy(), self.nobody.copy()
        alone[robot] = True
        arrived, starts = self.arrived_at(alone), self.roadmap.starts
        for other in range(len(alone)):
            costs = self.bodies.costs[other]
            if other == robot or not np.isfinite(costs[starts[other]]):
                continue
            if not is_open(self.roadmap, self.bodies, arrived, other, starts[other], costs):
                around = np.empty_like(costs)
                fill_costs(self.roadmap, self.bodies, arrived, other, self.roadmap.goals[other], around)
                others[other] = not np.isfinite(around[starts[other]])
        return others

    def arrived_at(self, mask: BoolArray) -> NDArray[np.int32]:
        """``(N,)`` the robot arrived at each node, of those in a mask ``(K,)``; -1 for none."""
        arrived = np.full(len(self.roadmap.nodes), -1, np.int32)
        arrived[self.roadmap.goals[mask]] = np.flatnonzero(mask)
        return arrived

    def fill(self, robot: int, mask: BoolArray, holds: bool = False) -> None:
        """Find a robot's paths again: to its goal or, while it waits for others to arrive, back to its start."""
        end = self.roadmap.starts[robot] if holds else self.roadmap.goals[robot]
        fill_costs(self.roadmap, self.bodies, self.arrived_at(mask), robot, end, self.bodies.costs[robot])
        self.masks[robot], self.holds[robot] = mask, holds

    def arrived(self, positions: IntArray) -> BoolArray:
        """``(K,)`` robots at their goals."""
        return positions == self.roadmap.goals

    def find_paths(self, positions: IntArray) -> bool:
        """Bring all paths up to date; whether each robot has one, around those that have docked."""
        mask = self.arrived(positions) if self.bodies.docks else self.nobody
        arrived = self.arrived_at(mask)
        for robot in np.flatnonzero(~mask).tolist():
            before, holds = self.masks[robot], bool((self.waits_for[robot] & ~mask).any())
            if holds == self.holds[robot] and (before is mask or (before == mask).all()):
                continue
            costs, at = self.bodies.costs[robot], positions[robot]
            stale = holds != self.holds[robot] or bool((before & ~mask).any())
            if stale or not (holds or is_open(self.roadmap, self.bodies, arrived, robot, at, costs)):
                self.fill(robot, mask, holds)
                if not np.isfinite(costs[at]):
                    return False
        return True

    def after(
        self, here: TeamConfiguration, scratch: PibtWorkspace, seed: int, known: dict[bytes, TeamConfiguration]
    ) -> TeamConfiguration | None:
        """Take a step under the next untried constraint; ``None`` where that cannot be kept.

        A configuration that is ``known`` is returned itself; others are added.
        """
        bodies, constraint = self.bodies, here.next_constraint(self.roadmap)
        forced = np.array(constraint.robots, np.int64), np.array(constraint.nodes, np.int64)
        self.find_paths(here.positions)
        scratch.may_dock[:] = ~self.holds
        while True:
            positions = here.positions.copy()
            count = step_team(self.roadmap, bodies, scratch, here.order, *forced, seed, positions)
            came = self.arrived(positions) & ~self.arrived(here.positions)
            if count < 0:
                return None
            if not bodies.docks or not came.any() or self.find_paths(positions):
                break
            # Who would close somebody's only path must wait until that one has passed.
            scratch.may_dock[came] = False
            self.find_paths(here.positions)
        key = positions.tobytes()
        if key not in known:
            waiting = np.where(self.arrived(positions), here.priorities % 1, here.priorities + 1)
            known[key] = TeamConfiguration(positions, here, scratch.moves[:count].copy(), waiting)
        return known[key]


def find_moves(
    problem: Problem, roadmap: Roadmap, seed: int, should_stop: Callable[[], bool], max_steps: int = 1_000_000
) -> TeamMoves | None:
    """Moves that bring all to their goals, or as many as possible until the search is stopped or has gone
    ``max_steps``.

    ``None`` where a robot has no path on the roadmap. ``should_stop`` is asked before every step, and the seed is of
    ties.
    """
    team, num_robots = TeamOnRoadmap(problem, roadmap), problem.num_robots
    length = team.bodies.costs[np.arange(num_robots), roadmap.starts].astype(np.float64)
    if not np.isfinite(length).all():
        return None
    team.order_arrivals()
    scratch = _scratch(roadmap, num_robots)
    start = TeamConfiguration(roadmap.starts.copy(), None, np.empty((0, 2), np.int64), length / (length.max() + 1))
    known, open_, best = {start.positions.tobytes(): start}, [start], start
    for step in range(max_steps):
        if not open_ or should_stop():
            break
        here = open_[-1]
        if team.arrived(here.positions).sum() > team.arrived(best.positions).sum():
            best = here
        if team.arrived(here.positions).all():
            break
        if not here.untried:
            open_.pop()
            continue
        following = team.after(here, scratch, (seed + step) % 2**62, known)
        if following is not None:
            open_.append(following)
    return _moves_to(best, team.arrived(best.positions))


def _scratch(roadmap: Roadmap, num_robots: int) -> PibtWorkspace:
    degree = int(np.diff(roadmap.first).max()) + 2
    return PibtWorkspace(
        state=np.zeros(num_robots, np.int8),
        may_dock=np.ones(num_robots, bool),
        who=np.zeros(len(roadmap.nodes), np.int32),
        robots=np.zeros(num_robots, np.int64),
        edges=np.zeros(num_robots, np.int64),
        tried=np.zeros(num_robots, np.int64),
        options=np.zeros((num_robots, degree), np.int64),
        worth=np.zeros(degree),
        moves=np.empty((num_robots, 2), np.int64),
    )


def _moves_to(configuration: TeamConfiguration, arrived: BoolArray) -> TeamMoves:
    steps, here = [], configuration
    while here.parent is not None:
        steps.append(here.moves)
        here = here.parent
    return TeamMoves(np.concatenate([here.moves, *steps[::-1]]), arrived)
