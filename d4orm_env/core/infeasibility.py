"""Proofs that a problem has no solution, whatever the planner.

A solution keeps the margin at the end of every step, and touches nothing in between. So its robots are nowhere nearer
to an obstacle than their radius; and on straight lines from step to step nowhere nearer than their safety distance,
radius and margin, less half of what they travel in a step. Space is cut into cells. Where the clearance in the middle
of a cell, plus half a diagonal, is less than that, no point of it is free; and what the other cells do not connect
is not connected.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import Floats, IntArray
from d4orm_env.core.lazy import LazyModule, load
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.models import MODEL_CODES, NUM_BUILT_IN
from d4orm_env.dynamics.robot_model import ACCELERATION

ndimage: Any = LazyModule("scipy.ndimage")

ROUNDING = 64 * 2.0**-23
"""Rounding error of float32, as a share of the largest coordinate or of radius and margin."""
MAX_CELLS = 2**18
"""Most cells; coarser ones prove less."""
HALVINGS = 3
"""Number of times that cells as large as the smallest radius and margin are halved."""
SIMILAR = 1.1
"""Robots whose safety distances differ by a smaller factor are judged by the smallest of them."""


def prepare_proofs(problem: Problem) -> None:
    """Import what takes longer than the proofs of such a problem."""
    if problem.world.num_obstacles:
        load(ndimage)


def prove_infeasible(problem: Problem) -> dict[int, str]:
    """Return the reasons why a problem has no solution, by robot; empty where that is not proved.

    Proved are starts within the margin that cannot be left in one step, goals within it or so near to each other that
    robots at rest there are within it, and walls between start and goal. Gaps that are only a little too narrow are
    taken for wide enough, and so are those of a world many times larger than its robots. Of a footprint only the disc
    within it counts. For models of users only goals and walls count, because nothing says how far their robots get in a
    step.
    """
    starts, goals, doubt = _ends(problem)
    proofs = dict(_crowded(problem, "starts", starts, _travel(problem, _start_speed(problem)) + doubt, "one step"))
    at_rest = np.full(problem.num_robots, problem.goal_radius + doubt)
    proofs |= dict(_crowded(problem, "has a goal", goals, at_rest, "the goal radius"))
    if not proofs:
        robots = _walled_off(problem)
        proofs = dict.fromkeys(robots, "has no free path to its goal: walls are closed all round the one or the other")
    return proofs


def check_connected(problem: Problem) -> None:
    """Raise ``ValueError``, which names them, if walls are proved to lie between robots' starts and goals."""
    if robots := _walled_off(problem):
        names = ", ".join(f"robot_{robot}" for robot in robots)
        inner = " or ".join(sorted({f"{radius:.4g}" for radius in problem.team.inner_radius[robots]}))
        raise ValueError(
            f"{names} {'has' if len(robots) == 1 else 'have'} no path from start to goal, not even for the disc of "
            f"{inner} m within the footprint; move the start or the goal, open the world there, or use a smaller "
            f"footprint or margin"
        )


def _ends(problem: Problem) -> tuple[Floats, Floats, float]:
    """Starts and goals ``(K, d)``, and what rounding may add to distances [m]."""
    starts, goals = problem.start[:, : problem.dimension].astype(np.float64), problem.goal.astype(np.float64)
    largest = max(np.abs(starts).max(), np.abs(goals).max(), problem.team.inner_radius.max() + problem.margin)
    return starts, goals, float(problem.rounding + ROUNDING * largest)


def _start_speed(problem: Problem) -> Floats:
    """``(K,)`` speed of each robot at the start; its limit where the state holds none [m/s]."""
    speeds = problem.team.max_speed.astype(np.float64)
    for robot, model in enumerate(problem.team.robot_models):
        if model.speed_indices:
            own = problem.start[robot, list(model.speed_indices)].astype(np.float64)
            speeds[robot] = np.sqrt((own * own).sum())
    return speeds


def _travel(problem: Problem, speed: Floats) -> Floats:
    """``(K,)`` longest way of each robot in a step that it begins at this speed ``(K,)`` [m]."""
    limits, travel = problem.team.limits.astype(np.float64), np.full(problem.num_robots, np.inf)
    for robot, model in enumerate(problem.team.robot_models):
        if MODEL_CODES[model.name] < NUM_BUILT_IN:
            strength = 0.0 if model.first_order else limits[robot, ACCELERATION]
            if ACCELERATION not in model.control_limits and not model.first_order:  # it grows within the step
                strength += problem.dt * limits[robot, model.control_limits[0]]
            travel[robot] = problem.dt * (speed[robot] + strength * problem.dt / 2)
    return travel


