"""Manoeuvres: parking, an alcove to make way in, a robot at its goal that makes way and returns."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.footprints import Box
from d4orm_planners import make_planner
from d4orm_planners.base.plan import Plan
from d4orm_planners.manoeuvres.primitives import MOVES, Kind, primitives_of
from d4orm_planners.manoeuvres.robots import can_plan

CORRIDOR = [[0.0, 1.0, 6.0, 1.5], [0.0, -0.5, 2.5, 0.3], [3.8, -0.5, 6.0, 0.3]]
"""A corridor along x, with an alcove below it in the middle."""


def problem_of(start: Any, goal: Any, boxes: Any, **arguments: Any) -> Problem:
    """Unicycles of half a metre by a quarter; goals ``(x, y, heading)``."""
    goals = np.array(goal, float)
    team = Team(("unicycle",) * len(goals), max_speed=0.5, max_turn_rate=1.0, footprint=Box(0.5, 0.25))
    usual = {"margin": 0.0, "goal_radius": 0.02, "goal_heading_tolerance": 0.03, "arrival": "stay", "horizon": 500}
    world = World(boxes=boxes, lower=(0.0, -0.5), upper=(6.0, 1.5))
    return Problem(team, start, goals[:, :2], world, goal_heading=goals[:, 2], **usual | arguments)


def solved(problem: Problem) -> Plan:
    """The plan, which must be a solution that the judge agrees to, found at once and without denoising."""
    plan = make_planner(engine="cpu").solve(problem, seed=0)
    assert plan.verified
    assert (plan.iterations, plan.denoising_steps) == (1, 0)
    return plan


@pytest.mark.parametrize("arrival", ["stay", "dock"])
def test_a_robot_parks_between_two_obstacles(arrival: str) -> None:
    boxes = [[1.6, 0.0, 2.3, 0.3], [3.0, 0.0, 3.7, 0.3]]
    plan = solved(problem_of([[1.0, 0.6, 0.0]], [[2.65, 0.15, 0.0]], boxes, arrival=arrival))
    assert plan.metrics["makespan"] < 15


def test_robots_that_meet_in_a_corridor_use_its_alcove() -> None:
    start, goal = [[0.7, 0.65, 0.0], [5.3, 0.65, np.pi]], [[5.3, 0.65, 0.0], [0.7, 0.65, np.pi]]
    plan = solved(problem_of(start, goal, CORRIDOR))
    # Lower than anywhere else in the corridor.
    assert plan.trajectory.positions[..., 1].min() < 0.3 + 0.125


def test_a_robot_at_its_goal_makes_way_and_returns() -> None:
    start, goal = [[0.7, 0.65, 0.0], [3.1, 0.65, 0.0]], [[5.3, 0.65, 0.0], [3.1, 0.65, 0.0]]
    plan = solved(problem_of(start, goal, CORRIDOR))
    assert np.abs(plan.trajectory.positions[:, 1] - goal[1][:2]).max() > 0.25


def test_a_car_backs_into_its_place() -> None:
    team = Team(("car",), footprint=Box(0.5, 0.25, 0.15))
    world = World(boxes=[[0.2, 0.4, 1.6, 0.9], [0.2, -0.9, 1.6, -0.4]], lower=(-0.1, -2.0), upper=(4.0, 2.0))
    plan = solved(Problem(team, [[2.5, 0.0, 0.5, 0.0, 0.0]], [[0.7, 0.0]], world, goal_heading=0.0, horizon=200))
    assert plan.trajectory.states[:, 0, 3].min() < 0


@pytest.mark.parametrize("model", MOVES)
def test_primitives_lead_back_where_they_began(model: str) -> None:
    """Those backwards in time undo those ahead: every position is passed in both, and the steps are as many."""
    ahead, back, modes = primitives_of(Kind(model, (1.0, 1.0, 1.5, 0.6, 1.0, 0.3), 0.1, 0.1))
    assert len(ahead.begin) == len(back.begin) == len(modes) + 1
    assert ahead.rests[0]
    ends = np.linalg.norm(ahead.poses[ahead.first[1:] - 1, :2], axis=1)
    for end in np.linalg.norm(back.poses[back.first[1:] - 1, :2], axis=1):
        assert np.abs(ends - end).min() < 1e-9


def test_discs_without_headings_are_planned_otherwise() -> None:
    """Others have the same plans as ever, and nothing new to compile."""
    team = Team(("unicycle", "unicycle"))
    assert not can_plan(Problem(team, [[0, 0, 0], [0, 2, 0]], [[2, 0], [2, 2]]))
    assert can_plan(Problem(team, [[0, 0, 0], [0, 2, 0]], [[2, 0], [2, 2]], goal_heading=[np.nan, 1.0]))
