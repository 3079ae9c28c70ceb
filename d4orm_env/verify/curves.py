"""Verdict on a team's motion that is given as curves."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.verify.contact import MAX_NUMBERS, Pairs, Stretch, Watch
from d4orm_env.verify.convex_bodies import ConvexBodies
from d4orm_env.verify.discs import surroundings
from d4orm_env.verify.footprints import TurningPairs, turning_watches
from d4orm_env.verify.geometry import Floats, norm
from d4orm_env.verify.report import VerificationReport, Violation

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem

CHORD_ERROR = 1 / 15_000
"""Largest distance between a curve and the chord that stands for it, as a share of the robot's radius."""


def verify_curves(
    problem: Problem,
    position: Callable[[Floats], Floats],
    duration: float,
    bend: Floats,
    heading: Callable[[Floats], Floats],
) -> VerificationReport:
    """Judge curves: do all robots end at their goals, and touch nothing at any time?

    As :func:`d4orm_env.verify.verify` judges controls, known to ``CHORD_ERROR`` of the radius for each robot. Curves
    say nothing of trailers: a team with any counts as the discs round its robots, which may refuse what is fine. Of
    control limits it says nothing, nor when robots arrive.

    Args:
        problem: The team and its world; its dynamics do not count.
        position: ``(T,)`` times from 0 to ``duration`` [s] to ``(T, K, d)`` positions [m].
        duration: When the motion ends [s].
        bend: ``(K,)`` bound on the acceleration of any point of each robot [m/s^2].
        heading: ``(T,)`` times to ``(T, K)`` headings [rad].
    """
    team, radius = problem.team, problem.team.radius.astype(np.float64)
    steps = max(1, int(np.ceil(duration / problem.dt)))
    dt = duration / steps
    sub_steps = max(1, int(np.ceil(dt * np.sqrt(bend / (8 * CHORD_ERROR * radius))).max()))
    robots = np.arange(len(radius))
    shapes = ConvexBodies.of(team) if team.shapes and not has_trailers(problem) else None
    pairs: Pairs = Pairs(robots, radius) if shapes is None else TurningPairs(robots, shapes)
    world = problem.world
    obstacles = surroundings(world, robots, radius) if shapes is None else turning_watches(world, robots, shapes)
    watches: list[Watch] = [pairs, *obstacles]
    size = max(1, MAX_NUMBERS // ((2 * sub_steps + 1) * len(radius) * problem.dimension))
    for first in range(0, steps, size):
        begins = np.arange(first, min(first + size, steps)) * dt
        times = begins[:, None] + np.linspace(0, dt, sub_steps + 1)
        path = position(times.ravel()).reshape(*times.shape, len(radius), problem.dimension)
        travel, turn = norm(path - path[:, :1]).max(axis=1), np.zeros((0, 0, 0))
        if shapes is not None:
            turn = heading(times.ravel()).reshape(*times.shape, len(radius))
            travel = shapes.stretch * (travel + shapes.outer * np.abs(turn - turn[:, :1]).max(axis=1))
        for watch in watches:
            watch.observe(Stretch(path, travel, first * dt, dt, turn))
    violations = [violation for watch in watches for violation in watch.violations()]
    violations += _not_arrived(problem, position, duration)
    nearest = min((watch.minimum for watch in obstacles), default=np.inf)
    unknown = np.full(len(radius), np.nan)
    return VerificationReport(
        pairs.minimum, nearest, unknown, unknown, True, sorted(violations, key=lambda violation: violation.time)
    )


def has_trailers(problem: Problem) -> bool:
    """Check whether any robot pulls trailers."""
    return any(model.trailers for model in problem.team.robot_models)


def _not_arrived(problem: Problem, position: Callable[[Floats], Floats], duration: float) -> list[Violation]:
    distance = norm(position(np.array([duration]))[0] - problem.goal.astype(np.float64))
    return [
        Violation(
            "not arrived", (robot,), duration,
            f"{distance[robot]:.4g} m from its goal (goal radius {problem.goal_radius:g} m) at the end",
        )
        for robot in np.flatnonzero(distance > problem.goal_radius * (1 + CHORD_ERROR)).tolist()
    ]  # fmt: skip
