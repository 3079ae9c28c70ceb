"""What a robot's way costs among the others' ways, counted in conflicts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_planners.d4orm_d.settings import RULES
from d4orm_planners.steering import Drives

Costs = NDArray[np.float64]


def path_costs(
    problem: Problem, robots: Sequence[int], paths: FloatArray, near: BoolArray, arrived: BoolArray
) -> Costs:
    """``(R,)`` conflicts of robots, with those added that a missed goal and contact with an obstacle amount to.

    Args:
        problem: The whole team's.
        robots: The ``R`` robots.
        paths: ``(H+1, R, d)`` theirs [m].
        near: ``(R, K)`` who comes within the margin of whom.
        arrived: ``(R,)``.
    """
    costs: Costs = near.sum(axis=1) + RULES.missing_cost * (~arrived | _touches_obstacle(problem, robots, paths))
    return costs


def way_costs(problem: Problem, robot: int, ways: Drives, paths: FloatArray) -> Costs:
    """``(V,)`` costs of ways ``(H+1, V, d)`` of a robot among others on ``paths`` ``(H+1, K, d)``, sooner ones less."""
    moves = (ways.positions[1:] != ways.positions[:-1]).any(axis=2)
    last_move = problem.horizon - moves[::-1].argmax(axis=0)
    blocked = _touches_obstacle(problem, [robot], ways.positions[:, None])[0]
    conflicts = _num_conflicts(problem, robot, ways.positions, paths)
    costs: Costs = (
        conflicts + RULES.missing_cost * (~ways.arrived | blocked) + RULES.time_cost * last_move / problem.horizon
    )
    return costs


def _touches_obstacle(problem: Problem, robots: Sequence[int], paths: FloatArray) -> BoolArray:
    """``(R, ...)`` which robots come within the margin of an obstacle on paths ``(H+1, R, ..., d)``."""
    reach = np.asarray(problem.team.radius)[robots] + problem.margin
    clearance = problem.world.clearance(paths[1:].reshape(-1, paths.shape[-1])).reshape(len(paths) - 1, len(robots), -1)
    touching = np.any(clearance <= reach[:, None], axis=0)
    return touching.reshape(paths.shape[1:-1])


def _num_conflicts(problem: Problem, robot: int, ways: FloatArray, paths: FloatArray) -> IntArray:
    """``(V,)`` robots on ``paths`` ``(H+1, K, d)`` in conflict with each of a robot's ``ways`` ``(H+1, V, d)``."""
    radius = np.asarray(problem.team.radius, np.float32)
    reach2 = (radius + radius[robot] + np.float32(problem.margin)) ** 2
    gap2 = sum((paths[1:, :, None, axis] - ways[1:, None, :, axis]) ** 2 for axis in range(paths.shape[2]))
    near = (gap2 <= reach2[:, None]).any(axis=0)
    near[robot] = False
    return near.sum(axis=0)
