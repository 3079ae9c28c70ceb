"""Checks of robots' paths without looking at the others, compiled with numba."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import FloatArray, IntArray, Ints
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS, inlined
from d4orm_env.engine.obstacles import is_closed, touches_static
from d4orm_env.engine.threads import Threads, available_cores

_DOUBT, _ROUNDING = 1 / 750, 64 * 2.0**-23
"""Distance from the goal radius within which rounding may decide, as a share of it and as a share of the coordinates:
farther than :mod:`d4orm_env.verify.docking` has it."""


def check_alone(arrays: ProblemArrays, robots: ArrayLike, states: FloatArray) -> NDArray[np.int32]:
    """Check some robots' paths without looking at the others.

    Args:
        arrays: The problem.
        robots: ``(R,)``.
        states: ``(R, V, H+1, n)`` states, or just places.

    Returns:
        ``(3, R, V)`` steps: the first after the start within the margin of an obstacle or the bounds; the last that
        moves the robot; and the first at which rounding decides whether it is at its goal. ``H+1`` where there is none.
    """
    index, paths = np.asarray(robots, np.int64), np.ascontiguousarray(states, np.float32)
    steps = np.empty((3, *paths.shape[:2]), np.int32)
    Threads(available_cores()).over(len(index), lambda part: _check_alone(arrays, index, paths, part, steps))
    return steps


@cached_kernel(**WITHOUT_ARRAYS)
def _check_alone(
    arrays: ProblemArrays, robots: IntArray, paths: FloatArray, robot_range: IntArray, steps: Ints
) -> None:
    """See :func:`check_alone`."""
    arrays = borrow(arrays)
    dimension, closed, never = arrays.goal.shape[1], is_closed(arrays), paths.shape[2]
    for r in range(robot_range[0], robot_range[1]):
        reach, goal = arrays.radius[robots[r]] + arrays.margin, arrays.goal[robots[r]]
        for v in range(paths.shape[1]):
            path, last, touching, unsure = paths[r, v], never - 1, never, never
            while last > 0 and _is_same_place(path, dimension, last):
                last -= 1
            # Where it stands from then on it is no nearer to anything.
            for t in range(max(last, 1), 0, -1):
                if closed and touches_static(arrays, reach, path[t, :dimension]):
                    touching = t
                if is_unsure(arrays, path[t], goal):
                    unsure = t
            steps[0, r, v], steps[1, r, v], steps[2, r, v] = touching, last, unsure


@inlined
def _is_same_place(path: FloatArray, dimension: int, t: int) -> bool:
    same = True
    for axis in range(dimension):
        same &= path[t, axis] == path[t - 1, axis]
    return same


@inlined
def is_unsure(arrays: ProblemArrays, place: FloatArray, goal: FloatArray) -> bool:
    """Check whether rounding may decide, here or where the plan is judged, if a robot at this place is at its goal."""
    gap2, extent = 0.0, 0.0
    for axis in range(goal.shape[0]):
        gap = np.float64(place[axis]) - np.float64(goal[axis])
        gap2 += gap * gap
        extent = max(extent, abs(np.float64(place[axis])))
    goal_radius = np.sqrt(np.float64(arrays.squared_goal_radius))
    return abs(np.sqrt(gap2) - goal_radius) < _DOUBT * goal_radius + _ROUNDING * extent
