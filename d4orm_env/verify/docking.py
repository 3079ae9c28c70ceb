"""Docking of robots, where rounding decides it in every way that it could.

The engines decide docking in float32. A robot that ends a step so close to its goal radius, or to the goal speed, that
their rounding could decide either way has several *readings*: it docks there, or drives on, until a step at which it
docks beyond doubt. A plan must be fine in all of them. Robots do not act on each other's motion, so the readings of a
team are those of its robots.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from d4orm_env.verify.geometry import Floats, norm
from d4orm_env.verify.motion import TeamMotion
from d4orm_env.verify.report import Violation

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem

RADIUS_TOLERANCE, SPEED_TOLERANCE = 1 / 7500, 1e-5
"""Least distance to the goal radius, as a share of it, and to the goal speed, as a share of the speed limit, that
rounding does not bridge."""
SPEED_ALLOWANCE = 2.0**-13
"""Share of the speed limit by which a robot may exceed its goal speed."""
HEADING_DOUBT = 1e-4
"""Angle by which rounding may shift a heading [rad]; integrated models turn nearly as exactly as they move."""
ROUNDING = 32 * 2.0**-23
"""The same, as a share of the coordinates; 20 units in float32's last place were measured."""
MAX_READINGS = 8
"""More readings of one robot are not followed, but reported."""


@dataclass(frozen=True, eq=False)
class Docking:
    """All readings of all robots, one body for each."""

    robot: NDArray[np.intp]  #: ``(B,)`` whose body it is
    steps: NDArray[np.intp]  #: ``(B,)`` steps after which it docks; more than the horizon where it never does
    #: ``(K,)`` of each robot's first reading [s]; infinite where it does not dock in every reading
    arrival_times: Floats
    arrival_speeds: Floats  #: ``(K,)`` speeds then [m/s]; NaN where a robot does not dock, or goals do not absorb
    last_steps: NDArray[np.intp]  #: ``(K,)`` steps of each robot's last reading
    violations: list[Violation]  #: Robots that do not dock in every reading

    def notes(self, robots: Iterable[int], dt: float) -> str:
        """Describe which of some robots have several readings, for the details of a violation."""
        notes = ""
        for robot in robots:
            steps = self.steps[self.robot == robot]
            if len(steps) > 1:
                notes += f"; rounding decides whether robot_{robot} docks at {steps[0] * dt:.3f} s, and both are judged"
        return notes


def find_docking(problem: Problem, motion: TeamMotion, ends: Floats) -> Docking:
    """The readings of every robot's docking; ``ends`` are its ``(H+1, K, d)`` positions if it drives on [m]."""
    distance = norm(ends[1:] - np.asarray(problem.goal, np.float64))
    possible, certain = _docks(problem, motion, ends, distance)
    never = len(distance) + 1
    if problem.arrival == "stay":
        return _staying(problem, motion, distance, certain)
    robots, steps, times, speeds, last, violations = [], [], [], [], [], []
    for robot in range(distance.shape[1]):
        sure = np.flatnonzero(certain[:, robot])[:1] + 1
        unsure = np.flatnonzero(possible[:, robot]) + 1
        unsure = unsure[unsure < (sure[0] if len(sure) else never)]
        readings = [*unsure.tolist(), *(sure.tolist() or [never])][:MAX_READINGS]
        arrives = readings[-1] < never and len(unsure) < MAX_READINGS
        robots += [robot] * len(readings)
        steps += readings
        last.append(readings[-1])
        times.append(readings[0] * problem.dt if arrives else np.inf)
        speeds.append(motion.pace[readings[0] - 1, robot] if arrives else np.nan)
        if not arrives:
            detail = "".join(_failure(problem, motion, robot, distance[:, robot], unsure.tolist()))
            violations.append(Violation("not arrived", (robot,), problem.dt * problem.horizon, detail))
    return Docking(np.array(robots), np.array(steps), np.array(times), np.array(speeds), np.array(last), violations)


