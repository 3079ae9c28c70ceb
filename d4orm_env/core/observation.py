"""Observation of one robot: itself, its goal, its nearest neighbours and the nearest obstacles.

:func:`observe_robot` and :func:`observe_obstacles` are plain loops over small arrays, so that the CPU engine compiles
them as they stand.
All vectors are in the world's frame, relative to the robot, in SI units.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.geometry.world_index import WIDER, WorldIndex


class Sensed(NamedTuple):
    """Observable state of the robots, and scratch for the observation of one of them.

    Behind the ``K`` robots come ``N`` bodies that move among them and are none.
    """

    position: FloatArray  #: ``(K + N, d)``
    velocity: FloatArray  #: ``(K + N, d)``
    radius: FloatArray  #: ``(K + N,)``
    #: ``(K, 2 B)`` cosine and sine, zeros for models without a heading, and likewise of hitch angles with goals
    heading: FloatArray
    arrived: FloatArray  #: ``(K,)`` 0 or 1
    hidden: BoolArray  #: ``(K + N,)`` bool, those that the robot in question does not observe
    ray: FloatArray  #: ``(5, 1)`` scratch for a line of sight
    nearest_robots: FloatArray  #: ``(num_neighbors, 2)`` scratch: squared distance, robot
    nearest_obstacles: FloatArray  #: ``(num_obstacles, 2)`` scratch: distance of the surface, obstacle


def observe_robot(
    k: int, arrays: ProblemArrays, goal: FloatArray, sensed: Sensed, time_left: float | np.float32, out: FloatArray
) -> int:
    """Fill robot ``k``'s observation ``(D,)``, as :class:`~d4orm_env.core.observation_layout.ObservationSlices` says,
    up to the component that is returned, where obstacles begin.

    ``time_left`` is the share of the time left, 1 to 0.
    """
    d = goal.shape[1]
    neighbors = 2 * d + 8 + _see_goal_heading(k, arrays.goal_direction, sensed.heading, 2 * d + 8, out)
    _see_itself(k, arrays, goal, sensed, out)
    out[2 * d + 3] = time_left
    _find_nearest_robots(k, sensed.position, sensed.hidden, sensed.nearest_robots)
    _see_robots(k, sensed, neighbors, out)
    return neighbors + (2 + 2 * d) * sensed.nearest_robots.shape[0]


def observe_obstacles(k: int, arrays: ProblemArrays, sensed: Sensed, first: Whole, out: FloatArray) -> None:
    """Fill robot ``k``'s observation ``(D,)`` from component ``first`` on, where obstacles begin."""
    _find_nearest_obstacles(sensed.position[k], arrays, sensed.nearest_obstacles)
    _see_obstacles(sensed.position[k], arrays, arrays.wall_radius[k], sensed.nearest_obstacles, first, out)


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


def _see_goal_heading(k: int, directions: FloatArray | None, heading: FloatArray, i: int, out: FloatArray) -> int:
    """Fill the goal heading and hitch angles less the robot's own, from component ``i`` on, if any has one; return the
    number of components.
    """
    if directions is None:
        return 0
    for c in range(0, heading.shape[1], 2):
        cosine, sine = directions[k, c], directions[k, c + 1]
        out[i + c] = cosine * heading[k, c] + sine * heading[k, c + 1]
        out[i + c + 1] = sine * heading[k, c] - cosine * heading[k, c + 1]
    return heading.shape[1]


def _see_robots(k: int, sensed: Sensed, i: int, out: FloatArray) -> None:
    """Fill the rows of neighbours, from component ``i`` on."""
    d = sensed.position.shape[1]
    for row in range(sensed.nearest_robots.shape[0]):
        present = sensed.nearest_robots[row, 0] < np.inf
        other = int(sensed.nearest_robots[row, 1]) if present else k
        out[i] = 1 if present else 0
        for axis in range(d):
            out[i + 1 + axis] = sensed.position[other, axis] - sensed.position[k, axis]
            out[i + 1 + d + axis] = sensed.velocity[other, axis] - sensed.velocity[k, axis]
        out[i + 1 + 2 * d] = sensed.radius[other] if present else 0
        i += 2 + 2 * d


def _see_obstacles(
    position: FloatArray, arrays: ProblemArrays, radius: float, nearest: FloatArray, i: Whole, out: FloatArray
) -> None:
    """Fill the rows of obstacles, from component ``i`` on."""
    d = position.shape[0]
    for row in range(nearest.shape[0]):
        present = nearest[row, 0] < np.inf
        out[i] = 1 if present else 0
        out[i + 1 + d] = nearest[row, 0] - radius if present else 0
        for axis in range(d):
            out[i + 1 + axis] = 0
        if present:
            _point_to(int(nearest[row, 1]), position, arrays, out[i + 1 : i + 1 + d])
        i += 2 + d


def insert_nearest(key: float, number: float, table: FloatArray) -> None:
    """Put the row ``(key, number)`` where it belongs in a sorted table, whose last row drops out for it."""
    row = table.shape[0] - 1
    if row < 0 or not _comes_before(key, number, table[row]):
        return
    while row > 0 and _comes_before(key, number, table[row - 1]):
        table[row, 0], table[row, 1] = table[row - 1, 0], table[row - 1, 1]
        row -= 1
    table[row, 0], table[row, 1] = key, number


