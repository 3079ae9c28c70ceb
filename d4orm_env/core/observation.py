"""What one robot sees of the world: itself, its goal, its nearest neighbours and the nearest obstacles.

:func:`observe_robot` is written with plain loops over small arrays, so that the CPU engine compiles it as it stands.
All vectors are in the world's frame, relative to the robot, in SI units.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem_arrays import ProblemArrays


class Sensed(NamedTuple):
    """What there is to see of the robots, and scratch for what one of them sees.

    Attributes:
        position: ``(K, d)``.
        velocity: ``(K, d)``.
        heading: ``(K, 2)`` cosine and sine, zeros for models without a heading.
        arrived: ``(K,)`` 0 or 1.
        nearest_robots: ``(num_neighbors, 2)`` scratch: squared distance, robot.
        nearest_obstacles: ``(num_obstacles, 1 + d)`` scratch: distance of the surface, vector to it.
    """

    position: FloatArray
    velocity: FloatArray
    heading: FloatArray
    arrived: FloatArray
    nearest_robots: FloatArray
    nearest_obstacles: FloatArray


def observe_robot(
    k: int, arrays: ProblemArrays, goal: FloatArray, sensed: Sensed, time_left: float, out: FloatArray
) -> None:
    """Fill one robot's observation.

    Args:
        k: Robot.
        arrays: The problem.
        goal: ``(K, d)``.
        sensed: What there is to see.
        time_left: Share of the time left, 1 to 0.
        out: ``(D,)``, filled as :class:`~d4orm_env.core.observation_layout.ObservationSlices` says.
    """
    d = goal.shape[1]
    neighbors = 2 * d + 8
    obstacles = neighbors + (2 + 2 * d) * sensed.nearest_robots.shape[0]
    _see_itself(k, arrays, goal, sensed, out)
    out[2 * d + 3] = time_left
    _find_nearest_robots(k, sensed.position, sensed.nearest_robots)
    _see_robots(k, arrays.radius, sensed, neighbors, out)
    _find_nearest_obstacles(sensed.position[k], arrays, sensed.nearest_obstacles)
    _see_obstacles(arrays.radius[k], sensed.nearest_obstacles, obstacles, out)


def _see_itself(k: int, arrays: ProblemArrays, goal: FloatArray, sensed: Sensed, out: FloatArray) -> None:
    d = goal.shape[1]
    speed2 = sensed.velocity[k, 0] * sensed.velocity[k, 0]
    for axis in range(1, d):
        speed2 += sensed.velocity[k, axis] * sensed.velocity[k, axis]
    for axis in range(d):
        out[axis] = sensed.velocity[k, axis]
        out[d + 3 + axis] = goal[k, axis] - sensed.position[k, axis]
    out[d] = sensed.heading[k, 0]
    out[d + 1] = sensed.heading[k, 1]
    out[d + 2] = np.sqrt(speed2)
    out[2 * d + 4] = sensed.arrived[k]
    out[2 * d + 5] = arrays.radius[k]
    out[2 * d + 6] = arrays.limits[k, 0]
    out[2 * d + 7] = arrays.limits[k, 1]


def _see_robots(k: int, radius: FloatArray, sensed: Sensed, i: int, out: FloatArray) -> None:
    """Fill the rows of neighbours, from component ``i`` on."""
    d = sensed.position.shape[1]
    for row in range(sensed.nearest_robots.shape[0]):
        present = sensed.nearest_robots[row, 0] < np.inf
        other = int(sensed.nearest_robots[row, 1]) if present else k
        out[i] = 1 if present else 0
        for axis in range(d):
            out[i + 1 + axis] = sensed.position[other, axis] - sensed.position[k, axis]
            out[i + 1 + d + axis] = sensed.velocity[other, axis] - sensed.velocity[k, axis]
        out[i + 1 + 2 * d] = radius[other] if present else 0
        i += 2 + 2 * d


def _see_obstacles(radius: float, nearest: FloatArray, i: int, out: FloatArray) -> None:
    """Fill the rows of obstacles, from component ``i`` on."""
    d = nearest.shape[1] - 1
    for row in range(nearest.shape[0]):
        present = nearest[row, 0] < np.inf
        out[i] = 1 if present else 0
        for axis in range(d):
            out[i + 1 + axis] = nearest[row, 1 + axis] if present else 0
        out[i + 1 + d] = nearest[row, 0] - radius if present else 0
        i += 2 + d


def insert_nearest(key: float, table: FloatArray) -> int:
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


def _find_nearest_robots(k: int, position: FloatArray, nearest: FloatArray) -> None:
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


def _find_nearest_obstacles(place: FloatArray, arrays: ProblemArrays, nearest: FloatArray) -> None:
    d = place.shape[0]
    if nearest.shape[0] == 0:
        return
    nearest[:, 0] = np.inf
    index, count = arrays.grid, arrays.boxes.shape[0] + arrays.triangles.shape[0]
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


def _insert_box(place: FloatArray, box: FloatArray, nearest: FloatArray) -> None:
    d = place.shape[0]
    gap = min(max(place[0], box[0]), box[d]) - place[0]
    distance2 = gap * gap
    for axis in range(1, d):
        gap = min(max(place[axis], box[axis]), box[d + axis]) - place[axis]
        distance2 += gap * gap
    radius, farthest = box[2 * d], nearest[nearest.shape[0] - 1, 0]
    if distance2 > (farthest + radius) * (farthest + radius) and farthest > 0:
        return  # for less than a square root
    distance = np.sqrt(distance2)
    row = insert_nearest(distance - radius, nearest)
    if row >= 0:
        # Inside a box, whose radius is zero, the vector is too.
        share = (distance - radius) / max(distance, 1e-6) if radius > 0 else 1.0
        for axis in range(d):
            nearest[row, 1 + axis] = (min(max(place[axis], box[axis]), box[d + axis]) - place[axis]) * share


def _insert_triangle(place: FloatArray, corners: FloatArray, nearest: FloatArray) -> None:
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
