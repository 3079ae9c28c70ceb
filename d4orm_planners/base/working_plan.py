"""A team's plan during an iteration, changed robot by robot, and final approaches straight to the goals."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory, arrival_steps
from d4orm_env.verify import VerificationReport
from d4orm_planners.base.candidate import Candidate, Graph, evaluate_controls, graph_of
from d4orm_planners.tracking.steering import Rollouts, drives, prepare_drives

if TYPE_CHECKING:
    from d4orm_planners.base.solve import SolveRun
    from d4orm_planners.engine import path_index
else:
    path_index = LazyModule("d4orm_planners.engine.path_index")

MISSED_GOAL = 5  #: Cost of not arriving, or of touching an obstacle, in robots met


class WorkingPlan:
    """The team's plan, at first this trajectory, with its report if there is one, to be changed for some robots.

    It has ``controls`` ``(H, K, m)`` and ``states`` ``(H+1, K, n)``.
    """

    def __init__(self, search: SolveRun, trajectory: Trajectory, report: VerificationReport | None = None) -> None:
        self.search, self.problem = search, search.problem
        self.controls, self.states = trajectory.controls.copy(), trajectory.states.copy()
        self.arrived: BoolArray = trajectory.arrived[-1].copy()  #: ``(K,)`` whether each ends at its goal
        #: ``(K,)`` step of each robot's fault in the report; ``H + 1`` for none, or once it moves
        self.reported = np.full(self.problem.num_robots, self.problem.horizon + 1)
        arrivals = arrival_steps(trajectory.arrived)
        for violation in () if report is None else report.violations:
            robots = list(violation.robots)
            # Who has not arrived may stop where it seems to.
            step = np.minimum(int(violation.time / self.problem.dt) + 1, arrivals[robots])
            self.reported[robots] = np.minimum(self.reported[robots], step)
        # The engine, in float32, must not find near what this has found clear.
        margin = self.problem.margin + self.problem.rounding
        #: Positions of all robots
        self.index = path_index.team_index(self.problem.team, trajectory.positions, margin)
        self._interval = search.check_interval
        # Who fails is looked for at some steps only, paths around others are at all of them.
        self._checked = self.index
        if self._interval > 1:
            self._checked = path_index.team_index(self.problem.team, trajectory.positions[:: self._interval], margin)

    @property
    def positions(self) -> FloatArray:
        """``(H+1, K, d)`` [m]; not to be written to."""
        return self.index.positions

    def conflicts(self) -> Graph:
        """The robots that come within the margin of each other after the start, at the steps that are checked."""
        return graph_of(self.problem.num_robots, self._checked.pairs())

    def move(self, robots: ArrayLike, controls: FloatArray, states: FloatArray, arrived: ArrayLike) -> None:
        """Give robots ``(R,)`` other controls ``(H, R, m)``, states ``(H+1, R, n)`` and arrivals ``(R,)``."""
        index = np.asarray(robots)
        self._note(index, controls, states, arrived)
        self._place(index, states[..., : self.problem.dimension])

    def _note(self, index: IntArray, controls: FloatArray, states: FloatArray, arrived: ArrayLike) -> None:
        for rows, others in ((self.controls, controls), (self.states, states)):
            rows[:, index, : others.shape[2]] = others
            rows[:, index, others.shape[2] :] = 0
        self.arrived[index] = arrived
        self.reported[index] = self.problem.horizon + 1

    def _place(self, index: ArrayLike, positions: FloatArray) -> None:
        self.index.move(index, positions)
        if self._checked is not self.index:
            self._checked.move(index, positions[:: self._interval])

    def faults(self, robots: ArrayLike) -> tuple[Floats, IntArray]:
        """``(R,)`` present faults of robots ``(R,)`` at the steps that are checked, and ``(R,)`` the step of the first.

        They are counted in robots met: a missed goal and contact with an obstacle amount to :data:`MISSED_GOAL`, an
        arrival that rounding decides to one. The steps mean something for robots with faults only.
        """
        index = np.asarray(robots)
        costs, first = self._costs(index, self.positions[:, index].swapaxes(0, 1)[:, None], self.arrived[index, None])
        reported = self.reported[index]
        return np.floor(costs[:, 0]) + (reported <= self.problem.horizon), np.minimum(first[:, 0], reported)

    def take_best(self, robots: ArrayLike, paths: Rollouts, *, or_longer: bool = False) -> None:
        """Let robots ``(R,)``, one after the other, take the best of their ``V`` paths, if that is better than what
        they do.

        It has the fewest faults and, of those with as many, takes the least time. With ``or_longer`` it may take longer
        than what the robot does, as long as it has no more faults.
        """
        numbers, moved = np.asarray(robots), list[tuple[int, int]]()
        present = self.positions[:, numbers].swapaxes(0, 1)[:, None]
        tried = np.concatenate([present, np.moveaxis(paths.positions, 0, 2)], axis=1)
        arrives = np.concatenate([self.arrived[numbers, None], paths.arrived], axis=1)
        moves = (tried != tried[:, :1]).any(axis=(2, 3))  # otherwise than at present
        different = moves | (arrives != arrives[:, :1])
        own_faults, share, _ = self._alone(numbers, tried, arrives)
        for i, robot in enumerate(numbers.tolist()):
            costs = self._path_faults(robot, tried[i], different[i], own_faults[i]) + share[i]
            if self.reported[robot] <= self.problem.horizon:
                costs[0] += 1
                costs[1:] += (paths.states[:, i] == self.states[:, robot, None, : paths.states.shape[3]]).all(
                    axis=(0, 2)
                )
            best = int(costs[1:].argmin())
            if costs[1 + best] < (np.floor(costs[0]) + 1 if or_longer else costs[0]):
                moved.append((i, best))
                if moves[i, 1 + best]:
                    self._place([robot], paths.positions[:, [i], best])
        # All at once: a robot's own steps are far apart in memory.
        rows, chosen = np.array(moved, np.int64).reshape(-1, 2).T
        controls, states = paths.controls[:, rows, chosen], paths.states[:, rows, chosen]
        self._note(numbers[rows], controls, states, paths.arrived[rows, chosen])

    def _path_faults(self, robot: int, paths: FloatArray, different: BoolArray, alone: IntArray) -> IntArray:
        """``(1 + V,)`` faults of a robot's paths ``(1 + V, H+1, d)``, with those of each ``alone``, of which some are
        ``different`` from the first, its present one; all zero if none is.
        """
        if not different.any():
            return np.zeros(len(paths), np.int64)
        counted = np.append(0, np.flatnonzero(different))
        met, _ = self._checked.count_meetings([robot], paths[None, counted, :: self._interval])
        faults = np.full(len(paths), met[0, 0])
        faults[counted] = met[0]
        return faults + alone

    def _costs(self, robots: ArrayLike, paths: FloatArray, arrived: BoolArray) -> tuple[Floats, IntArray]:
        """``(R, V)`` faults of paths ``(R, V, H+1, d)``, plus the share of the horizon that they take, less than one;
        and the step of the first fault.
        """
        alone, share, first = self._alone(robots, paths, arrived)
        met, meeting = self._checked.count_meetings(robots, paths[:, :, :: self._interval])
        if self._interval > 1:
            # What there is none of comes after the last step.
            meeting = np.minimum(meeting * self._interval, self.problem.horizon + 1)
        return met + alone + share, np.minimum(meeting, first)

    def _alone(self, robots: ArrayLike, paths: FloatArray, arrived: BoolArray) -> tuple[IntArray, Floats, IntArray]:
        """The same without robots met: faults, the share of the horizon, and the step of the first fault."""
        paths, horizon = np.ascontiguousarray(paths), self.problem.horizon
        touching, moves, unsure = path_index.check_alone(self.problem.arrays, robots, paths)
        if self._interval > 1:
            checked = paths[:, :, :: self._interval]
            touching = path_index.check_alone(self.problem.arrays, robots, checked)[0] * self._interval
        faults = (unsure <= horizon) + MISSED_GOAL * (~arrived | (touching <= horizon))
        return faults, moves / (horizon + 1), np.minimum(touching, unsure)


TURNS = (0, 8, 16, 32, 64)  #: Steps before a robot's arrival, or nearest approach, to turn straight to its goal at
BATCH = 64  #: Robots that look for final approaches at the same time: all paths of a big team take room
EARLIER = (1, 2, 4, 8)  #: Steps before its arrival from which on a robot drives further in
SHARES = (1.0, 0.5, 0.75, 0.25)  #: Shares of its control in the first of these: strides to the radius begin elsewhere


def approach_goals(
    team: WorkingPlan, robots: IntArray, part: Problem, trajectory: Trajectory, *, or_longer: bool = False
) -> None:
    """Give robots ``(R,)`` their motions in the trajectory of ``part``, their own problem, or turn them to their goals.

    Those that would get worse (:meth:`WorkingPlan.take_best`) keep their motions. After a long way a deformation ends
    metres off its aim: sampling is worst at arriving, which steering does at once.
    """
    gap = np.linalg.norm(trajectory.positions - part.goal, axis=2)
    nearest = np.where(trajectory.arrived.any(axis=0), trajectory.arrived.argmax(axis=0), gap.argmin(axis=0))
    # In its last step a robot drives nowhere else: the motion as it is.
    switch = np.maximum(nearest[:, None] - np.array(TURNS), 0)
    switch = np.concatenate([np.full((len(robots), 1), part.horizon), switch], axis=1)
    order = np.argsort(-nearest, kind="stable")
    for some in np.array_split(order, -(-len(order) // BATCH)):
        if team.search.should_stop():
            break
        alone = part.select(some.tolist())
        states = trajectory.states[:, some, : alone.state_size]
        rollouts = drives(alone, states, trajectory.controls[:, some, : alone.control_size], switch[some])
        team.take_best(robots[some], rollouts, or_longer=or_longer)


def drive_further_in(search: SolveRun, candidate: Candidate, evaluate: Callable[[FloatArray], Candidate]) -> Candidate:
    """The candidate, or one whose robots drive further in where rounding decides who has arrived.

    Whoever has not in the report has in the trajectory, and might touch something as it drives on.
    """
    violations = () if candidate.report is None else candidate.report.violations
    late = {robot for violation in violations if violation.kind == "not arrived" for robot in violation.robots}
    if not late:
        return candidate
    with search.watch.paused():
        prepare_drives(search.problem)
    arrivals = arrival_steps(candidate.trajectory.arrived)
    for robot in sorted(late):
        part = search.problem.select([robot])
        for earlier, share in product(EARLIER, SHARES):
            step = int(arrivals[robot]) - earlier
            if step < 0 or search.should_stop():
                break
            own = _driven(search, part, candidate.controls[:, [robot], : part.control_size], step, share)
            # A big team takes seconds to evaluate; where rounding decides once more it does so alone too.
            if not evaluate_controls(search.engine, part, own).solved:
                continue
            controls = candidate.controls.copy()
            controls[:, [robot], : part.control_size] = own
            other = evaluate(controls)
            if other.rank[:2] > candidate.rank[:2]:
                candidate = other
                break
    return candidate


def _driven(search: SolveRun, part: Problem, controls: FloatArray, step: int, share: float) -> FloatArray:
    """A robot's controls ``(H, 1, m)``, but for a share of one at a step, after which it drives to its goal."""
    own = np.ascontiguousarray(controls)
    own[step] *= np.float32(share)
    return drives(part, search.engine.rollout(part, own).states, own, [[step + 1]]).controls[:, :, 0]