def _comes_before(key: float, number: float, row: FloatArray) -> bool:
    return key < row[0] or (key == row[0] and number < row[1])


def _find_nearest_robots(k: int, position: FloatArray, hidden: BoolArray, nearest: FloatArray) -> None:
    nearest[:, 0] = np.inf
    for other in range(position.shape[0]):
        if other != k and not hidden[other]:
            # Starting from the first axis and not from a literal keeps the sum in the caller's precision.
            gap = position[other, 0] - position[k, 0]
            gap2 = gap * gap
            for axis in range(1, position.shape[1]):
                gap = position[other, axis] - position[k, axis]
                gap2 += gap * gap
            insert_nearest(gap2, other, nearest)


def _find_nearest_obstacles(position: FloatArray, arrays: ProblemArrays, nearest: FloatArray) -> None:
    d = position.shape[0]
    if nearest.shape[0] == 0:
        return
    nearest[:, 0] = np.inf
    index, count = arrays.grid, arrays.boxes.shape[0] + arrays.triangles.shape[0]
    own = _list_of(position, index) if count > 0 and index.nearest >= nearest.shape[0] else -1
    begin, end = (index.first[own], index.first[own + 1]) if own >= 0 else (0, count)
    for number in range(begin, end):
        item = index.items[number] if own >= 0 else number
        if item < arrays.boxes.shape[0]:
            insert_nearest(_distance_to_box(position, arrays.boxes[item]) - arrays.boxes[item, 2 * d], item, nearest)
        else:
            gap = _gap_to_triangle(position, arrays.triangles[item - arrays.boxes.shape[0]])
            insert_nearest(gap[0], item, nearest)
    for axis in range(d):
        for side in range(2):
            beyond = arrays.bounds[side, axis] - position[axis]
            insert_nearest(-beyond if side == 0 else beyond, count + 2 * axis + side, nearest)


def _list_of(position: FloatArray, index: WorldIndex) -> int:
    """Number of the list of obstacles in the innermost grid that holds a position; -1 beyond them all."""
    width = 1.0
    for level in range(index.levels):
        cell, inside = 0, True
        for axis in range(position.shape[0]):
            middle = 0.5 * index.size[axis]
            step = ((position[axis] - index.low[axis]) * index.scale - middle) / width + middle
            inside &= (step >= 0) & (step < index.size[axis])
            cell = cell * index.size[axis] + int(step) if inside else 0
        if inside:
            return level * index.clearance.shape[0] + cell
        width *= WIDER
    return -1


def _point_to(item: int, position: FloatArray, arrays: ProblemArrays, out: FloatArray) -> None:
    """Fill the vector to the nearest point of an obstacle, or of a bound, which come last."""
    d, boxes, triangles = position.shape[0], arrays.boxes.shape[0], arrays.triangles.shape[0]
    if item < boxes:
        box = arrays.boxes[item]
        distance, radius = _distance_to_box(position, box), box[2 * d]
        # Inside a box, whose radius is zero, the vector is too.
        share = (distance - radius) / max(distance, 1e-6) if radius > 0 else 1.0
        for axis in range(d):
            out[axis] = (min(max(position[axis], box[axis]), box[d + axis]) - position[axis]) * share
    elif item < boxes + triangles:
        distance, out[0], out[1] = _gap_to_triangle(position, arrays.triangles[item - boxes])
    else:
        axis, side = (item - boxes - triangles) // 2, (item - boxes - triangles) % 2
        out[axis] = arrays.bounds[side, axis] - position[axis]


def _distance_to_box(position: FloatArray, box: FloatArray) -> float:
    """Distance to the box that is rounded off."""
    d = position.shape[0]
    gap = min(max(position[0], box[0]), box[d]) - position[0]
    distance2 = gap * gap
    for axis in range(1, d):
        gap = min(max(position[axis], box[axis]), box[d + axis]) - position[axis]
        distance2 += gap * gap
    return np.sqrt(distance2)


def _gap_to_triangle(position: FloatArray, corners: FloatArray) -> tuple[float, float, float]:
    """Distance of a triangle and the vector to its nearest point, zero inside."""
    inside, nearest_x, nearest_y, least = True, 0.0, 0.0, np.inf
    for edge in range(3):
        after = (edge + 1) % 3
        along_x, along_y = corners[2 * after] - corners[2 * edge], corners[2 * after + 1] - corners[2 * edge + 1]
        offset_x, offset_y = position[0] - corners[2 * edge], position[1] - corners[2 * edge + 1]
        inside &= along_x * offset_y - along_y * offset_x >= 0
        share = (offset_x * along_x + offset_y * along_y) / (along_x * along_x + along_y * along_y)
        share = min(max(share, 0.0), 1.0)
        gap_x, gap_y = share * along_x - offset_x, share * along_y - offset_y
        if gap_x * gap_x + gap_y * gap_y < least:
            least, nearest_x, nearest_y = gap_x * gap_x + gap_y * gap_y, gap_x, gap_y
    return (0.0, 0.0, 0.0) if inside else (np.sqrt(least), nearest_x, nearest_y)
