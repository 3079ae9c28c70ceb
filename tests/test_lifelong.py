"""When robots that never stop working have reached a goal."""

from __future__ import annotations

import numpy as np
import pytest
from env_support import line_problem

from d4orm_env.core.dynamics import MODELS
from d4orm_env.lifelong import reached_goals


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
    assert reached_goals(problem, problem.goal, states, controls).tolist() == [True, False, False]
