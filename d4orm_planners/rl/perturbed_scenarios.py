"""Scenarios to train on: those whose symmetry or fixed positions should not be learned by heart, made irregular."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.scenarios import make_problem

_TRIES = 200
_ROOM = 1.1  #: Over the least distance between the centres of two robots that keeps the margin


def perturbed(
    seed: int, num_robots: int, *, base: str = "circle", shift: float = 0.3, shrink: float = 0.2, **settings: Any
) -> Problem:
    """Another scenario in the plane, ``base``, turned and shrunk at random, every start and goal moved a little.

    Obstacles stay where they are; a scenario with some must leave the room that starts and goals are moved in: on
    either axis by ``shift`` at most [m], less where robots would be too close. Up to a share ``shrink`` is taken off
    distances from the origin.
    """
    random = np.random.default_rng(seed)
    problem = make_problem(base, num_robots=num_robots, **settings)
    angle, scale = random.uniform(-np.pi, np.pi), 1 - random.uniform(0, shrink)
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    least = _least_distance(problem)
    start = problem.start.copy()
    start[:, :2] = _shifted(problem.start[:, :2] @ turn.T, shift, least, random)
    goal = _shifted(problem.goal[:, :2] @ turn.T, shift, least, random)
    return problem.replace(start=start, goal=goal)


def clutter(
    seed: int, num_robots: int, *, positions: int = 0, obstacles: int = 6, size: float = 5.0, **settings: Any
) -> Problem:
    """Random starts and goals in a square with round obstacles, which ``positions`` seeds: they are the same for every
    seed.

    Raises ValueError if the robots do not fit.
    """
    problem = make_problem("random", num_robots=num_robots, size=size, **settings)
    fixed = np.random.default_rng(positions)
    circles = np.column_stack(
        [fixed.uniform(-0.4 * size, 0.4 * size, (obstacles, 2)), fixed.uniform(0.1, 0.3, obstacles)]
    )
    random, least = np.random.default_rng(seed), _least_distance(problem)
    start = problem.start.copy()
    start[:, :2] = _scattered(num_robots, size, least, circles, random)
    goal = _scattered(num_robots, size, least, circles, random)
    return problem.replace(start=start, goal=goal, world=World(circles=circles))


def _least_distance(problem: Problem) -> float:
    """Between the centres of two robots at rest [m]."""
    return _ROOM * (2 * float(problem.team.radius.max()) + problem.margin)


def _shifted(
    points: NDArray[np.floating], shift: float, least: float, random: np.random.Generator
) -> NDArray[np.floating]:
    """Points moved at random, by less from try to try until none are too close, and in the end not at all."""
    for tries in range(_TRIES):
        moved = points + random.uniform(-1, 1, points.shape) * shift * (1 - tries / _TRIES)
        gaps = np.linalg.norm(moved[:, None] - moved, axis=2) + np.diag(np.full(len(points), np.inf))
        if gaps.min() >= least:
            return moved
    return points


def _scattered(
    count: int, size: float, least: float, circles: NDArray[np.floating], random: np.random.Generator
) -> NDArray[np.floating]:
    """Random points that are apart from each other and from circles."""
    points: list[NDArray[np.floating]] = []
    for _ in range(_TRIES * count):
        point = random.uniform(-size / 2, size / 2, 2)
        free = np.linalg.norm(circles[:, :2] - point, axis=1) - circles[:, 2] >= 0.75 * least
        if free.all() and all(np.linalg.norm(point - other) >= least for other in points):
            points.append(point)
            if len(points) == count:
                return np.array(points)
    raise ValueError(f"num_robots is {count}; so many do not fit on a size of {size:g} m among the obstacles")
