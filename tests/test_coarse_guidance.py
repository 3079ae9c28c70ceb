"""The coarse guidance of D4orm-C2F: how it is made, when it is good enough, and where on it the robots are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from planner_support import hop_problem

from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine.choice import get_engine
from d4orm_planners.d4orm_c2f.coarse import (
    Guidance,
    coarse_problem,
    interpolate,
    nearest_indices,
    passes_checks,
    rest_of,
    subgoal_indices,
)


@pytest.mark.parametrize(
    ("horizon", "factor", "steps"),
    [(100, 1, 100), (100, 2, 50), (100, 3, 34), (100, 4, 25), (3, 10, 1), (1, 2, 1)],
)
def test_coarse_steps_are_longer_and_cover_the_horizon(horizon: int, factor: int, steps: int) -> None:
    problem = hop_problem(horizon=horizon, dt=0.1)
    coarse = coarse_problem(problem, factor)
    assert (coarse.horizon, coarse.dt) == (steps, pytest.approx(0.1 * factor))
    assert coarse.horizon * coarse.dt >= problem.horizon * problem.dt - 1e-9
    np.testing.assert_array_equal(coarse.start, problem.start)
    np.testing.assert_array_equal(coarse.goal, problem.goal)


def test_waypoints_divide_every_coarse_step_evenly() -> None:
    path = np.array([[[0.0, 0.0]], [[4.0, 2.0]], [[4.0, 6.0]]])
    expected = [[0, 0], [1, 0.5], [2, 1], [3, 1.5], [4, 2], [4, 3], [4, 4], [4, 5], [4, 6]]
    np.testing.assert_allclose(interpolate(path, 4)[:, 0], expected)
    np.testing.assert_array_equal(interpolate(path, 1), path)


def test_waypoints_keep_those_of_the_path_exactly() -> None:
    path = np.random.default_rng(0).normal(size=(6, 3, 2)).astype(np.float32)
    waypoints = interpolate(path, 3)
    assert waypoints.shape == (16, 3, 2)
    assert waypoints.dtype == np.float32
    np.testing.assert_array_equal(waypoints[::3], path)


def trajectory(arrived: Any, violated: Any) -> Trajectory:
    """Of one robot over ten steps, which arrives or not, and violates the margin at these steps."""
    nothing = np.zeros((11, 1, 2), np.float32)
    reached = np.zeros((11, 1), bool)
    reached[-1] = arrived
    violations = np.zeros((11, 1), bool)
    violations[violated] = True
    return Trajectory(nothing, nothing, nothing[1:], nothing[1:, :, 0], reached, np.zeros((11, 1), bool), violations)


@pytest.mark.parametrize(
    ("arrived", "violated", "interval", "passes"),
    [
        (True, [], 1, True),
        (False, [], 1, False),
        (True, [7], 1, False),
        (True, [7], 2, True),
        (True, [7, 8], 2, False),
        (True, [5], 5, False),
        (True, [4, 6, 9], 5, True),
        # Where the robots start is not up to the plan.
        (True, [0], 1, True),
        # Nothing is looked at.
        (True, [3], 11, True),
    ],
)
def test_coarse_plans_are_checked_at_intervals(arrived: bool, violated: list[int], interval: int, passes: bool) -> None:
    assert passes_checks(trajectory(arrived, violated), interval) is passes


def test_nearest_waypoints_are_looked_for_ahead_only() -> None:
    # There and back on the same line: x = 0 1 2 3 2 1 0.
    line = np.array([0.0, 1, 2, 3, 2, 1, 0])
    path = np.stack([np.stack([line, 0 * line], axis=1)] * 3, axis=1)
    positions = np.array([[0.9, 0.2], [0.9, 0.2], [2.1, 0]])
    np.testing.assert_array_equal(nearest_indices(path, positions, [0, 3, 0], 6), [1, 5, 2])
    # A window of one waypoint reaches no further; beyond the end there is nothing.
    np.testing.assert_array_equal(nearest_indices(path, positions, [0, 3, 6], 1), [1, 4, 6])


def test_a_robot_held_up_keeps_to_its_own_path() -> None:
    indices = np.array([10, 12, 2, 30])
    # The mean is 13 or so; the third robot is 11 behind it, more than the 5 that are allowed.
    np.testing.assert_array_equal(subgoal_indices(indices, 13, 15, 5, 100), [28, 28, 22, 28])
    np.testing.assert_array_equal(subgoal_indices(indices, 13, 15, 5, 25), [25, 25, 22, 25])
    np.testing.assert_array_equal(subgoal_indices(indices, 13, 15, 100, 100), [28, 28, 28, 28])


@pytest.mark.parametrize(("index", "step"), [(0, 0), (1, 1), (2, 1), (3, 2), (30, 14), (99, 14)])
def test_the_rest_begins_at_the_next_coarse_step(index: int, step: int) -> None:
    problem = hop_problem(num_robots=2, horizon=30)
    coarse = coarse_problem(problem, 2)
    controls = np.random.default_rng(1).uniform(-0.5, 0.5, (15, 2, 2)).astype(np.float32)
    plan = get_engine("cpu").rollout(coarse, controls)
    guidance = Guidance(coarse, plan.controls, plan.states, interpolate(plan.positions, 2))
    left, rest = rest_of(guidance, index, 2)
    assert left.horizon == len(rest) == 15 - step
    np.testing.assert_array_equal(left.start, plan.states[step])
    np.testing.assert_array_equal(rest, plan.controls[step:])
    # Executed from there, it is the rest of the plan.
    again = get_engine("cpu").rollout(left, rest)
    np.testing.assert_allclose(again.states, plan.states[step:], atol=1e-5)
