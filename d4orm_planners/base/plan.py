"""Plans: what planners return, and their files."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from math import prod
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from d4orm_env.core.archives import ArrayArchive
from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.errors import first_line
from d4orm_env.core.files import replaced_when_done
from d4orm_env.core.metrics import mean_stretch, trajectory_metrics
from d4orm_env.core.problem import Problem
from d4orm_env.core.summary_line import Row, count, outcome_rows
from d4orm_env.core.team import DEFAULT_RADIUS
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.rollout import rollout
from d4orm_env.scenarios.schema import describe, parse
from d4orm_env.verify import VerificationReport, verify
from d4orm_planners.base.conflict_groups import conflicts
from d4orm_planners.base.display import DisplayMixin
from d4orm_planners.base.infeasibility import prove_infeasible
from d4orm_planners.base.provenance import Provenance

Status = Literal["solved", "iteration_limit", "time_limit", "stopped", "interrupted", "infeasible", "refuted"]
"""End of a search; see :class:`Plan`."""

FORMAT = "d4orm-plan-1"

HEADER_BYTES = 64 * 2**20
"""Largest header of a plan file, which has the problem and the history."""

TOLERANCE = 1e-3
"""Deviation allowed between a file's trajectory and its controls' rollout, in SI units for robots of the default size:
processors round differently."""


@dataclass(frozen=True)
class IterationRecord:
    """The state of a solve after one iteration.

    Attributes:
        iteration: From 1.
        wall_time: Seconds since the solve began, compilation not counted.
        denoising_steps: Sample-score-update steps so far.
        reward: Mean reward of this iteration's candidate.
        solved: Whether this iteration's candidate is a solution.
        num_failed: Robots that do not arrive or violate the margin.
        num_margin_violated: Robots that come within the margin of anything, at any step.
        num_not_arrived: Robots that are not at their goal at the horizon.
        best_reward: Mean reward of the best candidate so far.
        best_solved: Whether that one is a solution.
        excluded: Samples of this iteration that were left out because their reward was not finite.
        note: Remark of the method on how the iteration ended; ``ipopt`` has IPOPT's return status here,
            ``d-d4orm`` the nodes that were lost and the messages that were dropped, and path finding why it found none.
        unreachable: Robots for which path finding found no way to their goals.
        controls: ``(H, K, m)`` of this iteration's candidate, for callbacks; ``None`` in a plan's history.
        trajectory: Their rollout, likewise.
    """

    iteration: int
    wall_time: float
    denoising_steps: int
    reward: float
    solved: bool
    num_failed: int
    num_margin_violated: int
    num_not_arrived: int
    best_reward: float
    best_solved: bool
    excluded: int = 0
    note: str = ""
    unreachable: tuple[int, ...] = ()
    controls: FloatArray | None = field(default=None, repr=False, compare=False)
    trajectory: Trajectory | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True, eq=False, repr=False)
class Plan(DisplayMixin):
    """Controls for a whole team, how they were found and what they lead to.

    Attributes:
        planner: Name of the planner.
        problem: The problem.
        seed: The seed.
        controls: ``(H, K, m)`` inside the limits, zero once docked.
        solved: Whether everyone arrives, the margin is kept at every step, and :func:`d4orm_env.verify` found no fault.
        status: End of the search. ``"solved"``: with a solution. ``"iteration_limit"`` or ``"time_limit"``: with the
            budget, so without a solution unless it was to be improved. ``"stopped"`` (by the callback) or
            ``"interrupted"``: with whatever it had. ``"infeasible"``: at once, for there is a proof that nothing solves
            the problem, see :func:`d4orm_planners.base.infeasibility.prove_infeasible`. ``"refuted"``: a file says
            ``"solved"`` or ``"infeasible"``, and that is not so.
        iterations: Iterations done.
        denoising_steps: Sample-score-update steps done.
        wall_time: Seconds, first-call compilation excluded.
        history: One record per iteration.
        trajectory: Rollout of the controls.
        metrics: See :func:`d4orm_env.core.metrics.trajectory_metrics`. ``d-d4orm`` adds ``"messages"`` and
            ``"message_bytes"`` that its nodes sent, each to all others, and ``"waiting_share"``, the share of their
            time that they waited for each other.
        provenance: Preset, settings, version and machine; ``None`` for a plan of an older file.

    Raises:
        ValueError: If the status is none of these, or ``"solved"`` and the plan is not, or ``"refuted"`` or
            ``"infeasible"`` and it is.
    """

    planner: str
    problem: Problem
    seed: int
    controls: FloatArray
    solved: bool
    status: Status
    iterations: int
    denoising_steps: int
    wall_time: float
    history: tuple[IterationRecord, ...]
    trajectory: Trajectory
    metrics: dict[str, float]
    provenance: Provenance | None = None

    def __post_init__(self) -> None:
        if self.status not in get_args(Status):
            raise ValueError(f"status {self.status!r} is unknown; it must be one of {', '.join(get_args(Status))}")
        if self.solved != {"solved": True, "refuted": False, "infeasible": False}.get(self.status, self.solved):
            raise ValueError(f"status is {self.status!r} and solved is {self.solved}; one of them must be wrong")

    @cached_property
    def verified(self) -> bool:
        """True if :func:`d4orm_env.verify` finds no fault with the controls; judged when it is first asked for."""
        return self._report.ok

    @cached_property
    def _report(self) -> VerificationReport:
        return verify(self.problem, self.controls)

    @cached_property
    def stretch(self) -> float:
        """Way travelled over the shortest free way, see :func:`d4orm_env.core.metrics.mean_stretch`; found when it is
        first asked for, so that solving does not wait for it.
        """
        return mean_stretch(self.problem, self.trajectory)

    @property
    def failures(self) -> dict[str, str]:
        """The robots that the plan leaves unsolved, and why: a sentence for each, by agent name; empty if it is solved.

        It is the proof where there is one; else what each does wrong at the steps, or if none does anything, what
        :func:`d4orm_env.verify` found.
        """
        if self.solved:
            return {}
        if self.status == "infeasible":
            reasons = {robot: [proof] for robot, proof in prove_infeasible(self.problem).items()}
        else:
            reasons = self._faults()
        if not reasons:
            for violation in self._report.violations:
                for robot in violation.robots:
                    reasons.setdefault(robot, []).append(str(violation))
        return {f"robot_{robot}": "; ".join(reasons[robot]) for robot in sorted(reasons)}

    def _faults(self) -> dict[int, list[str]]:
        """Return the faults of robots at the steps."""
        problem, trajectory = self.problem, self.trajectory
        reach = np.asarray(problem.team.radius) + problem.margin
        near = conflicts(trajectory.positions, problem.team.radius, problem.margin)
        unreachable = {robot for record in self.history for robot in record.unreachable}
        reasons: dict[int, list[str]] = {}
        for robot in np.flatnonzero(failed_robots(trajectory)).tolist():
            faults = reasons[robot] = []
            if not trajectory.arrived[-1, robot]:
                gap = np.linalg.norm(trajectory.positions[-1, robot] - problem.goal[robot])
                faults.append(f"ends {gap:.2g} m from its goal")
            if robot in unreachable:
                faults.append(f"has no way from start to goal that is {reach[robot]:.4g} m clear of obstacles")
            others = [f"robot_{other}" for other in sorted(near[robot])]
            if others:
                faults.append(f"comes within the margin of {', '.join(others)}")
            if problem.world.clearance(trajectory.positions[1:, robot]).min() <= reach[robot]:
                faults.append("comes within the margin of an obstacle or the bounds")
            if not faults:
                faults.append("comes so near to the margin of something that rounding decides")
        return reasons

    @property
    def title(self) -> str:
        """Title: planner, problem and status."""
        spent = f"{count(self.iterations, 'iteration')}, {self.wall_time:.2f} s"
        team = f"{self.problem.name}, {count(self.problem.num_robots, 'robot')}"
        return f"{team} by {self.planner}: {self.status.replace('_', ' ')} after {spent}"

    @property
    def key_figures(self) -> list[Row]:
        """Return the plan's key figures."""
        return outcome_rows(self.metrics, self.problem.num_robots)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan, its problem and its trajectory to an ``.npz`` file.

        Raises:
            ValueError: If the path does not end in ``.npz``.
            OSError: If it cannot be written; nothing is left behind then.
        """
        target = _npz_path(path)
        header = {
            "format": FORMAT,
            "problem": describe(self.problem),
            "history": [{name: getattr(record, name) for name in _RECORDED} for record in self.history],
            "provenance": None if self.provenance is None else asdict(self.provenance),
            **{name: getattr(self, name) for name in _SCALARS},
        }
        arrays = {field.name: getattr(self.trajectory, field.name) for field in fields(Trajectory)}
        with replaced_when_done(target) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """Read a plan that :meth:`save` wrote. Nothing is unpickled, nor unpacked beyond what the problem has room for.

        What the file says of its controls is judged anew: ``solved`` and the metrics of the trajectory are what is
        found here, and so is the trajectory itself, unless the file's is the same but for rounding.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If the file is damaged or is not a plan.
        """
        source = _npz_path(path)
        try:
            with source.open("rb") as stream, ArrayArchive(stream, ("header", *_ARRAYS)) as archive:
                header = json.loads(str(archive.array("header", HEADER_BYTES)))
                if header.pop("format") != FORMAT:
                    raise ValueError("written by another version")
                problem = parse(header.pop("problem"))
                claimed = _checked_trajectory(problem, archive)
            history = tuple(_read_record(record) for record in header.pop("history"))
            made = header.pop("provenance", None)
            provenance = None if made is None else Provenance(**made)
            return cls._judged(problem, history, claimed, _checked(header) | {"provenance": provenance})
        except FileNotFoundError:
            raise FileNotFoundError(f"there is no plan at {source}") from None
        except Exception as error:  # a damaged archive makes zipfile, zlib and NumPy raise errors of a dozen kinds
            raise ValueError(
                f"{source} is not a readable plan ({first_line(error)}); write it anew with Plan.save"
            ) from error

    @classmethod
    def _judged(
        cls, problem: Problem, history: tuple[IterationRecord, ...], claimed: Trajectory, scalars: dict[str, Any]
    ) -> Plan:
        """The plan of a file, with what is true of its controls."""
        actual = rollout(problem, claimed.controls, engine="cpu")
        trajectory = claimed if _agree(problem, claimed, actual) else actual
        solved = not failed_robots(trajectory).any() and verify(problem, trajectory.controls).ok
        if scalars["status"] in ("solved", "infeasible", "refuted"):
            proved = not solved and scalars["status"] == "infeasible" and prove_infeasible(problem)
            scalars["status"] = "solved" if solved else "infeasible" if proved else "refuted"
        scalars |= {"solved": solved, "metrics": scalars["metrics"] | trajectory_metrics(problem, trajectory)}
        return cls(problem=problem, history=history, trajectory=trajectory, controls=trajectory.controls, **scalars)


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """:meth:`Plan.load`, beside :func:`d4orm_env.load_problem`."""
    return Plan.load(path)


def failed_robots(trajectory: Trajectory, check_interval: int = 1) -> BoolArray:
    """``(K,)`` robots that do not arrive, or violate the margin at some ``check_interval``-th step.

    The start itself cannot be planned away, so it does not count.
    """
    violated = trajectory.margin_violated[check_interval::check_interval]
    failed: BoolArray = ~trajectory.arrived[-1] | violated.any(axis=0)
    return failed


_RECORDED = tuple(field.name for field in fields(IterationRecord) if field.compare)
_ARRAYS = tuple(field.name for field in fields(Trajectory))
_NUMBERS = ("states", "positions", "controls", "rewards")
_SCALARS = ("planner", "seed", "solved", "status", "iterations", "denoising_steps", "wall_time", "metrics")


def _npz_path(path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    if target.suffix != ".npz":
        raise ValueError(f"plan file {str(target)!r} must end in .npz")
    return target


def _read_record(record: dict[str, Any]) -> IterationRecord:
    if not record.keys() <= set(_RECORDED):
        raise ValueError(f"its history has {', '.join(sorted(record.keys() - set(_RECORDED)))}")
    return IterationRecord(**record | {"unreachable": tuple(record.get("unreachable", ()))})


def _checked(header: dict[str, Any]) -> dict[str, object]:
    kinds = {"planner": str, "seed": int, "solved": bool, "status": str, "iterations": int, "denoising_steps": int}
    for name, kind in {**kinds, "wall_time": (int, float), "metrics": dict}.items():
        if not isinstance(header[name], kind):  # type: ignore[arg-type]
            raise ValueError(f"{name} is {header[name]!r}")
    if not all(isinstance(value, (int, float)) for value in header["metrics"].values()):
        raise ValueError(f"metrics are {header['metrics']!r}, not all numbers")
    return {name: header[name] for name in _SCALARS}


def _checked_trajectory(problem: Problem, archive: ArrayArchive) -> Trajectory:
    steps, robots = problem.horizon, problem.num_robots
    shapes = {
        "states": (steps + 1, robots, problem.state_size),
        "positions": (steps + 1, robots, problem.dimension),
        "controls": (steps, robots, problem.control_size),
        "rewards": (steps, robots),
        "arrived": (steps + 1, robots),
        "collided": (steps + 1, robots),
        "margin_violated": (steps + 1, robots),
    }
    content = {}
    for name, shape in shapes.items():
        kind: np.dtype = np.dtype(np.float32 if name in _NUMBERS else np.bool_)
        array = archive.array(name, prod(shape) * kind.itemsize)
        if array.shape != shape or array.dtype != kind or not np.isfinite(array).all():
            raise ValueError(f"{name} does not fit the problem")
        content[name] = array
    return Trajectory(**content)


def _agree(problem: Problem, claimed: Trajectory, actual: Trajectory) -> bool:
    """Check whether two trajectories are the same but for rounding."""
    size = problem.team.largest_radius / DEFAULT_RADIUS
    return all(
        np.allclose(
            getattr(claimed, name),
            getattr(actual, name),
            rtol=TOLERANCE,
            atol=TOLERANCE * (1 if name == "rewards" else size),
        )
        if name in _NUMBERS
        else np.array_equal(getattr(claimed, name), getattr(actual, name))
        for name in _ARRAYS
    )
