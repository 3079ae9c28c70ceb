"""A problem in other units of length: whatever has metres in its unit is multiplied, times and angles are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World

LENGTHS = ("wheelbase",)
"""Limits of a model's own that are lengths."""


def state_units(team: Team, factor: float) -> FloatArray:
    """``(K, n)`` what state components are multiplied by: places and speeds by the factor, all else by one."""
    units = np.ones((team.num_robots, team.state_size), np.float32)
    for robot, model in enumerate(team.robot_models):
        units[robot, [*range(model.dimension), *model.speed_indices]] = factor
    return units


def control_units(problem: Problem, factor: float) -> FloatArray:
    """``(K, m)`` what control components are multiplied by."""
    before, after = problem.team.control_limits, scaled_team(problem.team, factor).control_limits
    return np.divide(after, before, out=np.ones_like(after), where=before > 0)


def scaled_team(team: Team, factor: float) -> Team:
    """The team with radii, speeds, accelerations and limits that are lengths multiplied."""
    own = {name: values * factor if name in LENGTHS else values for name, values in team.own_limits.items()}
    return Team(
        team.models,
        team.radius * factor,
        team.max_speed * factor,
        team.max_acceleration * factor,
        team.max_turn_rate,
        own,
    )


def scaled_world(world: World, factor: float) -> World:
    """The world with all its obstacles and bounds multiplied."""
    tables = {name: getattr(world, name) * factor for name in ("circles", "spheres", "cylinders", "boxes")}
    bounds = {name: None if (end := getattr(world, name)) is None else end * factor for name in ("lower", "upper")}
    return World(world.dimension, **tables, polygons=[corners * factor for corners in world.polygons], **bounds)


def scaled(problem: Problem, factor: float) -> Problem:
    """The problem with all its lengths multiplied by the factor."""
    return replace(
        problem,
        team=scaled_team(problem.team, factor),
        start=problem.start * state_units(problem.team, factor),
        goal=problem.goal * factor,
        world=scaled_world(problem.world, factor),
        margin=problem.margin * factor,
        goal_radius=problem.goal_radius * factor,
        goal_speed=problem.goal_speed * np.float32(factor),
    )
