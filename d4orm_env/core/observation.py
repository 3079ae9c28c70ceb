"""What one robot sees of the world: itself, its goal, its nearest neighbours and the nearest obstacles.

:func:`observe_robot` is written with plain loops over small arrays, so that the CPU engine compiles it as it stands.
All vectors are in the world's frame, relative to the robot, in SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray, whole_number
from d4orm_env.core.problem import Problem


@dataclass(frozen=True, eq=False)
class ObservationLayout:
    """The components of one robot's observation and the finite bounds they stay in.

    In order, with ``d`` position dimensions: own velocity (``d``); heading as cosine and sine, both zero for a model
    without one; speed; vector to the goal (``d``); share of the time that is left; whether arrived; own radius, speed
    limit and acceleration limit. For each of the nearest ``num_neighbors`` robots: presence flag, relative position
    (``d``), relative velocity (``d``), radius. For each of the nearest ``num_obstacles`` obstacles, walls of the bounds
    included: presence flag, vector to the nearest point of its surface (``d``), gap between the two surfaces.
    Absent neighbours and obstacles are all zeros.

    Attributes:
        dimension: ``d``.
        num_neighbors: Neighbours listed, nearest first.
        num_obstacles: Obstacles listed, nearest first.
        low: ``(size,)`` float32 lower bounds.
        high: ``(size,)`` float32 upper bounds.
    """

    dimension: int
    num_neighbors: int
    num_obstacles: int
    low: FloatArray
    high: FloatArray

    @classmethod
    def for_problem(cls, problem: Problem, num_neighbors: int = 4, num_obstacles: int = 4) -> ObservationLayout:
        """The layout for a problem, with bounds that no motion of its robots can leave.

        Raises:
            ValueError: If a number of neighbours or obstacles is negative or not whole.
        """
        whole_number(num_neighbors, "num_neighbors", 0)
        whole_number(num_obstacles, "num_obstacles", 0)
        d = problem.dimension
        speed = float(np.max(problem.team.max_speed))
        radius = float(np.max(problem.team.radius))
        places = np.concatenate([problem.start[:, :d], problem.goal, *_corners(problem)])
        acceleration = float(np.max(problem.team.max_acceleration))
        # Nobody gets further than the widest distance between places, plus a full-speed drive from either end. Within a
        # step a robot may exceed the speed limit, which is applied at its end.
        drive = (speed + acceleration * problem.dt / 2) * problem.duration
        reach = float(np.sqrt(np.square(np.ptp(places, axis=0)).sum())) + 2 * drive + 2 * radius
        own = [speed] * d + [1.0, 1.0, speed] + [reach] * d
        own += [1.0, 1.0, radius, speed, acceleration]
        neighbor = [1.0] + [reach] * d + [2 * speed] * d + [radius]
        obstacle = [1.0] + [reach] * d + [reach]
        high = np.array(own + neighbor * num_neighbors + obstacle * num_obstacles, np.float32)
        low = -high
        flags = [2 * d + 3, 2 * d + 4]
        flags += [len(own) + i * len(neighbor) for i in range(num_neighbors)]
        flags += [len(own) + num_neighbors * len(neighbor) + i * len(obstacle) for i in range(num_obstacles)]
        low[flags] = 0
        for bound in (low, high):
            bound.setflags(write=False)
        return cls(d, num_neighbors, num_obstacles, low, high)

    @property
    def size(self) -> int:
        """Number of components ``D``."""
        return len(self.low)

    @cached_property
    def bounds(self) -> FloatArray:
        """``(2, D)`` lower and upper bounds in one array, read-only."""
        bounds: FloatArray = np.stack([self.low, self.high])
        bounds.setflags(write=False)
        return bounds

    @property
    def names(self) -> tuple[str, ...]:
        """One name per component, as ``neighbor_0.velocity_y``."""
        axes = "xyz"[: self.dimension]
        names = [f"velocity_{axis}" for axis in axes] + ["heading_cos", "heading_sin", "speed"]
        names += [f"goal_{axis}" for axis in axes] + ["time_left", "arrived", "radius", "max_speed", "max_acceleration"]
        for i in range(self.num_neighbors):
            parts = [
                "present",
                *(f"position_{axis}" for axis in axes),
                *(f"velocity_{axis}" for axis in axes),
                "radius",
            ]
            names += [f"neighbor_{i}.{part}" for part in parts]
        for i in range(self.num_obstacles):
            names += [f"obstacle_{i}.{part}" for part in ("present", *(f"position_{axis}" for axis in axes), "gap")]
        return tuple(names)


def _corners(problem: Problem) -> list[Any]:
    """Extreme points of the world's obstacles and bounds, to bound distances to them."""
    world, d = problem.world, problem.dimension
    corners = [world.balls[:, :d] + sign * world.balls[:, d:] for sign in (-1, 1)]
    corners += [world.boxes[:, :d], world.boxes[:, d:], *world.polygons]
    if len(world.cylinders):
        xy = np.concatenate([world.cylinders[:, :2] + sign * world.cylinders[:, 2:] for sign in (-1, 1)])
        corners.append(np.concatenate([xy, np.zeros((len(xy), 1))], axis=1))
    if world.lower is not None:
        corners.append(world.bounds)
    return corners


