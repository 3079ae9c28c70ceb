"""Final approaches: robots turn straight to their goals in time, and drive further in where rounding decides."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.metrics import arrival_steps
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.tracking.steering import drives, prepare_drives

if TYPE_CHECKING:
    from d4orm_planners.base.solve import SolveRun
    from d4orm_planners.base.working_plan import WorkingPlan

TURNS = (0, 8, 16, 32, 64)
"""Steps before a robot's arrival, or its nearest approach, at which it may turn straight to its goal."""
BATCH = 64
"""Robots that look for final approaches at the same time: all paths of a big team take room."""
EARLIER = (1, 2, 4, 8)
"""Steps before its arrival from which on a robot drives further in."""
SHARES = (1.0, 0.5, 0.75, 0.25)
"""Shares of its control in the first of these steps: a stride that ends at the radius must begin elsewhere."""


def approach_goals(
    team: WorkingPlan, robots: IntArray, part: Problem, trajectory: Trajectory, *, or_longer: bool = False
) -> None:
    """Let robots do as in the trajectory, or turn to their goals in time; those that get worse stay as they were.

    A deformation ends metres from where it was aimed at after a long way: arriving is what sampling does worst, and
    steering does at once.

    Args:
        team: The team's plan, changed in place.
        robots: ``(R,)`` their numbers in the team.
        part: The problem of these robots alone.
        trajectory: Their motion in it.
        or_longer: See :meth:`~d4orm_planners.base.working_plan.WorkingPlan.take_best`.
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
    """The candidate, or if rounding alone decides who has arrived in it, one whose robots drive further in."""
    report = candidate.report
    if report is None or report.ok or any(violation.kind != "not arrived" for violation in report.violations):
        return candidate
    with search.watch.paused():
        prepare_drives(search.problem)
    arrivals = arrival_steps(candidate.trajectory.arrived)
    for robot in np.flatnonzero(candidate.unsolved).tolist():
        for earlier, share in product(EARLIER, SHARES):
            step = int(arrivals[robot]) - earlier
            if step < 0 or search.should_stop():
                break
            other = evaluate(_driven(search, candidate, robot, step, share))
            if other.rank[:2] > candidate.rank[:2]:
                candidate = other
                break
    return candidate


def _driven(search: SolveRun, candidate: Candidate, robot: int, step: int, share: float) -> FloatArray:
    """The team's controls, where a robot takes a share of its control at a step and then drives to the goal."""
    part, controls = search.problem.select([robot]), candidate.controls.copy()
    own = np.ascontiguousarray(controls[:, [robot], : part.control_size])
    own[step] *= np.float32(share)
    path = drives(part, search.engine.rollout(part, own).states, own, [[step + 1]])
    controls[:, robot, : part.control_size] = path.controls[:, 0, 0]
    return controls
