"""Multi-robot problems of dynobench, db-CBS and db-LaCAM as they are written, in YAML, and results for their checkers.

Their models move by Euler steps of 0.1 s and ours by Runge-Kutta, which differ by less than the 0.01 that their
checkers allow from one state to the next. They bound velocities and accelerations of integrators by component and we by
norm, which is within. They keep reference points within the bounds and we bodies, so ours are wider by what every body
covers.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from d4orm_env.core.arrays import shown
from d4orm_env.core.errors import first_line
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.core.yaml_text import read_yaml
from d4orm_env.dynamics.models import get_model
from d4orm_env.footprints import Box, Disc, Footprint

if TYPE_CHECKING:
    from d4orm_env.core.trajectory import Trajectory

DT = 0.1
"""Time step of all their models in the plane [s]."""
GOAL_TOLERANCE = 0.01
"""By how much their checkers let a component of the last state miss the goal [m, rad, m/s]."""
SLOWEST = 10
"""A problem's duration, in times that its robots would need straight to their goals."""
LEAST_STEPS = 300

_UNICYCLE1: dict[str, Any] = {
    "dynamics": "unicycle1", "min_vel": -0.5, "max_vel": 0.5, "min_angular_vel": -0.5, "max_angular_vel": 0.5,
    "shape": "box", "size": (0.5, 0.25), "radius": 0.4,
}  # fmt: skip
_INTEGRATOR1: dict[str, Any] = {"dynamics": "integrator1_2d", "max_vel": 0.5, "shape": "sphere", "radius": 0.1}
_INTEGRATOR2: dict[str, Any] = {
    "dynamics": "integrator2_2d", "max_vel": 0.5, "max_acc": 2.0, "shape": "sphere", "radius": 0.1,
}  # fmt: skip
_UNICYCLE2: dict[str, Any] = _UNICYCLE1 | {"dynamics": "unicycle2", "max_acc_abs": 0.25, "max_angular_acc": 0.25}
_SPHERE = _UNICYCLE1 | {"shape": "sphere", "min_angular_vel": -2.0, "max_angular_vel": 2.0}

MODELS: dict[str, dict[str, Any]] = {
    "unicycle1_v0": _UNICYCLE1,
    "unicycle1_sphere_v0": _UNICYCLE1 | {"shape": "sphere"},
    "unicycle_first_order": _UNICYCLE1,
    "unicycle_first_order_0": _UNICYCLE1,
    "unicycle_first_order_0_sphere": _SPHERE,
    "unicycle2_v0": _UNICYCLE2,
    "unicycle_second_order_0": _UNICYCLE2,
    "integrator1_2d_v0": _INTEGRATOR1,
    "single_integrator": _INTEGRATOR1,
    "single_integrator_0": _INTEGRATOR1,
    "integrator2_2d_v0": _INTEGRATOR2,
    "double_integrator_0": _INTEGRATOR2,
    "integrator2_3d_v0": _INTEGRATOR2 | {"dynamics": "integrator2_3d"},
}
"""Robot types and their parameters, as in dynobench's ``models`` and db-CBS's ``robots.cpp``."""

DYNAMICS = {
    "unicycle1": "unicycle1", "unicycle2": "unicycle2", "integrator1_2d": "velocity2d", "integrator2_2d": "holonomic2d",
    "integrator2_3d": "holonomic3d",
}  # fmt: skip
"""Their dynamics and our models."""


def load_dynobench(path: str | os.PathLike[str], models: Mapping[str, Mapping[str, Any]] | None = None) -> Problem:
    """Read a multi-robot problem of dynobench, db-CBS or db-LaCAM.

    Args:
        path: Its YAML file, with ``environment`` and ``robots``.
        models: Parameters of robot types by name, beside or instead of :data:`MODELS`; each as in one of dynobench's
            model files, such as ``{"dynamics": "integrator2_2d", "max_vel": 0.5, "max_acc": 2.0, "shape": "sphere",
            "radius": 0.1}``.

    Returns:
        The problem, in steps of 0.1 s, with rectangles and headings. Robots may leave their goals for others
        (``arrival="stay"``), and no margin is asked for.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no such problem, or a type is unknown; the message names all of those.
    """
    try:
        return _problem(read_yaml(path), MODELS | {name: dict(given) for name, given in (models or {}).items()}, path)
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"{path}: no multi-robot problem of dynobench, {first_line(error)} is missing or is not what was expected; "
            f"it has environment: min, max, obstacles, and robots: type, start, goal"
        ) from error


def _problem(content: Any, models: Mapping[str, dict[str, Any]], path: str | os.PathLike[str]) -> Problem:
    robots, environment = content["robots"], content["environment"]
    types = [robot["type"] for robot in robots]
    _check_types(types, models)
    parameters = [_symmetric(models[name]) | models[name] for name in types]
    names = tuple(map(_model, parameters))
    team = Team(
        names,
        max_speed=[own["max_vel"] for own in parameters],
        max_acceleration=[own.get("max_acc") or own.get("max_acc_abs") or 1.0 for own in parameters],
        max_turn_rate=[own.get("max_angular_vel", 1.0) for own in parameters],
        own_limits=_own_limits(parameters, names),
        footprint=[_footprint(own) for own in parameters],
    )
    start, goal = np.zeros((2, team.num_robots, team.state_size))
    for robot, (entry, model) in enumerate(zip(robots, team.robot_models, strict=True)):
        for what, states in (("start", start), ("goal", goal)):
            if len(entry[what]) != model.state_size:
                given, kind = shown(entry[what]), entry["type"]
                raise ValueError(f"{what} of robot_{robot} is {given}; a {kind} has {model.state_size} components")
            states[robot, : model.state_size] = entry[what]
    turning = np.array([model.heading_index is not None for model in team.robot_models])
    inertia = np.array([not model.first_order for model in team.robot_models])
    d = team.dimension
    distance = np.linalg.norm(goal[:, :d] - start[:, :d], axis=1)
    steps = math.ceil(SLOWEST * float((distance / team.max_speed).max()) / DT)
    return Problem(
        team, start, goal[:, :d], _world(environment, team), DT, max(LEAST_STEPS, steps), margin=0.0,
        goal_radius=GOAL_TOLERANCE, goal_speed=np.where(inertia, GOAL_TOLERANCE, np.inf), name=Path(path).stem,
        arrival="stay", goal_heading=np.where(turning, goal[:, min(2, team.state_size - 1)], np.nan),
        goal_heading_tolerance=GOAL_TOLERANCE,
    )  # fmt: skip


