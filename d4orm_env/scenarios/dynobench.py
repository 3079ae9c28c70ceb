"""Multi-robot problems of dynobench, db-CBS and db-LaCAM as they are written, in YAML, and results for their checkers.

Their models move by Euler steps of 0.1 s and ours by Runge-Kutta, which differ by about the 0.01 that db-CBS's checker
allows from one state to the next. They bound velocities and accelerations of integrators by component and we by norm,
which is within. They keep reference points within the bounds and we bodies, so ours are wider by what every body
covers, and hold all bodies at starts and goals.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, number_list, short_repr
from d4orm_env.core.errors import did_you_mean, first_line
from d4orm_env.core.files import checked_path, naming, read_yaml
from d4orm_env.core.goal_poses import MOST_TRAILERS
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.core.world import World
from d4orm_env.dynamics.first_order_cars import WHEELBASE
from d4orm_env.dynamics.models import get_model
from d4orm_env.dynamics.robot_model import Model
from d4orm_env.footprints import Box, Disc
from d4orm_env.scenarios import dynobench_types as kinds

DT = 0.1
"""Time step of all their models in the plane [s]."""
GOAL_TOLERANCE = 0.01
"""By how much their checkers let a component of the last state miss the goal [m, rad, m/s]."""
SLOWEST = 10
"""A problem's duration, in times that its robots would need straight to their goals."""
LEAST_STEPS = 300
HALF_TURN, FLOAT32_ERROR = 3.14159, 1e-6
"""Largest heading that is written: not beyond pi when it is read in float32, and how exactly that is then [rad]."""
BESIDE_HALF_TURN = 2 * GOAL_TOLERANCE
"""Distance to that within which headings may be written as it; their checkers allow twice that a step [rad]."""

KEYS, ROBOT_KEYS = ("min", "max", "obstacles"), ("type", "start", "goal")
"""Keys of their environments and robots that are read. One that looks like one of these is an error, all others are
left.
"""


def load_dynobench(path: str | os.PathLike[str], models: Mapping[str, Mapping[str, Any]] | None = None) -> Problem:
    """Read a multi-robot problem of dynobench, db-CBS or db-LaCAM.

    Args:
        path: Its YAML file, with ``environment`` and ``robots``.
        models: Parameters of robot types by name, which add to those known
            (:data:`~d4orm_env.scenarios.dynobench_types.MODELS`) or replace them; each as in one of
            dynobench's model files, such as ``{"dynamics": "integrator2_2d", "max_vel": 0.5, "max_acc": 2.0, "shape":
            "sphere", "radius": 0.1}``.

    Returns:
        The problem, in steps of 0.1 s, with rectangles and headings. Robots may leave their goals for others
        (``arrival="stay"``), and no margin is asked for.

    Raises:
        ValueError: If ``models`` are not as they should be; if the file cannot be read or is no such problem, a type is
            unknown, or a robot must not be at rest at its goal, which is not planned for; the message names the file,
            and all types that are unknown.
    """
    known = kinds.MODELS | kinds.checked_types({} if models is None else models)
    path = checked_path(path, "a problem of dynobench")
    with naming(path):
        try:
            return _problem(read_yaml(path), known, path)
        except (KeyError, TypeError, IndexError) as error:
            reason = f"it lacks {error}" if isinstance(error, KeyError) else first_line(error)
            raise ValueError(
                f"is no multi-robot problem of dynobench ({reason}); it has environment: min, max, obstacles, and "
                "robots: type, start, goal"
            ) from error


