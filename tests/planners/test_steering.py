"""Following given controls up to a time and driving straight to the goal from there, as the engine would."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from engine_support import MODEL_NAMES, random_controls
from env_support import line_problem, mixed_problem

from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_planners.engine.cpu_sampling import CpuSamplingEngine
from d4orm_planners.tracking.steering import NEAR_VIA, Rollouts, drives

CPU = CpuSamplingEngine()
SWITCH_TIMES = (0, 3, 10, 25, 79)


def problem_of(model: str, **changes: Any) -> Problem:
    """Goals that a robot reaches from wherever a second or two of random controls may have taken it, or does not."""
    if model == "mixed":
        return mixed_problem().replace(goal=[[2, 1], [-1, 1.5], [1, -2]], horizon=80, **changes)
    return line_problem([1.0, 2.0, 3.0], model, horizon=80, **changes)


def closing(problem: Problem, controls: np.ndarray, times: Any = SWITCH_TIMES) -> tuple[Trajectory, Rollouts]:
    """The engine's rollout of the controls, and every robot's stretches at the same times."""
    trajectory = CPU.rollout(problem, controls)
    switch = np.tile(times, (problem.num_robots, 1))
    return trajectory, drives(problem, trajectory.states, trajectory.controls, switch)


@pytest.mark.parametrize("goal_speed", [np.inf, 0.2])
@pytest.mark.parametrize("model", [*MODEL_NAMES, "mixed"])
def test_stretches_are_the_engines_rollouts_of_their_controls(model: str, goal_speed: float) -> None:
    problem = problem_of(model, goal_speed=goal_speed)
    given, stretches = closing(problem, random_controls(problem, seed=2))
    size = problem.num_robots, len(SWITCH_TIMES)
    assert stretches.controls.shape == (80, *size, problem.control_size)
    assert stretches.positions.shape == (81, *size, problem.dimension)
    assert stretches.arrived.shape == size
    for v, time in enumerate(SWITCH_TIMES):
        rollout = CPU.rollout(problem, stretches.controls[:, :, v])
        np.testing.assert_allclose(rollout.positions, stretches.positions[:, :, v], atol=1e-4)
        np.testing.assert_array_equal(rollout.arrived[-1], stretches.arrived[:, v])
        np.testing.assert_allclose(rollout.controls, stretches.controls[:, :, v], atol=1e-6)
        np.testing.assert_allclose(stretches.controls[:time, :, v], given.controls[:time], atol=1e-6)
        np.testing.assert_allclose(stretches.positions[: time + 1, :, v], given.positions[: time + 1], atol=1e-4)
    assert stretches.arrived[:, 0].all(), "from the start, every robot drives to its goal"
    assert not stretches.arrived[:, -1].all(), "in the last step it is too late for some"


@pytest.mark.parametrize("model", [*MODEL_NAMES, "mixed"])
def test_every_robot_has_switch_times_of_its_own(model: str) -> None:
    problem = problem_of(model)
    trajectory = CPU.rollout(problem, random_controls(problem, seed=2))
    switch = np.array([[0, 12], [7, 3], [20, 40]])
    together = drives(problem, trajectory.states, trajectory.controls, switch)
    for robot in range(3):
        alone = problem.select([robot])
        n, m = alone.state_size, alone.control_size
        single = drives(alone, trajectory.states[:, [robot], :n], trajectory.controls[:, [robot], :m], switch[[robot]])
        np.testing.assert_allclose(together.positions[:, robot], single.positions[:, 0], atol=1e-5)
        np.testing.assert_array_equal(together.arrived[robot], single.arrived[0])


def test_robot_on_a_line_stops_at_its_goal_in_two_to_three_seconds() -> None:
    """One metre at 1 m/s^2: a second to speed up, a second to brake, and a little to settle."""
    problem = line_problem([1.0], "holonomic2d", horizon=80, goal_speed=0.1)
    _, stretches = closing(problem, np.zeros((80, 1, 2), np.float32), [0])
    path = stretches.positions[:, 0, 0]
    moving = np.abs(stretches.controls[:, 0, 0]).sum(axis=1) > 0
    assert stretches.arrived.tolist() == [[True]]
    assert 18 <= moving.sum() <= 30
    assert path[-1].tolist() == [pytest.approx(1, abs=0.075), 0]


@pytest.mark.parametrize("model", MODEL_NAMES)
def test_nobody_arrives_above_the_goal_speed(model: str) -> None:
    """Full speed through the goal, and no time left to turn round."""
    fast = line_problem([1.0], model, horizon=40)
    ahead = np.zeros((40, 1, fast.control_size), np.float32)
    ahead[:, :, 1 if model == "differential_drive" else 0] = 1
    passing = int((CPU.rollout(fast, ahead).arrived[:, 0]).argmax())
    for goal_speed, expected in ((np.inf, True), (0.1, False)):
        problem = fast.replace(goal_speed=goal_speed, horizon=passing)
        _, stretches = closing(problem, ahead[:passing], [passing - 1])
        rollout = CPU.rollout(problem, stretches.controls[:, :, 0])
        assert stretches.arrived[0, 0] == rollout.arrived[-1, 0] == expected


@pytest.mark.parametrize("model", MODEL_NAMES)
def test_robot_that_arrives_before_its_switch_stays_docked(model: str) -> None:
    problem = line_problem([1.0], model, horizon=60)
    ahead = np.zeros((60, 1, problem.control_size), np.float32)
    ahead[:, :, 1 if model == "differential_drive" else 0] = 0.8
    trajectory, stretches = closing(problem, ahead, [5, 40, 59])
    arrived = trajectory.arrived[:, 0].argmax()
    assert 5 < arrived < 40
    for v in (1, 2):
        np.testing.assert_allclose(stretches.positions[:, 0, v], trajectory.positions[:, 0], atol=1e-5)
        assert (stretches.controls[arrived:, 0, v] == 0).all()
    assert stretches.arrived.tolist() == [[True, True, True]]
    _, late = closing(problem, ahead, [40, 50])
    np.testing.assert_allclose(late.positions[:, 0, 0], trajectory.positions[:, 0], atol=1e-5)
    assert late.arrived.tolist() == [[True, True]]


def test_arguments_are_left_alone() -> None:
    problem = problem_of("mixed")
    trajectory = CPU.rollout(problem, random_controls(problem, seed=2))
    states, controls = trajectory.states.copy(), trajectory.controls.copy()
    drives(problem, states, controls, np.array([[3], [5], [7]]))
    np.testing.assert_array_equal(states, trajectory.states)
    np.testing.assert_array_equal(controls, trajectory.controls)


@pytest.mark.parametrize("model", [*MODEL_NAMES, "mixed"])
def test_a_path_by_points_comes_near_all_of_them_in_turn(model: str) -> None:
    problem = problem_of(model).replace(horizon=300)
    given, _ = closing(problem, np.zeros((300, problem.num_robots, problem.control_size), np.float32))
    start = np.asarray(problem.start)[:, None, None, : problem.dimension]
    steps = np.zeros((1, 2, 2, problem.dimension))
    steps[0, :, :, :2] = [[[1, 1], [2, -1]], [[-1, -1], [-1, 1]]]
    switch = np.zeros((problem.num_robots, 2), int)
    drawn = drives(problem, given.states, given.controls, switch, start + steps)
    assert drawn.arrived.all()
    gap = np.linalg.norm(drawn.positions[:, :, :, None] - (start + steps), axis=4)
    near = NEAR_VIA * problem.team.largest_radius
    assert (gap.min(axis=0) < near).all()
    first = (gap < near).argmax(axis=0)
    assert (first[..., 1] > first[..., 0]).all()
    rollout = CPU.rollout(problem, drawn.controls[:, :, 1])
    np.testing.assert_allclose(rollout.states, drawn.states[:, :, 1], atol=1e-4)
