"""Controls and what they lead to: how every planner's results are evaluated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import LARGEST, LARGEST_NUMBER, BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine.types import Engine
from d4orm_env.verify import VerificationReport, verify
from d4orm_planners.base.plan import failed_robots

PLAN_REACH = LARGEST_NUMBER / LARGEST
"""Times its limit that a planned control may be, so that no square of it overflows: some methods scale theirs up."""


@dataclass(frozen=True)
class Candidate:
    """Controls and what they lead to.

    Attributes:
        planned: ``(H, K, m)`` as the method left them, at most :data:`PLAN_REACH` times the limits; zero once docked.
        controls: ``(H, K, m)`` as executed: inside the limits, zero once docked.
        trajectory: Their rollout.
        failed: ``(K,)`` robots that do not arrive, or violate the margin at some step that was checked.
        report: Report of :func:`d4orm_env.verify`; ``None`` where a robot fails at any step, and it was not asked.
    """

    planned: FloatArray
    controls: FloatArray
    trajectory: Trajectory
    failed: BoolArray
    report: VerificationReport | None

    @property
    def solved(self) -> bool:
        """True if all arrive, the margin is kept at every step, and :func:`d4orm_env.verify` agrees."""
        return self.report is not None and self.report.ok

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


def evaluate_controls(engine: Engine, problem: Problem, controls: FloatArray, check_interval: int = 1) -> Candidate:
    """Roll controls ``(H, K, m)`` out and evaluate them: failures at some steps, a solution at all."""
    reach = PLAN_REACH * problem.team.control_limits
    bounded = np.clip(controls, -reach, reach)
    trajectory = engine.rollout(problem, bounded)
    docked = trajectory.arrived[:-1, :, None] & problem.docks
    planned = np.where(docked, np.float32(0), bounded)
    failed = failed_robots(trajectory, check_interval)
    report = None if failed_robots(trajectory).any() else verify(problem, trajectory.controls)
    return Candidate(planned, trajectory.controls, trajectory, failed, report)