def _problem(content: Any, models: Mapping[str, dict[str, Any]], path: Path) -> Problem:
    robots, environment = content["robots"], content["environment"]
    entries = [(f"robot_{number}", robot, ROBOT_KEYS) for number, robot in enumerate(robots)]
    for what, entry, keys in [("environment", environment, KEYS), *entries]:
        _check_mapping(entry, what)
        for name in entry:
            if name not in keys and (meant := did_you_mean(name, keys)):
                raise ValueError(f"{what} has the key {short_repr(name)}{meant}")
    types = [robot["type"] for robot in robots]
    if unknown := dict.fromkeys(short_repr(name) for name in types if not isinstance(name, str) or name not in models):
        raise ValueError(
            f"robot types {', '.join(unknown)} are unknown; known are {', '.join(models)}, or give "
            f"their parameters as models={{type: {{'dynamics': ...}}}}"
        )
    parameters = [kinds.symmetric(models[name]) | models[name] for name in types]
    names = tuple(map(kinds.model_name, parameters))
    team = Team(
        names,
        max_speed=[own["max_vel"] for own in parameters],
        max_acceleration=[own.get("max_acc") or own.get("max_acc_abs") or 1.0 for own in parameters],
        max_turn_rate=[own.get("max_angular_vel", 1.0) for own in parameters],
        own_limits=_own_limits(parameters, names),
        footprint=[kinds.footprint_of(own) for own in parameters],
    )
    start, goal = _starts_and_goals(robots, team)
    turning = np.array([model.heading_index is not None for model in team.robot_models])
    inertia = np.array([not model.first_order for model in team.robot_models])
    d = team.dimension
    distance = np.linalg.norm(goal[:, :d] - start[:, :d], axis=1)
    steps = math.ceil(SLOWEST * float((distance / team.max_speed).max()) / DT)
    return Problem(
        team, start, goal[:, :d], _world(environment, team, start, goal), DT, max(LEAST_STEPS, steps), margin=0.0,
        goal_radius=GOAL_TOLERANCE, goal_speed=np.where(inertia, GOAL_TOLERANCE, np.inf), name=path.stem,
        arrival="stay", goal_heading=np.where(turning, _wrapped(goal[:, min(2, team.state_size - 1)]), np.nan),
        goal_heading_tolerance=GOAL_TOLERANCE, goal_hitches=_hitches(team, goal),
    )  # fmt: skip


def _starts_and_goals(robots: list[Mapping[str, Any]], team: Team) -> tuple[Floats, Floats]:
    """``(K, n)`` states of ours at starts and at goals, at rest at these."""
    start, goal = np.zeros((2, team.num_robots, team.state_size))
    for robot, (entry, model) in enumerate(zip(robots, team.robot_models, strict=True)):
        for what, states in (("start", start), ("goal", goal)):
            state = number_list(entry[what], f"{what} of robot_{robot}")
            if len(state) != model.state_size:
                given, kind = short_repr(entry[what]), entry["type"]
                raise ValueError(f"{what} of robot_{robot} is {given}; a {kind} has {model.state_size} components")
            states[robot, : model.state_size] = _state(model, state)
        end = goal[robot, : model.state_size].tolist()
        if list(model.functions.rest(tuple(end), 0.0)) != end:
            raise ValueError(
                f"goal of robot_{robot} is {short_repr(entry['goal'])}; give one at rest, with zero speeds"
            )
    return start, goal


def _own_limits(parameters: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, list[float]]:
    """``(K,)`` values by name; one where a robot has no such limit."""
    given = zip(names, map(kinds.limits_of, parameters), strict=True)
    own = [{limit.name: limits[limit.name] for limit in get_model(name).own_limits} for name, limits in given]
    return {name: [limits.get(name, 1.0) for limits in own] for name in dict.fromkeys(chain(*own))}


def _state(model: Model, theirs: Floats) -> Floats:
    """A state of ours; trailers turn by their hitch angles, and in theirs by their headings."""
    return np.append(theirs[:3], _wrapped(theirs[2:-1] - theirs[3:])) if model.trailers else theirs


def _wrapped(angle: Floats) -> Floats:
    """Angles above -pi, up to pi and what rounding may add."""
    return angle - 2 * np.pi * np.ceil((angle - np.pi) / (2 * np.pi) - 1e-6)


def _hitches(team: Team, states: Floats) -> Floats:
    """``(K, 3)`` hitch angles in states ``(K, n)``, NaN for trailers that there are not."""
    hitches = np.full((team.num_robots, MOST_TRAILERS), np.nan)
    for robot, model in enumerate(team.robot_models):
        for number, (hitch, _) in enumerate(model.trailers):
            hitches[robot, number] = states[robot, hitch]
    return hitches


