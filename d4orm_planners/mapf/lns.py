"""Large-neighbourhood search: some robots at a time, one that is late and those near to it, look for better paths.

As in MAPF-LNS (J. Li, Z. Chen, D. Harabor, P. J. Stuckey and S. Koenig, IJCAI 2021). Low-level planners find the
paths: on a roadmap (:mod:`~d4orm_planners.mapf.planner`), by manoeuvres (:mod:`d4orm_planners.manoeuvres.team`), and
here by beam search under the robots' dynamics.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

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
from d4orm_planners.mapf.motion_primitives import MotionPrimitives
from d4orm_planners.mapf.roundabout import drive_roundabout
from d4orm_planners.tracking.steering import straight_drives

ROUNDS = 96  #: Rounds of the search in an iteration: one annealing
FIRST_ROUNDS = 4  #: Rounds for a plan that has just been found
GUIDED_ROUNDS = 8  #: The same for one that was found on a roadmap, with all its corners and stops
FIRST_ROBOT_STEPS = 2**19  #: Steps of all robots in these rounds together: few rounds in a large world
GROUPS, GROUP_SIZE = 8, 2
"""Groups of robots that look for paths at the same time, not minding each other, so that all cores have work, and most
robots in one. What a group finds is taken over only if it fits what those before it have found."""
GIVE = 0.5  #: Delay that a robot of a group may accept for the sake of those after it [s]
TEMPERATURE = 0.05  #: Worsening at which a group's paths are still accepted, on average and at first [s]
LEAST_DELAY = 0.02  #: A robot that arrives as soon as alone is chosen as often as one so much later [s]
NEARNESS = 20 / 3  #: Random distance by which a robot may be farther and still join a group, in radii of the largest
ANGLES, SCALES = np.array([10.0, 20.0, 35.0, 60.0, 100.0]), (0.4, 1.6)
"""Angles by which robots turn off [degrees], all times the same number, which is between these and drawn each round."""
PACES = (1.0, 0.7, 0.35, 0.0)  #: Shares of their speed with which they head for their goals
WIDTH, DEDUP_DISTANCE, CONTACT = 32, 2 / 3, 1e6
"""Paths that a search keeps after each block of steps; least distance between two in the same radii, or else twice as
much in speed [1/s]; and the cost of meeting another robot [s]: too much."""


class Odds(NamedTuple):
    """Chances of robots to be drawn for a neighbourhood."""

    delay: Floats  #: ``(K,)`` chance of each to be the late one, in any unit
    positions: FloatArray | Floats  #: ``(T + 1, K, d)`` [m]
    until: IntArray  #: ``(K,)`` the last step of each at which it may come near to others
    nearness: float  #: Random distance by which a robot may be farther away and still be chosen [m]
    sizes: tuple[int, int]  #: The least and the greatest number of robots

    def draw(self, random: np.random.Generator) -> IntArray:
        """A robot that is late, and some that it comes near to, in random order."""
        robot = int(random.choice(len(self.delay), p=self.delay / self.delay.sum()))
        positions = self.positions[: self.until[robot] + 1]
        gaps = np.sqrt(((positions - positions[:, [robot]]) ** 2).sum(axis=2).min(axis=0))
        gaps += self.nearness * random.random(len(self.delay))
        gaps[robot] = -1.0
        return random.permutation(np.argsort(gaps, kind="stable")[: random.integers(*self.sizes, endpoint=True)])


class LowLevelPlanner(Protocol):
    """The search for other paths in a solution, of which it has the best so far.

    To ``replan`` finds them for groups, and accepts what is better, or at this temperature a little worse; ``odds`` are
    the robots' chances.
    """

    groups: int  #: Neighbourhoods that are replanned in a round

    def odds(self, random: np.random.Generator) -> Odds: ...
    def replan(self, groups: list[IntArray], random: np.random.Generator, temperature: float) -> None: ...


def search_neighbourhoods(
    planner: LowLevelPlanner,
    random: np.random.Generator,
    rounds: int,
    should_stop: Callable[[], bool],
    temperature: float = 0.0,
) -> None:
    """Replan neighbourhoods, so many rounds, as long as there is time.

    What is worse is accepted as in simulated annealing, at a temperature that falls to zero with the rounds.
    """
    for number in range(rounds):
        if should_stop():
            break
        odds = planner.odds(random)
        groups = [odds.draw(random) for _ in range(planner.groups)]
        planner.replan(groups, random, temperature * (1 - number / rounds))


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
    if rounds > 0:
        improve_paths(team, team.search.iteration_seed(Stream.NEIGHBOURHOODS), rounds, temperature=0.0)


def improve_paths(team: WorkingPlan, seed: int, rounds: int, temperature: float = TEMPERATURE) -> FloatArray:
    """``(H, K, m)`` controls of the best, after so many rounds of :data:`GROUPS` groups that look for faster paths.

    What counts is the sum of all arrival times and of all distances left over time, each as a share of the robot's
    first: the first is what travel takes, the second what the reward is made of. In the team, which is changed, none
    fails. The ``temperature``, see :data:`TEMPERATURE`, falls to zero with the rounds; at zero the best is what the
    team does.
    """
    motions = _Motions(team)
    search_neighbourhoods(motions, np.random.default_rng(seed), rounds, team.search.should_stop, temperature)
    return motions.best


class _Motions:
    """Motions of a team, and beam search for faster ones."""

    groups = GROUPS

    def __init__(self, team: WorkingPlan) -> None:
        self.team, self.problem = team, team.problem
        self.num_robots, self.size = self.problem.num_robots, min(GROUP_SIZE, self.problem.num_robots)
        start = self.problem.start[:, : self.problem.dimension]
        self.distance = np.linalg.norm(self.problem.goal - start, axis=1)
        everybody, straight = np.arange(self.num_robots), straight_drives(self.problem)
        self.soonest, _ = self.costs(everybody, straight.positions[:, :, 0])
        self.arrival, self.lag = self.costs(everybody, team.states[..., : self.problem.dimension])
        self.best, self.least = team.controls.copy(), self.cost  #: ``(H, K, m)`` controls that cost least, and what

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
        delay = np.maximum(self.arrival - self.soonest, LEAST_DELAY)
        until, nearness = np.full(len(delay), self.problem.horizon), NEARNESS * self.problem.team.largest_radius
        return Odds(delay, self.team.positions, until, nearness, (self.size, self.size))

    def replan(self, drawn: list[IntArray], random: np.random.Generator, temperature: float) -> None:
        groups = np.stack(drawn)
        # Exponential, by a logarithm that is the same everywhere.
        slack = -temperature * log(1 - random.random(len(groups)))
        blocks = random.integers(0, 2, len(groups)) * self.arrival[groups[:, 0]] / self.problem.dt // BLOCK
        blocks = (blocks * random.random(len(groups))).astype(np.int64)
        primitives = MotionPrimitives(tuple(ANGLES * random.uniform(*SCALES)), PACES)
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
                limits = np.minimum(limits, self.arrival[robots] + GIVE)
            before = groups[found, :member]
            others = OtherAgents(
                groups[found],
                np.ascontiguousarray(np.moveaxis(states[:, found, :member, : self.problem.dimension], 0, 2)),
                np.asarray(self.problem.team.girth, np.float64)[before],
            )
            rules = BeamRules(WIDTH, CONTACT, DEDUP_DISTANCE * self.problem.team.largest_radius)
            paths = find_paths(self.team, robots, blocks[found], primitives, rules, limits, others)
            controls[:, found, member], states[:, found, member] = paths.controls[:, :, 0], paths.states[:, :, 0]
            budget[found] -= self.costs(robots, paths.positions[:, :, 0])[0]
            found[found] = paths.arrived[:, 0]
        for number in np.flatnonzero(found):
            self.accept(groups[number], controls[:, number], states[:, number], slack[number])
        if self.cost < self.least:
            self.best, self.least = self.team.controls.copy(), self.cost

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
