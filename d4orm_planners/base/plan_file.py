"""Files of plans: ``.npz`` without pickles, evaluated again when they are read."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, fields
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from d4orm_env.core.errors import MissingFileError, first_line
from d4orm_env.core.files import ArrayArchive, checked_path, replaced_when_done, require_file
from d4orm_env.core.infeasibility import prove_infeasible
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import DEFAULT_RADIUS
from d4orm_env.core.trajectory import Trajectory, trajectory_metrics
from d4orm_env.engine.choice import rollout
from d4orm_env.scenarios.problem_files import describe
from d4orm_env.scenarios.schema import parse
from d4orm_env.verify import verify
from d4orm_planners.base.candidate import failed_robots
from d4orm_planners.base.plan import IterationRecord, Plan
from d4orm_planners.base.provenance import Provenance

FORMAT = "d4orm-plan-1"
HEADER_BYTES = 64 * 2**20  #: Largest header of a plan file, which has the problem and the history
TOLERANCE = 1e-3
"""Deviation allowed between a file's trajectory and its controls' rollout, in SI units for robots of the default size:
processors round differently."""

_RECORDED = tuple(field.name for field in fields(IterationRecord) if field.compare)
_ARRAYS = tuple(field.name for field in fields(Trajectory))
_NUMBERS = ("states", "positions", "controls", "rewards")
_SCALARS = ("planner", "seed", "solved", "status", "iterations", "denoising_steps", "wall_time", "metrics")


def save_plan(plan: Plan, path: str | os.PathLike[str]) -> None:
    target = _npz_path(path)
    header = {
        "format": FORMAT,
        "problem": describe(plan.problem),
        "history": [{name: getattr(record, name) for name in _RECORDED} for record in plan.history],
        "provenance": None if plan.provenance is None else asdict(plan.provenance),
        **{name: getattr(plan, name) for name in _SCALARS},
    }
    arrays = {name: getattr(plan.trajectory, name) for name in _ARRAYS}
    with replaced_when_done(target) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)


def read_plan(path: str | os.PathLike[str]) -> Plan:
    source = _npz_path(path)
    try:
        require_file(source, "a plan")
        with source.open("rb") as stream, ArrayArchive(stream, ("header", *_ARRAYS)) as archive:
            header = json.loads(str(archive.array("header", HEADER_BYTES)))
            if header.pop("format") != FORMAT:
                raise ValueError("written by another version")
            problem = parse(header.pop("problem"))
            claimed = _checked_trajectory(problem, archive)
        history = tuple(_read_record(record) for record in header.pop("history"))
        made = header.pop("provenance", None)
        provenance = None if made is None else Provenance(**made)
        return _evaluated(problem, history, claimed, _checked(header) | {"provenance": provenance})
    except FileNotFoundError:
        raise MissingFileError(f"there is no plan at {source}; write one with Plan.save or d4orm plan") from None
    except Exception as error:  # a damaged archive makes zipfile, zlib and NumPy raise errors of a dozen kinds
        raise ValueError(
            f"{source} is not a readable plan ({first_line(error)}); mend that, or write it anew with Plan.save"
        ) from error


def _evaluated(
    problem: Problem, history: tuple[IterationRecord, ...], claimed: Trajectory, scalars: dict[str, Any]
) -> Plan:
    """The plan of a file, with what is true of its controls."""
    actual = rollout(problem, claimed.controls, engine="cpu")
    trajectory = claimed if _agree(problem, claimed, actual) else actual
    solved = not failed_robots(trajectory).any() and verify(problem, trajectory.controls).ok
    if scalars["status"] in ("solved", "infeasible", "refuted"):
        proved = not solved and scalars["status"] == "infeasible" and prove_infeasible(problem)
        scalars["status"] = "solved" if solved else "infeasible" if proved else "refuted"
    scalars |= {"solved": solved, "metrics": scalars["metrics"] | trajectory_metrics(problem, trajectory)}
    return Plan(problem=problem, history=history, trajectory=trajectory, controls=trajectory.controls, **scalars)


def _npz_path(path: str | os.PathLike[str]) -> Path:
    target = checked_path(path, "a plan file")
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
