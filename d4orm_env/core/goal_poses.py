"""Poses with which robots must arrive: headings, and hitch angles of their trailers."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, as_float32, frozen_per_robot, short_repr
from d4orm_env.core.team import Team

MOST_TRAILERS = 3
"""Most trailers of a robot."""
LEAST_TOLERANCE = 1e-3
"""Smallest tolerance of a goal heading [rad]."""


def checked_goal_poses(
    team: Team, heading: ArrayLike | None, tolerance: ArrayLike, hitches: ArrayLike | None
) -> dict[str, FloatArray]:
    """What a problem asks of poses at goals, by its attributes' names."""
    headings = _goal_headings(team, heading)
    tolerances = frozen_per_robot(tolerance, "goal_heading_tolerance", team.num_robots)
    _check_tolerances(tolerances)
    angles = _goal_hitches(team, hitches, headings)
    return {"goal_heading": headings, "goal_heading_tolerance": tolerances, "goal_hitches": angles}


def one_or_each(given: ArrayLike, name: str, num_robots: int, note: str = "") -> FloatArray:
    """``(K,)`` numbers, given as one for all robots or one each."""
    try:
        values = as_float32(given)
    except ValueError as error:
        raise ValueError(f"{name} must be a number or one per robot, not {short_repr(given)}; {error}") from error
    values = np.repeat(values, num_robots) if values.ndim == 0 else values
    if values.shape != (num_robots,):
        raise ValueError(f"{name} has shape {values.shape}; expected one number, or ({num_robots},){note}")
    return values


def _goal_headings(team: Team, given: ArrayLike | None) -> FloatArray:
    """``(K,)`` headings with which robots must arrive [rad], NaN for any."""
    headings = one_or_each(np.nan if given is None else given, "goal_heading", team.num_robots, ", NaN for any")
    for robot in np.flatnonzero(~np.isnan(headings)).tolist():
        if team.robot_models[robot].heading_index is None:
            raise ValueError(
                f"goal_heading of robot_{robot} is {headings[robot]:g}, and a {team.models[robot]} has no heading; "
                f"give NaN"
            )
        if not abs(headings[robot]) <= np.float32(2 * np.pi):
            raise ValueError(
                f"goal_heading of robot_{robot} is {headings[robot]:g} rad; it must be at most 2 pi in magnitude, so "
                f"give radians, without whole turns"
            )
    return headings


def _goal_hitches(team: Team, given: ArrayLike | None, headings: FloatArray) -> FloatArray:
    """``(K, 3)`` hitch angles with which trailers must arrive [rad], NaN for any and for those that there are not."""
    hitches = np.full((team.num_robots, MOST_TRAILERS), np.nan, np.float32)
    if given is None:
        return hitches
    try:
        values = as_float32(given)
    except ValueError as error:
        raise ValueError(f"goal_hitches must be numbers, a row per robot, not {short_repr(given)}; {error}") from error
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


def _check_tolerances(tolerance: FloatArray) -> None:
    """Refuse tolerances of goal headings ``(K,)`` that float32 does not resolve, or that allow any."""
    for robot in np.flatnonzero((tolerance < LEAST_TOLERANCE) | (tolerance > np.float32(np.pi)))[:1].tolist():
        value = f"goal_heading_tolerance of robot_{robot} is {tolerance[robot]:g} rad"
        raise ValueError(f"{value}; it must be from {LEAST_TOLERANCE:g} to pi")


def goal_directions(headings: FloatArray, hitches: FloatArray) -> FloatArray:
    """``(K, 8)`` goal headings ``(K,)`` and hitch angles ``(K, 3)`` as unit vectors; zero for none."""
    angles = np.column_stack([headings, hitches])
    known = ~np.isnan(angles)
    sine, cosine = portable.sin_cos(np.where(known, angles, 0).astype(np.float64))
    return (np.stack([cosine, sine], axis=2) * known[..., None]).astype(np.float32).reshape(len(headings), -1)


def squared_chords(headings: FloatArray, tolerance: FloatArray) -> FloatArray:
    """``(K,)`` squares of the chords by which unit vectors may miss goal headings; infinite for none."""
    half = portable.sin_cos(tolerance.astype(np.float64) / 2)[0]
    return np.where(np.isnan(headings), np.inf, 4 * half * half).astype(np.float32)