def _check_types(types: list[Any], models: Mapping[str, dict[str, Any]]) -> None:
    unknown = [name for name in dict.fromkeys(types) if name not in models]
    if unknown:
        raise ValueError(
            f"robot types {', '.join(map(shown, unknown))} are unknown; known are {', '.join(models)}, or give their "
            f"parameters as models={{type: {{'dynamics': ...}}}}"
        )
    for name in dict.fromkeys(types):
        own = models[name]
        if own.get("dynamics") not in DYNAMICS:
            raise ValueError(
                f"robot type {name}: dynamics {shown(own.get('dynamics'))} has no model here; "
                f"there are {', '.join(DYNAMICS)}"
            )
        for least in ("min_vel", "min_angular_vel"):
            if own.get(least, -1.0) >= 0:
                raise ValueError(f"robot type {name}: {least} is {own[least]:g}; it must be negative, for robots rest")


def _symmetric(own: Mapping[str, Any]) -> dict[str, float]:
    """The lower limits of a type whose parameters give none."""
    return {f"min_{name}": -own[f"max_{name}"] for name in ("vel", "angular_vel") if f"max_{name}" in own}


def _model(own: Mapping[str, Any]) -> str:
    """The name of our model; the unicycle has limits for both directions only where they are not symmetric."""
    name = DYNAMICS[own["dynamics"]]
    return "unicycle" if name == "unicycle1" and own.items() >= _symmetric(own).items() else name


OWN_LIMITS = {
    "max_reverse_speed": ("min_vel", -1), "max_right_turn_rate": ("min_angular_vel", -1),
    "max_turn_acceleration": ("max_angular_acc", 1),
}  # fmt: skip
"""Limits that our models have for themselves: their parameter, and its sign."""


def _own_limits(parameters: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, list[float]]:
    """``(K,)`` values by name; one where a robot has no such limit."""
    known = [{limit.name for limit in get_model(name).own_limits} for name in names]
    return {
        limit: [sign * own[theirs] if limit in has else 1.0 for own, has in zip(parameters, known, strict=True)]
        for limit, (theirs, sign) in OWN_LIMITS.items()
        if any(limit in has for has in known)
    }


def _footprint(own: Mapping[str, Any]) -> Footprint:
    return Disc(own["radius"]) if own["shape"] == "sphere" else Box(*own["size"][:2])


def _world(environment: Mapping[str, Any], team: Team) -> World:
    d, covered = team.dimension, min(footprint.inner_radius for footprint in team.footprint)
    lower, upper = np.array(environment["min"], float)[:d] - covered, np.array(environment["max"], float)[:d] + covered
    boxes, balls = [], []
    for obstacle in environment.get("obstacles") or ():
        centre = np.array(obstacle["center"], float)[:d]
        if obstacle["type"] == "sphere":
            balls.append([*centre, obstacle["size"] if np.isscalar(obstacle["size"]) else obstacle["size"][0]])
            continue
        if obstacle["type"] != "box":
            raise ValueError(f"obstacle type {shown(obstacle['type'])} is unknown; known are box, sphere")
        half = np.array(obstacle["size"], float)[:d] / 2
        boxes.append([*(centre - half), *(centre + half)])
    kind = {"circles" if d == 2 else "spheres": balls}
    return World(d, boxes=boxes, lower=lower, upper=upper, **kind)


def result_lines(problem: Problem, trajectory: Trajectory) -> Iterator[str]:
    """The lines of a result file: states and actions of every robot, until it rests at its goal for good."""
    known = {ours: theirs for theirs, ours in DYNAMICS.items()} | {"unicycle": "unicycle1"}
    yield "result:"
    for robot, model in enumerate(problem.team.robot_models):
        if model.name not in known:
            raise ValueError(
                f"robot_{robot} is a {model.name}, which dynobench has no model for; it has {', '.join(known)}"
            )
        moving = np.flatnonzero(~trajectory.arrived[:, robot])
        last = int(moving[-1]) + 1 if len(moving) else 0
        states = trajectory.states[: last + 1, robot, : model.state_size].astype(np.float64)
        if model.heading_index is not None:
            states[:, model.heading_index] = (states[:, model.heading_index] + np.pi) % (2 * np.pi) - np.pi
        yield "-"
        for name, rows in (("states", states), ("actions", trajectory.controls[:last, robot, : model.control_size])):
            yield f"  {name}:" if len(rows) else f"  {name}: []"
            yield from (f"    - [{', '.join(f'{value:.7g}' for value in row)}]" for row in rows)
