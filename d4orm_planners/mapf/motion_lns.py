"""Large-neighbourhood search of motions: a few robots at a time find faster paths under their own dynamics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray
from d4orm_env.core.portable import log
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import Trajectory, resting_steps
from d4orm_planners.base.candidate import evaluate_controls
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.engine.path_table import BLOCK
from d4orm_planners.mapf.beam import BeamRules, OtherAgents
from d4orm_planners.mapf.beam_search import find_paths, prepare_beams
from d4orm_planners.mapf.lns import Odds, search_neighbourhoods
from d4orm_planners.mapf.motion_primitives import MotionPrimitives
from d4orm_planners.mapf.roundabout import drive_roundabout
from d4orm_planners.tracking.steering import straight_drives


@dataclass(frozen=True)
class NeighbourhoodRules:
    """The numbers of the search.

    Attributes:
        groups: Groups of robots that look for paths at the same time, not minding each other: so that all cores have
            work. What one finds is taken over only if it fits what those before it have found.
        size: Robots in a group, at most.
        give: Delay that a robot of a group may accept for the sake of those after it [s].
        temperature: Worsening at which a group's paths are still accepted, on average and at first [s].
        least_delay: A robot that arrives as soon as alone is chosen as often as one so much later [s].
        nearness: Random distance by which a robot may be farther away and still be chosen for a group, in radii of the
            largest robot.
        angles: By which robots turn off [degrees], all times the same number, ...
        scales: ... which is between these and drawn for every round.
        paces: Shares of their speed with which they head for their goals.
        width: Paths that a search keeps after each block of steps.
        dedup_distance: Least distance between kept paths, in the same radii, or else twice as much in speed [1/s].
        contact: Cost of meeting another robot [s]: too much.
    """

    groups: int = 8
    size: int = 2
    give: float = 0.5
    temperature: float = 0.05
    least_delay: float = 0.02
    nearness: float = 20 / 3
    angles: tuple[float, ...] = (10.0, 20.0, 35.0, 60.0, 100.0)
    scales: tuple[float, float] = (0.4, 1.6)
    paces: tuple[float, ...] = (1.0, 0.7, 0.35, 0.0)
    width: int = 32
    dedup_distance: float = 2 / 3
    contact: float = 1e6


RULES = NeighbourhoodRules()
ROUNDS = 96
"""Rounds of the search in an iteration: one annealing."""
FIRST_ROUNDS = 4
"""Rounds for a plan that has just been found."""
GUIDED_ROUNDS = 8
"""The same for one that was found on a roadmap, with all its corners and stops."""
FIRST_ROBOT_STEPS = 2**19
"""Steps of all robots in these rounds together: in a large world there are fewer, for the first plan not to wait."""


def improve_by_lns(search: SolveRun) -> Iteration:
    """The best plan so far, or a roundabout if that is better, whose robots have looked for faster paths."""
    team = WorkingPlan(search, _better_roundabout(search) or search.best.trajectory)
    with search.watch.paused():
        prepare_beams(team)
    return Iteration(improve_paths(team, search.iteration_seed(Stream.NEIGHBOURHOODS), ROUNDS))


def _better_roundabout(search: SolveRun) -> Trajectory | None:
    """A roundabout in which none fails, with more reward than the best plan so far."""
    best = search.best
    for side in (1, -1):
        controls = drive_roundabout(search.problem, search.engine, side)
        if controls is None:
            continue
        candidate = evaluate_controls(search.engine, search.problem, controls)
        if candidate.rank > best.rank:
            best = candidate
    return None if best is search.best else best.trajectory


def improve_first_paths(team: WorkingPlan, rounds: int = FIRST_ROUNDS) -> None:
    """Take what faster paths there are at once for a team in which none fails, in so many rounds."""
    rounds = min(rounds, FIRST_ROBOT_STEPS // (team.problem.num_robots * team.problem.horizon))
    improve_paths(team, team.search.iteration_seed(Stream.NEIGHBOURHOODS), rounds, temperature=0.0)


def improve_paths(team: WorkingPlan, seed: int, rounds: int, temperature: float = RULES.temperature) -> FloatArray:
    """Let groups of robots look for faster paths, so many rounds, as long as there is time.

    What counts is the sum of all arrival times and of all distances left over time, each as a share of the robot's
    first: the first is what travel takes, the second what the reward is made of.

    Args:
        team: A team in which none fails; changed.
        seed: Of what is tried.
        rounds: Number of rounds of :attr:`NeighbourhoodRules.groups` groups.
        temperature: See :attr:`NeighbourhoodRules.temperature`; it falls to zero with the rounds.

    Returns:
        ``(H, K, m)`` controls of the best that there has been; at a temperature of zero that is what the team does.
    """
    random, should_stop = np.random.default_rng(seed), team.search.should_stop
    return search_neighbourhoods(_Motions(team), random, rounds, should_stop, temperature)


class _Motions:
    """Motions of a team, and beam search for faster ones."""

    groups = RULES.groups

    def __init__(self, team: WorkingPlan) -> None:
        self.team, self.problem = team, team.problem
        self.num_robots, self.size = self.problem.num_robots, min(RULES.size, self.problem.num_robots)
        start = self.problem.start[:, : self.problem.dimension]
        self.distance = np.linalg.norm(self.problem.goal - start, axis=1)
        everybody, straight = np.arange(self.num_robots), straight_drives(self.problem)
        self.soonest, _ = self.costs(everybody, straight.positions[:, :, 0])
        self.arrival, self.lag = self.costs(everybody, team.states[..., : self.problem.dimension])

    @property
    def solution(self) -> FloatArray:
        """See :attr:`LowLevelPlanner.solution`: ``(H, K, m)`` controls."""
        return self.team.controls.copy()

    @property
    def cost(self) -> float:
        """Sum of all costs [s]."""
        return float((self.arrival + self.lag).sum())

    def costs(self, robots: IntArray, positions: FloatArray) -> tuple[Floats, Floats]:
        """``(R,)`` arrival times of robots at positions ``(H+1, R, d)``, and their distances left over time [s]."""
        gap = np.linalg.norm(positions[1:] - self.problem.goal[robots], axis=2).sum(axis=0, dtype=np.float64)
        lag: Floats = self.problem.dt * gap / np.maximum(self.distance[robots], self.problem.goal_radius)
        return self.problem.dt * resting_steps(positions).astype(float), lag

    def odds(self, random: np.random.Generator) -> Odds:
        """See :meth:`LowLevelPlanner.odds`."""
        delay = np.maximum(self.arrival - self.soonest, RULES.least_delay)
        until, nearness = np.full(len(delay), self.problem.horizon), RULES.nearness * self.problem.team.largest_radius
        return Odds(delay, self.team.positions, until, nearness, (self.size, self.size))

    def replan(self, drawn: list[IntArray], random: np.random.Generator, temperature: float) -> None:
        """See :meth:`LowLevelPlanner.replan`."""
        groups = np.stack(drawn)
        # Exponential, by a logarithm that is the same everywhere.
        slack = -temperature * log(1 - random.random(len(groups)))
        blocks = random.integers(0, 2, len(groups)) * self.arrival[groups[:, 0]] / self.problem.dt // BLOCK
        blocks = (blocks * random.random(len(groups))).astype(np.int64)
        primitives = MotionPrimitives(tuple(np.array(RULES.angles) * random.uniform(*RULES.scales)), RULES.paces)
        found = np.ones(len(groups), bool)
        controls = np.zeros((self.problem.horizon, *groups.shape, self.problem.control_size), np.float32)
        states = np.zeros((self.problem.horizon + 1, *groups.shape, self.problem.state_size), np.float32)
        # Those of a group one after another, those of all groups at the same time.
        budget = self.arrival[groups].sum(axis=1) + slack + self.problem.dt / 2
        for member in range(groups.shape[1]):
            robots, left = groups[found, member], groups[found, member + 1 :]
            if not len(robots):
                return
            limits = budget[found] - self.soonest[left].sum(axis=1)
            if left.shape[1]:
                limits = np.minimum(limits, self.arrival[robots] + RULES.give)
            before = groups[found, :member]
            others = OtherAgents(
                groups[found],
                np.ascontiguousarray(np.moveaxis(states[:, found, :member, : self.problem.dimension], 0, 2)),
                np.asarray(self.problem.team.radius, np.float64)[before],
            )
            rules = BeamRules(RULES.width, RULES.contact, RULES.dedup_distance * self.problem.team.largest_radius)
            paths = find_paths(self.team, robots, blocks[found], primitives, rules, limits, others)
            controls[:, found, member], states[:, found, member] = paths.controls[:, :, 0], paths.states[:, :, 0]
            budget[found] -= self.costs(robots, paths.positions[:, :, 0])[0]
            found[found] = paths.arrived[:, 0]
        for number in np.flatnonzero(found):
            self.accept(groups[number], controls[:, number], states[:, number], slack[number])

    def accept(self, robots: IntArray, controls: FloatArray, states: FloatArray, slack: float) -> None:
        """Let robots ``(R,)`` do as they found, if it fits what the others do and costs no more than so much [s]."""
        arrival, lag = self.costs(robots, states[..., : self.problem.dimension])
        before = (self.arrival[robots] + self.lag[robots]).sum()
        if (arrival + lag).sum() >= before + slack - 1e-4:
            return
        team = self.team
        present = team.controls[:, robots], team.states[:, robots], team.arrived[robots]
        team.move(robots, controls, states, np.ones(len(robots), bool))
        if team.faults(robots)[0].any():
            team.move(robots, *present)
        else:
            self.arrival[robots], self.lag[robots] = arrival, lag