def _world(environment: Mapping[str, Any], team: Team, start: Floats, goal: Floats) -> World:
    d, covered = team.dimension, min(footprint.inner_radius for footprint in team.footprint)
    lower, upper = (number_list(environment[name], f"environment's {name}", d) for name in ("min", "max"))
    # A robot whose goal lies on the bounds ends on either side of them; their checkers allow the whole tolerance there.
    lower -= GOAL_TOLERANCE / 2 * (abs(goal[:, :d] - lower) < GOAL_TOLERANCE / 2).any(axis=0)
    upper += GOAL_TOLERANCE / 2 * (abs(goal[:, :d] - upper) < GOAL_TOLERANCE / 2).any(axis=0)
    inside = (lower <= start[:, :d]) & (start[:, :d] <= upper) & (lower <= goal[:, :d]) & (goal[:, :d] <= upper)
    boxes, balls = [], []
    for number, obstacle in enumerate(environment.get("obstacles") or ()):
        what = f"obstacle {number}"
        kind = _check_mapping(obstacle, what, "type", "center", "size")["type"]
        if kind not in ("box", "sphere"):
            raise ValueError(f"type of {what} is {short_repr(kind)}; known are box, sphere")
        centre = number_list(obstacle["center"], f"center of {what}", d)
        size = number_list(obstacle["size"], f"size of {what}", 1 if kind == "sphere" else d)
        if not (size > 0).all():
            raise ValueError(f"size of {what} is {short_repr(obstacle['size'])}; it must be positive")
        if kind == "sphere":
            balls.append([*centre, *size])
        else:
            boxes.append([*(centre - size / 2), *(centre + size / 2)])
    lower, upper = lower - covered, upper + covered
    if d == 2 and inside.all():
        lowest, highest = _covered(team, np.stack([start, goal]).astype(np.float32))
        lower = np.where(lowest <= lower, lowest - GOAL_TOLERANCE / 2, lower)
        upper = np.where(highest >= upper, highest + GOAL_TOLERANCE / 2, upper)
    return World(d, boxes=boxes, lower=lower, upper=upper, **{"circles" if d == 2 else "spheres": balls})


def _covered(team: Team, states: FloatArray) -> tuple[Floats, Floats]:
    """``(2,)`` least and largest coordinates of all bodies in the plane in states ``(2, K, n)``."""
    ends, poses = [], team.body_poses(states)
    for number, body in enumerate(team.bodies):
        assert isinstance(body.footprint, Box | Disc)
        corners, rounding = body.footprint.core
        for x, y, heading in poses[:, number]:
            turned = corners @ [[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]]
            placed = np.add(turned, (x, y))
            ends += [placed - rounding, placed + rounding]
    points = np.concatenate(ends)
    return points.min(axis=0), points.max(axis=0)


def _check_mapping(entry: Any, what: str, *names: str) -> Any:
    """Return an entry of the file, which must be a mapping with these keys."""
    if not isinstance(entry, Mapping):
        raise ValueError(f"{what} is {short_repr(entry)}; it must be a mapping")
    for name in names:
        if name not in entry:
            raise ValueError(f"{what} is {short_repr(entry)}; it lacks {name!r}")
    return entry


def _turn_rates(model: Model, limits: FloatArray, states: Floats, actions: Floats) -> Floats:
    """``(T, A)`` rates of a robot's heading and of its trailers' by which their Euler steps turn these [rad/s]."""
    if model.name == "unicycle2":
        return states[1:, [model.state_names.index("turn_rate")]]
    if not model.trailers:
        return actions[:, [1]]
    speed = actions[:, 0]
    rates = [speed * np.tan(actions[:, 1]) / limits[WHEELBASE]]
    for hitch, length in model.trailers:
        bend = states[:-1, hitch - 1] - states[:-1, hitch]
        rates.append(speed * np.sin(bend) / limits[length])
        speed = speed * np.cos(bend)
    return np.stack(rates, axis=1)


