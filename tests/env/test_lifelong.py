"""When robots that never stop working have reached a goal."""

from __future__ import annotations

import numpy as np
import pytest
from env_support import line_problem

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import MODELS
from d4orm_env.envs.lifelong import fresh_goal, reached_goals


@pytest.mark.parametrize("model", MODELS)
def test_a_goal_is_reached_there_and_no_faster_than_the_goal_speed(model: str) -> None:
    problem = line_problem([1.0, 1.0, 1.0], model, goal_radius=0.1, goal_speed=0.2)
    states = np.zeros_like(problem.start)
    states[:, : problem.dimension] = problem.goal
    states[1, 0] -= 0.15  # outside the goal radius
    controls = np.zeros((3, problem.control_size), np.float32)
    kind = MODELS[model]
    # The third robot drives at half a metre a second: by its state, or where it has no inertia by its control.
    (states if kind.speed_indices else controls)[2, kind.speed_indices[0] if kind.speed_indices else 0] = 0.5
    assert reached_goals(problem.team, problem.arrays, states, controls).tolist() == [True, False, False]


def test_new_goals_lie_where_the_robot_can_get_to() -> None:
    # A ring of walls with room for a robot inside, which nobody can enter or leave.
    walls = [[1, 1, 3, 1.2], [1, 2.8, 3, 3], [1, 1, 1.2, 3], [2.8, 1, 3, 3]]
    world = World(boxes=walls, lower=[-1, -1], upper=[4, 4])
    start, inside = [[0, 0], [2, 2]], [[3.5, 3.5], [1.7, 1.7]]
    problem = Problem(Team(("velocity2d",) * 2, radius=0.1), start, inside, world)
    goals, random = problem.goal.copy(), np.random.default_rng(0)
    for _ in range(20):
        for robot in range(2):
            goals[robot] = fresh_goal(problem, robot, problem.start[:, :2], goals, random)
            within = (np.abs(goals[robot] - 2) < 1).all()
            assert within == (robot == 1)
