"""New paths for some robots of a team with ever new goals, among all others on their present paths."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_planners.mapf.planner import compile_path_finding
from d4orm_planners.mapf.roadmap import lay_roadmap
from d4orm_planners.mapf.roadmap_team import FAR, Replanning, TeamRollout

FINENESS = 1.6
"""Fineness of the roadmap."""
DWELL = 1.0
"""Time for which others keep off the goal of a robot that has arrived; by then it drives on to another [s]."""


def relay_paths(problem: Problem, paths: FloatArray, changed: BoolArray, seed: int) -> FloatArray | None:
    """Plan the paths of some robots around all others, which yield only where there is no other one.

    Args:
        problem: The team where it is now, and its goals.
        paths: ``(T + 1, K, d)`` positions of the robots from now on [m]; those of ``changed`` are not read.
        changed: ``(K,)`` robots whose paths are planned.
        seed: Of the robots that may have to yield, and of how leisurely they drive.

    Returns:
        ``(H + 1, K, d)`` future positions of all robots [m]; ``None`` if no paths were found.
    """
    compile_path_finding(problem)
    num_robots, d = problem.num_robots, problem.dimension
    dwell = int(np.ceil(DWELL / problem.dt))
    replanning = Replanning(problem, lay_roadmap(problem, FINENESS), dwell)
    if not np.isfinite(replanning.alone).all():
        return None
    result = paths[np.minimum(np.arange(problem.horizon + 1), len(paths) - 1)]
    present = _driven(problem, result, dwell)
    present.positions[:, changed] = FAR
    before, random, robots = present.positions.copy(), np.random.default_rng(seed), np.flatnonzero(changed)
    order = robots[np.argsort(replanning.alone[robots] + random.random(len(robots)))]
    driven = replanning.settle(present, order, random, lambda: False, num_robots)
    if driven is None:
        return None
    for robot in np.flatnonzero((driven.positions != before).any(axis=(0, 2))):
        end = int(driven.arrivals[robot]) + 1
        result[:end, robot], result[end:, robot] = driven.positions[:end, robot, :d], problem.goal[robot]
    return result


def _driven(problem: Problem, paths: FloatArray, dwell: int) -> TeamRollout:
    """A team on its paths ``(H + 1, K, d)``, whose robots leave their goals again; its controls are not known."""
    steps, num_robots, d = problem.horizon, problem.num_robots, problem.dimension
    at_goal = np.linalg.norm(paths - problem.goal, axis=2) <= problem.goal_radius
    arrivals = np.where(at_goal.any(axis=0), at_goal.argmax(axis=0), steps)
    positions = np.zeros((steps + 1, num_robots, 3))
    positions[:, :, :d] = paths
    positions[np.arange(steps + 1)[:, None] > arrivals + dwell] = FAR
    return TeamRollout(np.zeros((steps, num_robots, problem.control_size), np.float32), positions, arrivals)
