"""Nothing is measured in metres: a problem in other units of length has the same plan, in those units."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planner_support import cheap_planner

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.scenarios import make_problem
from d4orm_env.verify import verify
from d4orm_planners import Episode, Plan, list_planners, make_planner, make_policy, run_episode

PROBLEMS: dict[str, tuple[str, dict[str, Any]]] = {
    "open": ("heterogeneous", {"num_robots": 4, "max_acceleration": [0.5, 1, 2, 1]}),
    "walls": ("rooms", {"num_robots": 3, "radius": [0.15, 0.12, 0.15], "goal_speed": 0.3}),
    "space": ("random", {"num_robots": 3, "model": "holonomic3d", "num_obstacles": 4}),
    "wheels": ("random", {"num_robots": 4, "model": "car"}),
}
FACTORS = st.integers(-6, 6).filter(bool).map(lambda exponent: 2.0**exponent)

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


@cache
def problem(name: str) -> Problem:
    scenario, arguments = PROBLEMS[name]
    return make_problem(scenario, seed=0, **arguments)


@cache
def plan(name: str, where: str) -> Plan:
    """The plan in metres, which all other units are compared with."""
    return cheap_planner(name).solve(problem(where), seed=1)


def assert_scaled(before: Any, after: Any, original: Problem, factor: float) -> None:
    """Controls and states of a plan or an episode are those of another, multiplied."""
    np.testing.assert_array_equal(after.controls, before.controls * control_units(original, factor))
    np.testing.assert_array_equal(
        after.trajectory.states, before.trajectory.states * state_units(original.team, factor)
    )
    np.testing.assert_array_equal(after.trajectory.rewards, before.trajectory.rewards)


@pytest.mark.slow
@pytest.mark.parametrize("name", list_planners())
@pytest.mark.parametrize("where", PROBLEMS)
@given(factor=FACTORS)
@settings(max_examples=1, deadline=None)
def test_plans_are_the_same_in_other_units(name: str, where: str, factor: float) -> None:
    original, before = problem(where), plan(name, where)
    after = cheap_planner(name).solve(scaled(original, factor), seed=1)
    assert_scaled(before, after, original, factor)
    assert (before.solved, before.failures.keys()) == (after.solved, after.failures.keys())


POLICIES: dict[str, dict[str, Any]] = {
    "go-to-goal": {},
    "random": {},
    "orca": {},
    "d4orm-c2f": {"engine": "cpu", "refine": "sync", "num_samples": 32, "num_steps": 5, "coarse_iterations": 2},
}


@cache
def episode(name: str, where: str, factor: float = 1.0) -> Episode:
    """The episode in metres, or with all lengths multiplied."""
    env = navigation_v0.parallel_env(problem=scaled(problem(where), factor), max_cycles=20)
    return run_episode(env, make_policy(name, **POLICIES[name]), seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.parametrize("where", PROBLEMS)
@given(factor=FACTORS)
@settings(max_examples=1, deadline=None)
def test_episodes_are_the_same_in_other_units(name: str, where: str, factor: float) -> None:
    if name == "orca" and where == "space":
        pytest.skip("works in the plane")
    original, before = problem(where), episode(name, where)
    assert_scaled(before, episode(name, where, factor), original, factor)


@pytest.mark.parametrize("where", PROBLEMS)
@given(factor=FACTORS, seed=st.integers(0, 100))
@settings(max_examples=5, deadline=None)
def test_the_judge_says_the_same_in_other_units(where: str, factor: float, seed: int) -> None:
    original = problem(where)
    other, units = scaled(original, factor), control_units(original, factor)
    limit, shape = original.team.control_limits, (original.horizon, *original.team.control_limits.shape)
    controls = np.random.default_rng(seed).uniform(-1.2, 1.2, shape) * limit
    before, after = verify(original, controls), verify(other, controls * units)
    assert after.min_separation == before.min_separation * factor
    assert after.min_clearance == before.min_clearance * factor
    np.testing.assert_array_equal(after.arrival_times, before.arrival_times)
    kinds = [[(each.kind, each.robots, each.time) for each in report.violations] for report in (before, after)]
    assert kinds[0] == kinds[1]


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["rooms", "maze", "warehouse"])
@pytest.mark.parametrize("factor", [0.02, 0.1, 3.0])
def test_robots_of_any_size_get_by_among_walls(scenario: str, factor: float) -> None:
    other = scaled(make_problem(scenario, num_robots=5, seed=0), factor)
    assert make_planner().solve(other, seed=0, max_iterations=10).solved