def observe_robot(
    k: Any,
    arrays: Any,
    goal: Any,
    position: Any,
    velocity: Any,
    heading: Any,
    arrived: Any,
    time_left: Any,
    nearest_robots: Any,
    nearest_obstacles: Any,
    out: Any,
) -> None:
    """Fill one robot's observation.

    Args:
        k: Robot.
        arrays: The problem's :class:`~d4orm_env.core.problem.ProblemArrays`.
        goal: ``(K, d)``.
        position: ``(K, d)``.
        velocity: ``(K, d)``.
        heading: ``(K, 2)`` cosine and sine, zeros for models without a heading.
        arrived: ``(K,)`` 0 or 1.
        time_left: Share of the time left, 1 to 0.
        nearest_robots: ``(num_neighbors, 2)`` scratch.
        nearest_obstacles: ``(num_obstacles, 1 + d)`` scratch.
        out: ``(D,)``, filled in the order of :class:`ObservationLayout`.
    """
    d = goal.shape[1]
    speed2 = velocity[k, 0] * velocity[k, 0]
    for axis in range(1, d):
        speed2 += velocity[k, axis] * velocity[k, axis]
    i = 0
    for axis in range(d):
        out[i + axis] = velocity[k, axis]
        out[i + d + 3 + axis] = goal[k, axis] - position[k, axis]
    out[d] = heading[k, 0]
    out[d + 1] = heading[k, 1]
    out[d + 2] = np.sqrt(speed2)
    i = 2 * d + 3
    out[i] = time_left
    out[i + 1] = arrived[k]
    out[i + 2] = arrays.radius[k]
    out[i + 3] = arrays.limits[k, 0]
    out[i + 4] = arrays.limits[k, 1]
    i += 5
    _find_nearest_robots(k, position, nearest_robots)
    for row in range(nearest_robots.shape[0]):
        present = nearest_robots[row, 0] < np.inf
        other = int(nearest_robots[row, 1]) if present else k
        out[i] = 1 if present else 0
        for axis in range(d):
            out[i + 1 + axis] = position[other, axis] - position[k, axis]
            out[i + 1 + d + axis] = velocity[other, axis] - velocity[k, axis]
        out[i + 1 + 2 * d] = arrays.radius[other] if present else 0
        i += 2 + 2 * d
    _find_nearest_obstacles(position[k], arrays, nearest_obstacles)
    for row in range(nearest_obstacles.shape[0]):
        present = nearest_obstacles[row, 0] < np.inf
        out[i] = 1 if present else 0
        for axis in range(d):
            out[i + 1 + axis] = nearest_obstacles[row, 1 + axis] if present else 0
        out[i + 1 + d] = nearest_obstacles[row, 0] - arrays.radius[k] if present else 0
        i += 2 + d