def _crowded(problem: Problem, what: str, positions: Floats, freedom: Floats, within: str) -> Iterator[tuple[int, str]]:
    """Robots that stay within the margin of something, ``freedom`` ``(K,)`` from their positions ``(K, d)`` or less."""
    radius, margin = problem.team.inner_radius, problem.margin
    clearance, needed = problem.world.clearance(positions) - radius, f"the margin of {margin:g} m within {within}"
    for robot in np.flatnonzero(clearance + freedom < margin).tolist():
        gap = f"{what} {clearance[robot]:.3g} m from an obstacle or the bounds"
        yield robot, f"{gap}, and cannot come clear of them by {needed}"
    for later in range(1, len(positions)):
        offset = positions[:later] - positions[later]
        gaps = np.sqrt((offset * offset).sum(axis=1)) - radius[:later] - radius[later]
        for other in np.flatnonzero(gaps + freedom[:later] + freedom[later] < margin).tolist():
            for robot, neighbour in ((later, other), (other, later)):
                gap = f"{what} {gaps[other]:.3g} m from robot_{neighbour}'s"
                yield robot, f"{gap}, and the two cannot come clear of each other by {needed}"


def _walled_off(problem: Problem) -> list[int]:
    """Robots whose goals are not connected with their starts."""
    d, safety_distance = problem.dimension, problem.team.inner_radius + problem.margin
    if not problem.world.num_obstacles or safety_distance.min() <= 0:
        return []
    starts, goals, doubt = _ends(problem)
    travel = _travel(problem, problem.team.max_speed.astype(np.float64))
    for halving in range(1 + HALVINGS):
        low, cell, clearance = _cells(
            problem, np.concatenate([starts, goals]), float(safety_distance.min()) / 2**halving
        )
        half, are_open = cell * np.sqrt(d) / 2, True
        robots: list[int] = []
        for group in _groups_by_size(safety_distance):
            body, least = float(safety_distance[group].min()) - problem.margin, float(safety_distance[group].min())
            by_steps = least - travel[group].max() / 2
            kept, away = (by_steps, travel[group].max()) if by_steps > body else (body, 0.0)
            # Beyond the cells everything is connected.
            free = np.pad(clearance > kept - half - doubt, 1, constant_values=True)
            regions, _ = ndimage.label(free, np.ones((3,) * d))
            rooms, _ = ndimage.label(clearance > np.sqrt(safety_distance[group].max() ** 2 + cell * cell / 4))
            for robot in group.tolist():
                begin = _near(regions, low - cell, cell, starts[robot], away + half + doubt)
                end = _near(regions, low - cell, cell, goals[robot], problem.goal_radius + half + doubt)
                if not begin & end:
                    robots.append(robot)
                begin, end = (_near(rooms, low, cell, position[robot], 2 * half) for position in (starts, goals))
                are_open &= bool(begin & end)
        if robots or are_open:
            return sorted(robots)
        if clearance.size * 2**d > MAX_CELLS:
            break
    return []


def _cells(problem: Problem, positions: Floats, cell: float) -> tuple[Floats, float, Floats]:
    """The lowest corner of all cells, their size, larger where there would be too many, and the clearance of each.

    They cover the bounds and a rim, or in an open world obstacles and positions ``(P, d)``.
    """
    lower, upper = problem.world.bounds.astype(np.float64)
    if problem.world.lower is None:
        lower, upper = problem.world.shapes.extent()
        lower, upper = np.minimum(lower, positions.min(axis=0)), np.maximum(upper, positions.max(axis=0))
    while True:
        low, high = lower - 2 * cell, upper + 2 * cell
        size = np.ceil((high - low) / cell)
        if size.prod() <= MAX_CELLS:
            break
        cell *= 1.1
    centres = low + cell * (np.moveaxis(np.indices(size.astype(int)), 0, -1) + 0.5)
    return low, cell, problem.world.clearance(centres)


def _groups_by_size(safety_distance: Floats) -> Iterator[IntArray]:
    """Yield robots in groups of about the same safety distance, of ``(K,)`` [m]."""
    left = np.argsort(safety_distance, kind="stable")
    while len(left):
        alike = safety_distance[left] <= SIMILAR * safety_distance[left[0]]
        yield left[alike]
        left = left[~alike]


def _near(labels: NDArray[np.int32], low: Floats, cell: float, position: Floats, distance: float) -> set[int]:
    """Labels, but for zero, of the cells whose middle is within a distance of a position."""
    first = np.clip(np.floor((position - distance - low) / cell).astype(int), 0, labels.shape)
    last = np.clip(np.ceil((position + distance - low) / cell).astype(int), 0, labels.shape)
    part = labels[tuple(map(slice, first, last))]
    offset = cell * (np.moveaxis(np.indices(part.shape), 0, -1) + first + 0.5) + low - position
    return set(part[(offset * offset).sum(axis=-1) <= distance * distance].tolist()) - {0}
