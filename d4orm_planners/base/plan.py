"""Plans: what planners return, and their files."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal, get_args

from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.files import checked_path, replaced_when_done
from d4orm_env.core.infeasibility import prove_infeasible
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.summary_line import count
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.verify import VerificationReport, verify
from d4orm_planners.base.candidate import step_faults
from d4orm_planners.base.display import DisplayMixin
from d4orm_planners.base.provenance import Provenance

if TYPE_CHECKING:
    from d4orm_env.scenarios import dynobench
    from d4orm_planners.base import plan_file
    from d4orm_planners.tracking import export as exports
    from d4orm_planners.tracking import smoothing
    from d4orm_planners.tracking.export import ExportReport, Setpoints
    from d4orm_planners.tracking.smoothing import SmoothMotion
else:
    dynobench = LazyModule("d4orm_env.scenarios.dynobench")
    plan_file = LazyModule("d4orm_planners.base.plan_file")
    exports = LazyModule("d4orm_planners.tracking.export")
    smoothing = LazyModule("d4orm_planners.tracking.smoothing")

Status = Literal["solved", "iteration_limit", "time_limit", "stopped", "interrupted", "infeasible", "refuted"]
"""End of a search; see :class:`Plan`."""


@dataclass(frozen=True)
class IterationRecord:
    """The state of a solve after one iteration."""

    iteration: int  #: From 1
    wall_time: float  #: Seconds since the solve began, compilation not counted
    denoising_steps: int  #: Sample-score-update steps so far
    reward: float  #: Mean reward of this iteration's candidate
    solved: bool  #: Whether this iteration's candidate is a solution
    num_failed: int  #: Robots that do not arrive or violate the margin
    num_margin_violated: int  #: Robots that come within the margin of anything, at any step
    num_not_arrived: int  #: Robots that are not at their goal at the horizon
    best_reward: float  #: Mean reward of the best candidate so far
    best_solved: bool  #: Whether that one is a solution
    excluded: int = 0  #: Samples of this iteration that were left out because their reward was not finite
    #: Remark of the method on how the iteration ended; ``ipopt`` has IPOPT's return status here, ``d-d4orm`` the nodes
    #: that were lost and the messages that were dropped, and path finding why it found none
    note: str = ""
    unreachable: tuple[int, ...] = ()  #: Robots for which path finding found no path to their goals
    denoising_time: float | None = None  #: Seconds of ``wall_time`` spent denoising; ``None`` in older versions' files
    #: ``(H, K, m)`` of this iteration's candidate, for callbacks; ``None`` in a plan's history
    controls: FloatArray | None = field(default=None, repr=False, compare=False)
    trajectory: Trajectory | None = field(default=None, repr=False, compare=False)  #: Their rollout, likewise


@dataclass(frozen=True, eq=False, repr=False)
class Plan(DisplayMixin):
    """Controls for a whole team, how they were found and what they lead to.

    Raises:
        ValueError: If the status is none of these, or ``"solved"`` and the plan is not, or ``"refuted"`` or
            ``"infeasible"`` and it is.
    """

    planner: str  #: Name of the planner
    problem: Problem  #: The problem
    seed: int  #: The seed
    #: ``(H, K, m)`` inside the limits, zero after arrival. Not what speeds change by where the model limits these:
    #: robots get :meth:`sample`
    controls: FloatArray
    solved: bool  #: Everyone arrives, the margin is kept at every step, and :func:`d4orm_env.verify` found no fault
    #: End of the search. ``"solved"``: with a solution. ``"iteration_limit"`` or ``"time_limit"``: with the budget, so
    #: without a solution unless it was to be improved. ``"stopped"`` (by the callback) or ``"interrupted"``: with
    #: whatever it had. ``"infeasible"``: at once, for there is a proof that nothing solves the problem, see
    #: :func:`d4orm_env.core.infeasibility.prove_infeasible`. ``"refuted"``: a file says ``"solved"`` or
    #: ``"infeasible"``, and that is not so
    status: Status
    iterations: int  #: Iterations done
    denoising_steps: int  #: Sample-score-update steps done
    wall_time: float  #: Seconds, first-call compilation excluded
    history: tuple[IterationRecord, ...]  #: One record per iteration
    trajectory: Trajectory  #: Rollout of the controls
    #: See :func:`d4orm_env.core.trajectory.trajectory_metrics`, which looks for contact at steps, where ``solved`` and
    #: ``failures`` know of contact between them too; and ``"denoising_steps"`` and ``"denoising_share"``, the share of
    #: the iterations that did some. ``d-d4orm`` adds ``"messages"`` and ``"message_bytes"`` that its nodes sent, each
    #: to all others, and ``"waiting_share"``, the share of their time that they waited for each other
    metrics: dict[str, float]
    provenance: Provenance | None = None  #: Preset, settings, version and machine; ``None`` for a plan of an older file

    def __post_init__(self) -> None:
        if self.status not in get_args(Status):
            raise ValueError(f"status {self.status!r} is unknown; it must be one of {', '.join(get_args(Status))}")
        if self.solved != {"solved": True, "refuted": False, "infeasible": False}.get(self.status, self.solved):
            raise ValueError(f"status is {self.status!r} and solved is {self.solved}; one of them must be wrong")

    @property
    def denoising_time(self) -> float | None:
        """Seconds of ``wall_time`` that denoising took; ``None`` for a plan of an older file."""
        return self.history[-1].denoising_time if self.history else 0.0

    @cached_property
    def verified(self) -> bool:
        """True if :func:`d4orm_env.verify` finds no fault with the controls; judged when it is first asked for."""
        return self._report.ok

    @cached_property
    def _report(self) -> VerificationReport:
        return verify(self.problem, self.controls)

    @property
    def failures(self) -> dict[str, str]:
        """The robots that the plan leaves unsolved, and why: a sentence for each, by agent name; empty if it is solved.

        It is the proof of infeasibility, or the faults of each robot at the steps, or if there are none, the violations
        that :func:`d4orm_env.verify` found.
        """
        if self.solved:
            return {}
        if self.status == "infeasible":
            reasons = {robot: [proof] for robot, proof in prove_infeasible(self.problem).items()}
        else:
            unreachable = {robot for record in self.history for robot in record.unreachable}
            reasons = step_faults(self.problem, self.trajectory, unreachable)
        if not reasons:
            for violation in self._report.violations:
                for robot in violation.robots:
                    reasons.setdefault(robot, []).append(str(violation))
        return {f"robot_{robot}": "; ".join(reasons[robot]) for robot in sorted(reasons)}

    def sample(
        self, rate: float = 100.0, *, max_acceleration: ArrayLike | None = None, max_jerk: ArrayLike | None = None
    ) -> Setpoints:
        """Return smooth setpoints for the robots' own controllers, verified again.

        The controls of a plan jump at every step. This is a spline of class C4 through its positions, driven as much
        more slowly as the limits need (:mod:`d4orm_planners.tracking.smoothing`).

        Args:
            rate: Of the setpoints [Hz].
            max_acceleration: Limit of each robot, one or ``K`` [m/s^2]; by default the team's own.
            max_jerk: The same for the jerk [m/s^3]; by default none.

        Raises:
            ValueError: If the plan is not solved, or the smoothed motion touches something or takes more than four
                times as long; the message has the number that fails.
        """
        return exports.sample_motion(self._smooth(max_acceleration, max_jerk), rate)

    def export(
        self,
        format: str,
        path: str | os.PathLike[str],
        *,
        rate: float = 100.0,
        height: float = 0.0,
        max_acceleration: ArrayLike | None = None,
        max_jerk: ArrayLike | None = None,
    ) -> ExportReport:
        """Write the setpoints of :meth:`sample` for robots to execute.

        Args:
            format: ``"csv"``, ``"crazyswarm2"`` (polynomials), ``"rosbag2"`` or ``"mcap"`` (ROS 2 messages);
                see :data:`d4orm_planners.tracking.export.FORMATS`.
            path: Folder for the files, which is made.
            rate: Of the setpoints [Hz]; polynomials have none.
            height: z of a team that moves in the plane [m].
            max_acceleration: See :meth:`sample`.
            max_jerk: See :meth:`sample`.

        Raises:
            ValueError: As :meth:`sample`; if there is no such format, the motion does not fit it, or the files cannot
                be written.
            ModuleNotFoundError: If the format needs a library that is missing.
        """
        folder = checked_path(path, "the folder of an export")
        return exports.export_motion(self._smooth(max_acceleration, max_jerk), format, folder, rate, height)

    def _smooth(self, max_acceleration: ArrayLike | None, max_jerk: ArrayLike | None) -> SmoothMotion:
        limits = smoothing.MotionLimits.of(self.problem, max_acceleration, max_jerk)
        if not self.solved:
            reasons = "; ".join(f"{robot} {reason}" for robot, reason in self.failures.items())
            raise ValueError(f"the plan is not solved, and robots do not execute it: {reasons}")
        return smoothing.smooth_motion(self.problem, self.trajectory, limits)

    @property
    def title(self) -> str:
        """Title: planner, problem and status."""
        spent = f"{count(self.iterations, 'iteration')}, {self.wall_time:.2f} s"
        team = f"{self.problem.name}, {count(self.problem.num_robots, 'robot')}"
        return f"{team} by {self.planner}: {self.status.replace('_', ' ')} after {spent}"

    def to_dynobench(self, path: str | os.PathLike[str]) -> None:
        """Write the motion as a result file of dynobench and db-CBS: states and actions of every robot.

        Raises:
            ValueError: If a robot's model is none of theirs, or it cannot be written; nothing is left behind then.
        """
        lines = list(dynobench.result_lines(self.problem, self.trajectory))
        with replaced_when_done(checked_path(path, "a result of dynobench")) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan, its problem and its trajectory to an ``.npz`` file.

        Raises:
            ValueError: If the path does not end in ``.npz``, or it cannot be written; nothing is left behind then.
        """
        plan_file.save_plan(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """Read a plan that :meth:`save` wrote. Nothing is unpickled, nor unpacked beyond what the problem has room for.

        The controls are evaluated again: ``solved``, the metrics and the trajectory are the result of that, unless the
        trajectory in the file is the same but for rounding.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If the file is damaged or is not a plan.
        """
        return plan_file.read_plan(path)


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Read a plan, as :meth:`Plan.load` does.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged or is not a plan.
    """
    return Plan.load(path)
