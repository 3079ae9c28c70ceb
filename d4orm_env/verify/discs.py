"""Discs and balls against the obstacles of a world, kind by kind, and its bounds; motion that is given as curves."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.verify.contact import MAX_NUMBERS, Indices, Pairs, StaticDiscs, Stretch, Watch, side_names
from d4orm_env.verify.geometry import (
    Floats,
    box_approach,
    box_distance,
    closest_approach,
    norm,
    polygon_approach,
    polygon_distance,
)
from d4orm_env.verify.report import VerificationReport, Violation

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem
    from d4orm_env.core.world import World


class Round(StaticDiscs):
    """Robots against circles, spheres or vertical cylinders."""

    def __init__(self, robot: Indices, radius: Floats, obstacles: Floats, shape: str) -> None:
        super().__init__("obstacle contact", robot, radius, [f"{shape}[{index}]" for index in range(len(obstacles))])
        self._centres, self._sizes = obstacles[:, :-1], obstacles[:, -1]

    def distance(self, positions: Floats, columns: Indices) -> Floats:
        return norm(self._offset(positions, columns)) - self._sizes[columns]

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        distance, fraction = closest_approach(self._offset(start, columns), self._offset(end, columns))
        return distance - self._sizes[columns], fraction

    def _offset(self, positions: Floats, columns: Indices) -> Floats:
        # A cylinder is a circle seen from above.
        return positions[..., : self._centres.shape[1]] - self._centres[columns]


class Boxes(StaticDiscs):
    """Robots against axis-aligned boxes."""

    def __init__(self, robot: Indices, radius: Floats, boxes: Floats) -> None:
        super().__init__("obstacle contact", robot, radius, [f"boxes[{index}]" for index in range(len(boxes))])
        self._boxes = boxes

    def distance(self, positions: Floats, columns: Indices) -> Floats:
        return box_distance(positions, self._boxes[columns])

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        return box_approach(start, end, self._boxes[columns])


class PolygonObstacle(StaticDiscs):
    """Robots against one polygon."""

    def __init__(self, robot: Indices, radius: Floats, corners: Floats, name: str) -> None:
        super().__init__("obstacle contact", robot, radius, [name])
        self._corners = corners

    def distance(self, positions: Floats, columns: Indices) -> Floats:
        return polygon_distance(positions, self._corners)

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        return polygon_approach(start, end, self._corners)


class Bounds(StaticDiscs):
    """Robots against the sides of the world."""

    def __init__(self, robot: Indices, radius: Floats, lower: Floats, upper: Floats) -> None:
        super().__init__("bounds contact", robot, radius, side_names(len(lower)))
        self._axis, self._sign = np.tile(np.arange(len(lower)), 2), np.repeat([1.0, -1.0], len(lower))
        self._position = np.concatenate([lower, -upper])

    def distance(self, positions: Floats, columns: Indices) -> Floats:
        axis = np.broadcast_to(self._axis[columns], positions.shape[:-1])
        value = np.take_along_axis(positions, axis[..., None], axis=-1)[..., 0]
        return self._sign[columns] * value - self._position[columns]

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        before, after = self.distance(start, columns), self.distance(end, columns)
        return np.minimum(before, after), (after < before).astype(np.float64)


def surroundings(world: World, robot: Indices, radius: Floats) -> list[Watch]:
    """Return a watch for each kind of obstacle there is, and for the bounds."""
    watches: list[Watch] = []
    for shape in ("circles", "spheres", "cylinders"):
        obstacles = np.asarray(getattr(world, shape), np.float64)
        if len(obstacles):
            watches.append(Round(robot, radius, obstacles, shape))
    if len(world.boxes):
        watches.append(Boxes(robot, radius, np.asarray(world.boxes, np.float64)))
    for index, corners in enumerate(world.polygons):
        watches.append(PolygonObstacle(robot, radius, np.asarray(corners, np.float64), f"polygons[{index}]"))
    if world.lower is not None:
        lower, upper = (np.asarray(bound, np.float64) for bound in (world.lower, world.upper))
        watches.append(Bounds(robot, radius, lower, upper))
    return watches


CHORD_ERROR = 1 / 15_000
"""Largest distance between a curve and the chord that stands for it, as a share of the robot's radius."""


def verify_curves(
    problem: Problem, position: Callable[[Floats], Floats], duration: float, bend: Floats
) -> VerificationReport:
    """Judge curves: do all robots end at their goals, and touch nothing at any time?

    As :func:`d4orm_env.verify.verify` judges controls, known to ``CHORD_ERROR`` of the radius for each robot. Curves
    have no headings: a footprint counts as the disc or ball round it, which may refuse what is fine. Of
    control limits it says nothing, nor when robots arrive.

    Args:
        problem: The team and its world; its dynamics do not count.
        position: ``(T,)`` times from 0 to ``duration`` [s] to ``(T, K, d)`` positions [m].
        duration: When the motion ends [s].
        bend: ``(K,)`` bound on the robots' acceleration [m/s^2].
    """
    radius = problem.team.radius.astype(np.float64)
    steps = max(1, int(np.ceil(duration / problem.dt)))
    dt = duration / steps
    sub_steps = max(1, int(np.ceil(dt * np.sqrt(bend / (8 * CHORD_ERROR * radius))).max()))
    robots = np.arange(len(radius))
    pairs = Pairs(robots, radius)
    obstacles = surroundings(problem.world, robots, radius)
    watches: list[Watch] = [pairs, *obstacles]
    size = max(1, MAX_NUMBERS // ((2 * sub_steps + 1) * len(radius) * problem.dimension))
    for first in range(0, steps, size):
        begins = np.arange(first, min(first + size, steps)) * dt
        times = begins[:, None] + np.linspace(0, dt, sub_steps + 1)
        path = position(times.ravel()).reshape(*times.shape, len(radius), problem.dimension)
        travel = norm(path - path[:, :1]).max(axis=1)
        for watch in watches:
            watch.observe(Stretch(path, travel, first * dt, dt, np.zeros((0, 0, 0))))
    violations = [violation for watch in watches for violation in watch.violations()]
    violations += _not_arrived(problem, position, duration)
    nearest = min((watch.minimum for watch in obstacles), default=np.inf)
    unknown = np.full(len(radius), np.nan)
    return VerificationReport(
        pairs.minimum, nearest, unknown, unknown, True, sorted(violations, key=lambda violation: violation.time)
    )


def _not_arrived(problem: Problem, position: Callable[[Floats], Floats], duration: float) -> list[Violation]:
    distance = norm(position(np.array([duration]))[0] - problem.goal.astype(np.float64))
    return [
        Violation(
            "not arrived", (robot,), duration,
            f"{distance[robot]:.4g} m from its goal (goal radius {problem.goal_radius:g} m) at the end",
        )
        for robot in np.flatnonzero(distance > problem.goal_radius * (1 + CHORD_ERROR)).tolist()
    ]  # fmt: skip