def _turn_as_theirs(headings: Floats, rates: Floats, end: float) -> None:
    """Put headings ``(T + 1,)`` where Euler steps pass pi and ours do not, or the other way round, just beside pi.

    The last is to be on the same side as ``end`` (NaN for none), which they compare it with.
    """
    for step, turn in enumerate(DT * rates, 1):
        theirs = math.remainder(headings[step - 1] + turn, math.tau)
        if np.pi - abs(theirs) < FLOAT32_ERROR:  # either side of pi for them
            headings[step - 1] -= math.copysign(10 * FLOAT32_ERROR, headings[step - 1])
            theirs = math.remainder(headings[step - 1] + turn, math.tau)
        if abs(theirs - headings[step]) > np.pi and HALF_TURN - abs(headings[step]) < BESIDE_HALF_TURN:
            headings[step] = math.copysign(HALF_TURN, theirs)
    if len(rates) and abs(headings[-1] - end) > np.pi and HALF_TURN - abs(headings[-1]) < BESIDE_HALF_TURN:
        side, before = math.copysign(1.0, end), headings[-2]
        # From where they do not pass pi, though a trailer that is turned back swings a little more.
        latest = HALF_TURN - max(side * DT * rates[-1], 0.0) - GOAL_TOLERANCE / 10
        if 0 < side * before < latest + BESIDE_HALF_TURN:
            headings[-1], headings[-2] = side * HALF_TURN, side * min(side * before, latest)


def _executed(model: Model, dt: float, states: Floats, controls: FloatArray) -> Floats:
    """Actions that lead from each state to the next: accelerations less what the limit of the speed swallows."""
    actions = controls[:, : model.control_size].astype(np.float64)
    angles = {model.heading_index, *(hitch for hitch, _ in model.trailers)}
    rates = [index for index in range(model.dimension, model.state_size) if index not in angles]
    if len(rates) == model.control_size:
        executed = np.diff(states[:, rates], axis=0) / dt
        swallowed = abs(executed - actions) > GOAL_TOLERANCE
        actions[swallowed] = executed[swallowed]
    return actions


def result_lines(problem: Problem, trajectory: Trajectory) -> Iterator[str]:
    """The lines of a result file: states and actions of every robot, until it rests at its goal for good."""
    known = {ours: theirs for theirs, ours in kinds.DYNAMICS.items()}
    known |= {"unicycle": "unicycle1"} | {f"car_with_{count}_trailers": "car_with_trailers" for count in (2, 3)}
    yield "result:"
    for robot, model in enumerate(problem.team.robot_models):
        if model.name not in known:
            raise ValueError(
                f"robot_{robot} is a {model.name}, which dynobench has no model for; it has {', '.join(known)}"
            )
        states = trajectory.states[:, robot, : model.state_size].astype(np.float64)
        # Where it may leave its goal it is there before all that arriving does not ask for, as turn rates, is at rest.
        others = [*{*range(model.dimension, model.state_size)} - {*model.speed_indices, model.heading_index}]
        unlike = abs(states[:, others] - states[-1, others]) > GOAL_TOLERANCE / 100
        moving = ~trajectory.arrived[:, robot] | unlike.any(axis=1)
        last = int(np.flatnonzero(moving)[-1]) + 1 if moving.any() else 0
        states = states[: last + 1]
        for hitch, _ in model.trailers:
            most = problem.team.limits[robot, dict(model.state_limits)[hitch]] - 2 * FLOAT32_ERROR  # written as float32
            states[:, hitch] = states[:, hitch - 1] - np.clip(states[:, hitch], -most, most)
        actions = _executed(model, problem.dt, states, trajectory.controls[:last, robot])
        if model.heading_index is not None:
            turned = [model.heading_index, *(hitch for hitch, _ in model.trailers)]
            # Not beyond pi as it is written: their checker would turn that round.
            states[:, turned] = np.minimum(_wrapped(states[:, turned]), HALF_TURN)
            rates = _turn_rates(model, problem.team.limits[robot], states, actions)
            ends = _wrapped(problem.goal_heading[robot] - np.append(0.0, np.cumsum(problem.goal_hitches[robot])))
            for angle, own_rates, end in zip(turned, rates.T, ends.tolist(), strict=False):
                _turn_as_theirs(states[:, angle], own_rates, end)
        yield "-"
        for name, rows in (("states", states), ("actions", actions)):
            yield f"  {name}:" if len(rows) else f"  {name}: []"
            yield from (f"    - [{', '.join(f'{value:.7g}' for value in row)}]" for row in rows)
