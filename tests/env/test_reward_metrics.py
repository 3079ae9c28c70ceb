"""Rewards and metrics as numbers derived by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from engine_support import ENGINE_NAMES, open_problem, stand

from d4orm_env import make_problem, rollout
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import inverse_initial_distance
from d4orm_env.core.team import Team
from d4orm_env.core.trajectory import Trajectory, arrival_times, mean_squared_jerk, trajectory_metrics
from d4orm_env.core.world import World
from d4orm_env.dynamics.transition import step_reward
from d4orm_env.engine.choice import get_engine


def test_step_reward() -> None:
    assert step_reward(3.0, 0.25, (0.0, 0.0, 0.0), 1.0, 1.0) == 0.25
    assert step_reward(3.0, 0.25, (1.0, 0.0, 0.0), 1.0, 1.0) == -0.75
    assert step_reward(3.0, 0.25, (1.0, 1.0, 0.0), 1.0, 1.0) == -1.75
    assert step_reward(3.0, 0.25, (1.0, 1.0, 0.0), 0.5, 1.0) == -0.75
    assert step_reward(3.0, 0.25, (1.0, 1.0, 1.0), 2.0, 1.0) == -5.75
    assert step_reward(0.0, 0.25, (0.0, 0.0, 0.0), 1.0, 1.0) == 1.0


def test_start_distance_counts_from_the_goal_radius() -> None:
    positions, goals = [[0, 0], [1, 1], [1, 1]], [[3, 4], [1, 1], [1, 1.05]]
    np.testing.assert_allclose(
        inverse_initial_distance(np.float32(positions), np.float32(goals), 0.1), [0.2, 10, 10], rtol=1e-6
    )


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_straight_drive_of_a_first_order_robot(engine: str) -> None:
    """At 1 m/s to a goal 1 m ahead: after step t the reward is 0.1 t, and 1 from t = 10 on, when it docks at the goal.

    0.1 + 0.2 + ... + 0.9 = 4.5, and eleven times 1 make 15.5 over 20 steps.
    """
    problem = Problem(Team(("velocity2d",)), [[0, 0]], [[1, 0]], horizon=20)
    trajectory = get_engine(engine).rollout(problem, np.tile([1.0, 0.0], (20, 1, 1)))
    assert trajectory.rewards.sum() == pytest.approx(15.5, abs=1e-5)
    metrics = trajectory_metrics(problem, trajectory)
    assert metrics["reward"] == pytest.approx(0.775, abs=1e-6)
    assert metrics["travel_time"] == pytest.approx(1.0)
    assert metrics["success"] == 1.0


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_straight_drive_of_a_double_integrator(engine: str) -> None:
    """At 1 m/s^2 up to 1 m/s, to a goal 1 m ahead: p = 0.005 t^2 up to t = 10, then 0.105 m more each step.

    (The speed limit comes after the integration, so a robot that goes on accelerating does 0.1 + 0.005 m a step.)
    0.005 * 385 = 1.925 up to t = 10, then 0.605 + 0.71 + 0.815 + 0.92 = 3.05, and from t = 15 on, docked at 1.025,
    six times 0.975: 10.825.
    """
    problem = Problem(Team(("holonomic2d",)), [[0, 0, 0, 0]], [[1, 0]], horizon=20, goal_speed=math.inf)
    trajectory = get_engine(engine).rollout(problem, np.tile([1.0, 0.0], (20, 1, 1)))
    assert trajectory.rewards.sum() == pytest.approx(10.825, abs=1e-5)
    assert int(trajectory.arrived[:, 0].argmax()) == 15


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_straight_drive_of_a_differential_drive_on_a_slope(engine: str) -> None:
    """The same drive along the direction (3, 4) / 5, which the robot faces."""
    heading = math.atan2(4, 3)
    problem = Problem(
        Team(("differential_drive",)), [[0, 0, heading, 0]], [[0.6, 0.8]], horizon=20, goal_speed=math.inf
    )
    trajectory = get_engine(engine).rollout(problem, np.tile([0.0, 1.0], (20, 1, 1)))
    assert trajectory.rewards.sum() == pytest.approx(10.825, abs=1e-5)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_head_on_drive_pays_for_the_margin(engine: str) -> None:
    """Two robots 2 m apart, each with its goal where the other starts, at 1 m/s for 0.6 s.

    Gap between centres 1.8, 1.6, ..., 0.8: within 0.45 + 0.5 + 0.05 = 1.0 after steps 5 and 6 (1.0 is at the margin).
    Without penalties step t brings 0.05 t: 0.05 * 21 = 1.05. Two penalties make -0.95.
    """
    team = Team(("velocity2d",) * 2, radius=[0.4375, 0.5])
    problem = Problem(team, [[0, 0], [2, 0]], [[2, 0], [0, 0]], horizon=6, margin=0.0635)
    controls = np.tile([[1.0, 0.0], [-1.0, 0.0]], (6, 1, 1))
    trajectory = get_engine(engine).rollout(problem, controls)
    np.testing.assert_allclose(trajectory.rewards.sum(axis=0), [-0.95, -0.95], atol=1e-5)
    assert trajectory.margin_violated[:, 0].tolist() == [False] * 5 + [True] * 2
    assert trajectory.collided[:, 1].tolist() == [False] * 6 + [True]


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_robots_and_obstacles_cost_one_each_however_many(engine: str) -> None:
    world = World(2, circles=[[0, 0, 0.1], [0.2, 0, 0.1]], boxes=[[-0.5, -0.5, 0.5, -0.4]])
    problem = open_problem(3, world=world, radius=0.25)
    # All goals lie at a distance that the start distance of 3 * sqrt(2) m divides into round numbers.
    problem = problem.replace(start=[[6, 0], [9, 0], [12, 0]], goal=[[3, 0], [3, 8], [30, 0]])
    result = stand(get_engine(engine), problem, [[0, 0], [0, 0], [21, 0]])
    # Distances 3 of 3, sqrt(73) of 10, 9 of 18; the first two stand in each other and in all obstacles at once.
    np.testing.assert_allclose(result.rewards, [-2, -1 - math.sqrt(73) / 10, 0.5], atol=1e-6)


def test_arrival_times() -> None:
    arrived = np.array([[0, 0, 1], [0, 0, 1], [1, 0, 1], [1, 0, 1]], bool)
    assert arrival_times(arrived, 0.5).tolist() == [1.0, np.inf, 0.0]


def test_mean_squared_jerk_counts_steps_before_arrival() -> None:
    # One robot changes (0,0) -> (1,0) -> (1,2) -> (0,0) at dt = 0.5: squared jerks 4, 16, 20.
    controls = np.array([[0, 0], [1, 0], [1, 2], [0, 0]], np.float32)[:, None]
    never = np.zeros((5, 1), bool)
    assert mean_squared_jerk(controls, never, 0.5) == pytest.approx((4 + 16 + 20) / 3)
    # Docked from step 3 on: the change to the third step's zero control is none of its doing.
    arrived = never.copy()
    arrived[3:] = True
    assert mean_squared_jerk(controls, arrived, 0.5) == pytest.approx((4 + 16) / 2)
    assert mean_squared_jerk(controls, np.ones((5, 1), bool), 0.5) == 0.0
    # Two robots, the second docked from the first step on.
    both = np.concatenate([controls, 9 * controls], axis=1)
    flags = np.concatenate([never, np.arange(5)[:, None] >= 1], axis=1)
    assert mean_squared_jerk(both, flags, 0.5) == pytest.approx((4 + 16 + 20) / 3)


def test_the_jerk_of_a_robot_driven_by_its_jerk_is_that() -> None:
    problem = make_problem("circle", num_robots=2, model="holonomic2d_jerk", horizon=4)
    controls = np.zeros((4, 2, 2), np.float32)
    controls[:, 0] = (1, 2)
    # Of robot_0 1 and 2 m/s^3, of robot_1 none.
    assert trajectory_metrics(problem, rollout(problem, controls))["mean_squared_jerk"] == pytest.approx(5 / 2)


def test_mean_squared_jerk_of_a_single_step_is_zero() -> None:
    assert mean_squared_jerk(np.ones((1, 2, 2)), np.zeros((2, 2), bool), 0.1) == 0.0


def plain_trajectory(
    arrived: np.ndarray, collided: np.ndarray, violated: np.ndarray, rewards: np.ndarray
) -> Trajectory:
    steps, num_robots = rewards.shape
    states = np.zeros((steps + 1, num_robots, 2), np.float32)
    controls = np.zeros((steps, num_robots, 2), np.float32)
    return Trajectory(states, states, controls, rewards.astype(np.float32), arrived, collided, violated)


def test_trajectory_metrics() -> None:
    problem = open_problem(3, horizon=4, dt=0.5)
    arrived = np.zeros((5, 3), bool)
    arrived[2:, 0] = arrived[3:, 1] = True
    collided, violated = np.zeros((5, 3), bool), np.zeros((5, 3), bool)
    violated[1, 0] = violated[1:3, 1] = True
    rewards = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]], np.float32)
    metrics = trajectory_metrics(problem, plain_trajectory(arrived, collided, violated, rewards))
    assert metrics == {
        "success": 0.0,
        "travel_time": pytest.approx((1.0 + 1.5 + 2.0) / 3),  # the third never arrives: the full 2 s
        "makespan": 2.0,
        "reward": 0.5,
        "mean_squared_jerk": 0.0,
        "arrived": 2.0,
        "collided": 0.0,
        "margin_violated": 2.0,
    }


@pytest.mark.parametrize(("contact", "success"), [(False, 1.0), (True, 0.0)])
def test_success_is_everyone_arriving_without_contact(contact: bool, success: float) -> None:
    problem = open_problem(2, horizon=2, dt=0.5)
    arrived = np.array([[False, False], [True, False], [True, True]])
    collided = np.zeros((3, 2), bool)
    collided[1, 0] = contact
    # The margin is the planner's business and does not count against success.
    metrics = trajectory_metrics(problem, plain_trajectory(arrived, collided, arrived, np.zeros((2, 2))))
    assert (metrics["success"], metrics["collided"]) == (success, float(contact))