def insert_nearest(key: Any, table: Any) -> Any:
    """Row of a table sorted by its first column where ``key`` belongs, made free; -1 if it is too large for it."""
    row = table.shape[0] - 1
    if row < 0 or key >= table[row, 0]:
        return -1
    while row > 0 and key < table[row - 1, 0]:
        for column in range(table.shape[1]):
            table[row, column] = table[row - 1, column]
        row -= 1
    table[row, 0] = key
    return row


def _find_nearest_robots(k: Any, position: Any, nearest: Any) -> None:
    nearest[:, 0] = np.inf
    for other in range(position.shape[0]):
        if other != k:
            # Starting from the first axis and not from a literal keeps the sum in the caller's precision.
            gap = position[other, 0] - position[k, 0]
            gap2 = gap * gap
            for axis in range(1, position.shape[1]):
                gap = position[other, axis] - position[k, axis]
                gap2 += gap * gap
            row = insert_nearest(gap2, nearest)
            if row >= 0:
                nearest[row, 1] = other


def _find_nearest_obstacles(place: Any, arrays: Any, nearest: Any) -> None:
    d = place.shape[0]
    nearest[:, 0] = np.inf
    index, count = arrays.index, arrays.boxes.shape[0] + arrays.triangles.shape[0]
    begin, end, cell, listed = 0, count, 0, (count > 0) & (index.nearest >= nearest.shape[0])
    for axis in range(d):
        step = (place[axis] - index.low[axis]) * index.scale
        # Beyond the grid every obstacle may be among the nearest.
        listed &= (step >= 0) & (step < index.size[axis])
        cell = cell * index.size[axis] + int(step) if listed else 0
    if listed:
        begin, end = index.first[cell], index.first[cell + 1]
    for number in range(begin, end):
        item = index.items[number] if listed else number
        if item < arrays.boxes.shape[0]:
            _insert_box(place, arrays.boxes[item], nearest)
        else:
            _insert_triangle(place, arrays.triangles[item - arrays.boxes.shape[0]], nearest)
    for axis in range(d):
        for side in range(2):
            gap = arrays.bounds[side, axis] - place[axis]
            row = insert_nearest(-gap if side == 0 else gap, nearest)
            if row >= 0:
                nearest[row, 1:] = 0
                nearest[row, 1 + axis] = gap


def _insert_box(place: Any, box: Any, nearest: Any) -> None:
    d = place.shape[0]
    gap = min(max(place[0], box[0]), box[d]) - place[0]
    distance2 = gap * gap
    for axis in range(1, d):
        gap = min(max(place[axis], box[axis]), box[d + axis]) - place[axis]
        distance2 += gap * gap
    distance, radius = np.sqrt(distance2), box[2 * d]
    row = insert_nearest(distance - radius, nearest)
    if row >= 0:
        # Inside a box, whose radius is zero, the vector is too.
        share = (distance - radius) / max(distance, 1e-6) if radius > 0 else 1.0
        for axis in range(d):
            nearest[row, 1 + axis] = (min(max(place[axis], box[axis]), box[d + axis]) - place[axis]) * share


def _insert_triangle(place: Any, corners: Any, nearest: Any) -> None:
    inside, nearest_x, nearest_y, least = True, 0.0, 0.0, np.inf
    for edge in range(3):
        after = (edge + 1) % 3
        along_x, along_y = corners[2 * after] - corners[2 * edge], corners[2 * after + 1] - corners[2 * edge + 1]
        offset_x, offset_y = place[0] - corners[2 * edge], place[1] - corners[2 * edge + 1]
        inside &= along_x * offset_y - along_y * offset_x >= 0
        share = (offset_x * along_x + offset_y * along_y) / (along_x * along_x + along_y * along_y)
        share = min(max(share, 0.0), 1.0)
        gap_x, gap_y = share * along_x - offset_x, share * along_y - offset_y
        if gap_x * gap_x + gap_y * gap_y < least:
            least, nearest_x, nearest_y = gap_x * gap_x + gap_y * gap_y, gap_x, gap_y
    row = insert_nearest(0.0 if inside else np.sqrt(least), nearest)
    if row >= 0:
        nearest[row, 1] = 0.0 if inside else nearest_x
        nearest[row, 2] = 0.0 if inside else nearest_y
