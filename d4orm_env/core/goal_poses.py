"""Speeds, headings and hitch angles that a problem asks for at goals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import LARGEST, FloatArray, frozen_per_robot, numbers_of, one_or_each, refuse_robots
from d4orm_env.core.team import Team
from d4orm_env.dynamics.robot_model import ACCELERATION

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem

MOST_TRAILERS = 3
"""Most trailers of a robot."""
DEFAULT_TOLERANCE = 0.1
"""Tolerance of goal headings that are given none [rad]."""
LEAST_TOLERANCE = 1e-3
"""Smallest tolerance of a goal heading [rad]."""


def goal_speeds(team: Team, dt: float, given: ArrayLike | None) -> FloatArray:
    """``(K,)`` speeds at which robots may dock [m/s], given or what each brakes away in a time step ``dt`` [s]."""
    if given is None:
        speeds, step = team.max_acceleration * np.float32(dt), np.float32(dt)
        for robot, model in enumerate(team.robot_models):
            if model.first_order:
                speeds[robot] = np.inf
            elif any(column == ACCELERATION for _, column in model.state_limits):
                # Its acceleration must end too, at the rate that its controls allow.
                speeds[robot] = min(speeds[robot], team.limits[robot, model.control_limits[0]] * step * step / 2)
        return speeds
    speeds = one_or_each(given, "goal_speed", team.num_robots)
    right = (speeds >= 0) & ((speeds <= LARGEST) | (speeds == np.inf))
    refuse_robots(~right, "goal_speed", speeds, f"from 0 to {LARGEST:g}, or inf for no limit")
    return speeds


def checked_goal_poses(
    team: Team, heading: ArrayLike | None, tolerance: ArrayLike, hitches: ArrayLike | None
) -> dict[str, FloatArray]:
    """Headings and hitch angles that a problem asks for at goals, by its attributes' names."""
    headings = _goal_headings(team, heading)
    tolerances = frozen_per_robot(tolerance, "goal_heading_tolerance", team.num_robots)
    # What float32 does not resolve, or what allows any heading.
    wrong = (tolerances < LEAST_TOLERANCE) | (tolerances > np.float32(np.pi))
    refuse_robots(wrong, "goal_heading_tolerance", tolerances, f"from {LEAST_TOLERANCE:g} to pi", " rad")
    angles = _goal_hitches(team, hitches, headings)
    return {"goal_heading": headings, "goal_heading_tolerance": tolerances, "goal_hitches": angles}


def _goal_headings(team: Team, given: ArrayLike | None) -> FloatArray:
    """``(K,)`` headings with which robots must arrive [rad], NaN for any."""
    headings = one_or_each(np.nan if given is None else given, "goal_heading", team.num_robots, ", NaN for any")
    for robot in np.flatnonzero(~np.isnan(headings)).tolist():
        where = f"goal_heading of robot_{robot} is {headings[robot]:g}"
        if team.robot_models[robot].heading_index is None:
            raise ValueError(f"{where}, and a {team.models[robot]} has no heading; give NaN")
        if not abs(headings[robot]) <= np.float32(2 * np.pi):
            raise ValueError(f"{where} rad; it must be at most 2 pi in magnitude, so give radians, without whole turns")
    return headings


def _goal_hitches(team: Team, given: ArrayLike | None, headings: FloatArray) -> FloatArray:
    """``(K, 3)`` hitch angles with which trailers must arrive [rad], NaN for any and for those that there are not."""
    hitches = np.full((team.num_robots, MOST_TRAILERS), np.nan, np.float32)
    if given is None:
        return hitches
    values = numbers_of(given, "goal_hitches must be numbers, a row per robot")
    if values.ndim != 2 or values.shape[0] != team.num_robots or values.shape[1] > MOST_TRAILERS:
        raise ValueError(
            f"goal_hitches has shape {values.shape}; expected ({team.num_robots}, trailers), NaN for any and for none"
        )
    hitches[:, : values.shape[1]] = values
    for robot, number in np.argwhere(~np.isnan(hitches)).tolist():
        value, trailers = hitches[robot, number], team.robot_models[robot].trailers
        where = f"goal_hitches of robot_{robot} gives {value:g} rad for trailer {number + 1}"
        if number >= len(trailers):
            raise ValueError(f"{where}, and a {team.models[robot]} pulls {len(trailers)}; give NaN")
        if np.isnan(headings[robot]):
            raise ValueError(f"{where}, and no goal_heading; give both")
        most = team.limits[robot, dict(team.robot_models[robot].state_limits)[trailers[number][0]]]
        if not abs(value) <= most:
            raise ValueError(f"{where}; it must be at most its largest hitch angle, {most:g}, in magnitude")
    return hitches


def goal_headings(problem: Problem) -> int:
    """Bodies whose headings a problem asks for at goals: none, a robot, and trailers to the last with a hitch angle."""
    if np.isnan(problem.goal_heading).all():
        return 0
    asked = ~np.isnan(problem.goal_hitches).all(axis=0)
    return 1 + int(np.append(0, 1 + np.flatnonzero(asked)).max())


def states_at_goals(problem: Problem) -> FloatArray:
    """``(K, n)`` states of robots at rest at their goals; headings and hitch angles are NaN where any will do."""
    states = np.zeros_like(problem.start)
    states[:, : problem.dimension] = problem.goal
    for robot, model in enumerate(problem.team.robot_models):
        if model.heading_index is not None:
            states[robot, model.heading_index] = problem.goal_heading[robot]
        for number, (hitch, _) in enumerate(model.trailers):
            states[robot, hitch] = problem.goal_hitches[robot, number]
    return states
