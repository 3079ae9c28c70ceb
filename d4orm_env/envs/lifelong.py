"""Fresh goals for robots that never stop working."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, as_float32, frozen_array
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays, inverse_initial_distance
from d4orm_env.core.team import Team
from d4orm_env.dynamics.transition import arrives
from d4orm_env.engine.types import WorldBatch

GoalFunction: TypeAlias = Callable[[Problem, int, FloatArray, FloatArray, np.random.Generator], ArrayLike]
"""The next goal ``(d,)`` of a robot, from all that :func:`fresh_goal` is given, which draws one at random."""

_BATCH = 256
_ATTEMPTS = 20


def goal_region(problem: Problem) -> FloatArray:
    """``(2, d)`` the box that goals are drawn from [m]: the bounds, or in an open world where starts and goals lie.

    An open world's box is grown by twice the largest diameter and the margin, so that a team on a line has room.
    """
    if problem.world.lower is not None:
        return problem.world.bounds
    positions = np.concatenate([problem.start[:, : problem.dimension], problem.goal])
    room = 2 * (2 * float(np.max(problem.team.radius)) + problem.margin)
    return np.stack([positions.min(axis=0) - room, positions.max(axis=0) + room]).astype(np.float32)


def reached_goals(team: Team, arrays: ProblemArrays, states: FloatArray, controls: FloatArray) -> BoolArray:
    """``(K,)`` which robots in ``states`` ``(K, n)`` are within the goal radius of the goals in ``arrays``.

    That is at no more than the goal speed; that of first-order robots is read from ``controls`` ``(K, m)``.
    """
    offsets = arrays.goal - states[:, : arrays.goal.shape[1]]
    squared_speed = np.zeros(len(states), np.float32)
    if np.isfinite(arrays.squared_goal_speed).any():
        for robot, model in enumerate(team.robot_models):
            velocity = model.functions.velocity(states[robot], controls[robot], arrays.limits[robot], NUMPY_OPS)
            squared_speed[robot] = sum(component * component for component in velocity)
    return arrives(
        (offsets * offsets).sum(axis=1), squared_speed, arrays.squared_goal_radius, arrays.squared_goal_speed
    )


def assign_goals(
    problem: Problem, robots: NDArray[np.intp], world: WorldBatch, random: np.random.Generator, draw: GoalFunction
) -> None:
    """Give some robots of a batch of one world, which is changed, goals that ``draw`` says, and distances."""
    positions, goals = world.state[0, :, : problem.dimension], world.goal[0]
    for robot in robots.tolist():
        goals[robot] = draw(problem, robot, positions, goals, random)
    world.inverse[0, robots] = inverse_initial_distance(positions[robots], goals[robots], problem.goal_radius)
    offsets = goals[robots] - positions[robots]
    world.distance[0, robots] = np.sqrt(np.add.reduce(offsets * offsets, axis=1))


def given_goal(
    function: GoalFunction,
    problem: Problem,
    robot: int,
    positions: FloatArray,
    goals: FloatArray,
    random: np.random.Generator,
) -> FloatArray:
    """A goal ``(d,)`` that a function of a user's gives; ValueError unless it is a position of :func:`goal_region` with
    room.
    """
    name, given = f"the next goal of robot_{robot}", function(problem, robot, positions.copy(), goals.copy(), random)
    goal, (low, high) = frozen_array(given, name, (problem.dimension,)), goal_region(problem)
    if ((goal < low) | (goal > high)).any():
        raise ValueError(
            f"{name} is {goal.tolist()}; it must lie between {low.tolist()} and {high.tolist()}: give the world other "
            "bounds, which without them follow from starts and goals"
        )
    radius = float(problem.team.wall_radius[robot])
    if (clearance := float(problem.world.clearance(goal))) < radius:
        raise ValueError(
            f"{name} is {goal.tolist()}, where the clearance from obstacles and bounds is {clearance:.3g} m; it must "
            f"be at least the robot's radius of {radius:g} m"
        )
    return goal


def fresh_goal(
    problem: Problem, robot: int, positions: FloatArray, goals: FloatArray, random: np.random.Generator
) -> FloatArray:
    """A random goal ``(d,)`` where ``robot`` would keep the margin to every body, other goals, obstacles and bounds.

    It is uniform over the free part of :func:`goal_region`. Among obstacles it is one that has a free path to the
    robot's first goal, unless its start has none. Robots are at ``positions`` ``(K, d)``, and ``goals`` ``(K, d)`` are
    the present ones [m].
    """
    radius = np.asarray(problem.team.radius, np.float64)
    safety_distance = radius + radius[robot] + problem.margin
    others = np.arange(problem.num_robots) != robot
    bodies = np.concatenate([positions, goals[others]]).astype(np.float64)
    keep_off = np.concatenate([safety_distance, safety_distance[others]])
    keep_off[robot] = problem.goal_radius + radius[robot] + problem.margin
    low, high = goal_region(problem).astype(np.float64)
    for _ in range(_ATTEMPTS):
        candidates = random.uniform(low, high, (_BATCH, problem.dimension))
        free = problem.world.clearance(candidates) > problem.team.wall_radius[robot] + problem.margin
        gaps = np.linalg.norm(candidates[:, None] - bodies, axis=-1) - keep_off
        free &= (gaps > 0).all(axis=1)
        if free.any() and problem.world.num_obstacles and np.isfinite(problem.shortest_paths.length[robot]):
            free[free] = np.isfinite(problem.shortest_paths.distance_from(robot, candidates[free]))
        if free.any():
            return as_float32(candidates[np.argmax(free)])
    raise RuntimeError(
        f"no free position for a new goal of robot_{robot} between {low.tolist()} and {high.tolist()}; "
        "use a larger world, fewer robots or a smaller margin for lifelong mode"
    )
