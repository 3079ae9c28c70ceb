"""Driving further into goals at whose radius a robot comes to rest, where rounding decides whether it has arrived."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.metrics import arrival_steps
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.tracking.steering import drives, prepare_drives

if TYPE_CHECKING:
    from d4orm_planners.base.solve import SolveRun

EARLIER = (1, 2, 4, 8)
"""Steps before its arrival from which on a robot drives otherwise."""
SHARES = (1.0, 0.5, 0.75, 0.25)
"""Shares of its control in the first of these steps: a stride that ends at the radius must begin elsewhere."""


def drive_further_in(search: SolveRun, candidate: Candidate, evaluate: Callable[[FloatArray], Candidate]) -> Candidate:
    """The candidate, or if rounding alone decides who has arrived in it, one whose robots drive further in.

    Args:
        search: The search.
        candidate: Result of an iteration.
        evaluate: Function that makes a candidate of controls ``(H, K, m)``.
    """
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