def _staying(problem: Problem, motion: TeamMotion, distance: Floats, certain: NDArray[np.bool_]) -> Docking:
    """Goals do not absorb: a robot has arrived when it is at its goal, beyond doubt, from some step to the last."""
    horizon, num_robots = distance.shape
    away = horizon - np.argmax(~certain[::-1], axis=0)
    since = np.where(certain.all(axis=0), 1, away + 1)
    times = np.where(certain[-1], since * problem.dt, np.inf)
    violations = [
        Violation(
            "not arrived", (robot,), problem.dt * horizon,
            "".join(_failure(problem, motion, robot, distance[:, robot], [])),
        )
        for robot in np.flatnonzero(~certain[-1]).tolist()
    ]  # fmt: skip
    never = np.full(num_robots, horizon + 1)
    return Docking(np.arange(num_robots), never, times, np.full(num_robots, np.nan), never, violations)


def _docks(problem: Problem, motion: TeamMotion, ends: Floats, distance: Floats) -> tuple[NDArray[np.bool_], ...]:
    """``(H, K)`` where a robot may dock, as rounding has it, and where it does beyond doubt."""
    extent = np.maximum.accumulate(np.abs(ends).max(axis=2), axis=0)[1:]
    doubt = np.maximum(RADIUS_TOLERANCE * problem.goal_radius, ROUNDING * extent) + motion.integration_error
    doubt = np.minimum(doubt, problem.goal_radius / 4)
    speed_doubt = SPEED_TOLERANCE * motion.max_speed
    goal_speed = problem.goal_speed + SPEED_ALLOWANCE * motion.max_speed
    slow = (motion.pace <= goal_speed - speed_doubt) | (motion.pace == 0)
    possible = (distance <= problem.goal_radius + doubt) & (motion.pace <= goal_speed + speed_doubt)
    missed = heading_errors(problem, motion.end_headings)
    tolerance = problem.goal_heading_tolerance.astype(np.float64)
    certain = (distance <= problem.goal_radius - doubt) & slow & (missed <= tolerance - HEADING_DOUBT)
    return possible & (missed <= tolerance + HEADING_DOUBT), certain


def heading_errors(problem: Problem, headings: Floats) -> Floats:
    """``(H, K)`` angle from headings ``(H, F)`` of all bodies to the goal heading, or that of a trailer to its hitch
    angle if it is larger [rad]; minus infinity without one.
    """
    wanted = problem.goal_heading.astype(np.float64)
    if np.isnan(wanted).all():
        return np.full((1, len(wanted)), -np.inf)
    missed = _angle_between(headings[:, : len(wanted)], wanted)
    for robot in np.flatnonzero(~np.isnan(problem.goal_hitches).all(axis=1)).tolist():
        own = [number for number, body in enumerate(problem.team.bodies) if body.robot == robot]
        hitches = -np.diff(headings[:, own], axis=1)
        errors = _angle_between(hitches, problem.goal_hitches[robot, : len(own) - 1].astype(np.float64))
        missed[:, robot] = np.maximum(missed[:, robot], errors.max(axis=1))
    return missed


def _angle_between(angles: Floats, wanted: Floats) -> Floats:
    """Magnitudes of the differences of angles [rad]; minus infinity where they may be any."""
    turns = (angles - wanted) / (2 * np.pi)
    return np.where(np.isnan(wanted), -np.inf, 2 * np.pi * np.abs(turns - np.round(turns)))


def heading_note(problem: Problem, robot: int, missed: float) -> str:
    """Say by how much a robot misses its goal heading, if it has one, for the details of a violation."""
    if not np.isfinite(missed):
        return ""
    bent = "" if np.isnan(problem.goal_hitches[robot]).all() else " or a hitch angle"
    tolerance = problem.goal_heading_tolerance[robot]
    return f", {missed:.4g} rad from its goal heading{bent} (tolerance {tolerance:g} rad)"


def _failure(problem: Problem, motion: TeamMotion, robot: int, distance: Floats, unsure: list[int]) -> Iterator[str]:
    pace, missed = motion.pace[:, robot], heading_errors(problem, motion.end_headings)[-1, robot]
    yield f"{distance[-1]:.4g} m from its goal (goal radius {problem.goal_radius:g} m) at the horizon"
    if np.isfinite(problem.goal_speed[robot]):
        yield f", at {pace[-1]:.4g} m/s (goal speed {problem.goal_speed[robot]:g} m/s)"
    yield heading_note(problem, robot, missed)
    if unsure:
        yield (
            f", unless it docks at {unsure[0] * problem.dt:.3f} s, {distance[unsure[0] - 1]:.8g} m from its goal at "
            f"{pace[unsure[0] - 1]:.8g} m/s, which rounding decides; drive further in"
        )
