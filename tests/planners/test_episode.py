"""Episodes and their metrics, against numbers worked out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from env_support import line_problem
from planner_support import cheap_planner, hop_problem

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.envs.joint_state import JointState
from d4orm_env.scenarios import make_problem
from d4orm_planners import Episode, OpenLoop, Policy, make_policy, run_episode
from d4orm_planners.base.episode import open_env
from d4orm_planners.base.policy import StatePolicy
from d4orm_planners.engine.sampling_types import get_sampling_engine


class Script(StatePolicy):
    """Executes ``(H, K, m)`` controls, whatever the problem."""

    def __init__(self, controls: Any) -> None:
        self._script = np.asarray(controls, np.float32)

    def _controls(self, joint: JointState) -> FloatArray:
        return self._script[joint.steps]


def drive(problem: Problem, controls: Any, **settings: Any) -> Episode:
    shape = (problem.horizon, problem.num_robots, problem.control_size)
    script = Script(np.broadcast_to(np.asarray(controls, np.float32), shape))
    return run_episode(navigation_v0.parallel_env(problem=problem, **settings), script)


def test_a_straight_drive_in_numbers() -> None:
    # 0.1 m per step towards a goal 0.35 m away: docked, 0.05 m short of it, in the third step.
    episode = drive(line_problem([0.35]), [1, 0])
    trajectory, metrics = episode.trajectory, episode.metrics
    np.testing.assert_allclose(trajectory.positions[:, 0], [[0, 0], [0.1, 0], [0.2, 0], [0.3, 0]], atol=1e-6)
    np.testing.assert_allclose(trajectory.rewards[:, 0], [2 / 7, 4 / 7, 6 / 7], atol=1e-6)
    assert trajectory.arrived[:, 0].tolist() == [False, False, False, True]
    assert metrics["success"] == 1
    assert metrics["steps"] == 3
    assert metrics["travel_time"] == metrics["makespan"] == pytest.approx(0.3)
    assert metrics["reward"] == pytest.approx(4 / 7)
    assert metrics["mean_squared_jerk"] == pytest.approx(0, abs=1e-9)
    assert metrics["goals_reached"] == metrics["arrived"] == 1
    # One goal in three tenths of a second.
    assert metrics["goals_per_robot_minute"] == pytest.approx(200)
    assert metrics["collided"] == metrics["margin_violated"] == metrics["collisions"] == 0


def test_one_arrives_and_one_does_not() -> None:
    # The second robot makes 1 m of its 2 m in the ten steps there are.
    episode = drive(line_problem([0.35, 2.0], horizon=10), [1, 0])
    trajectory, metrics = episode.trajectory, episode.metrics
    assert len(trajectory.controls) == 10
    # The first goes on gaining 6/7 where it stands; the second gains 0.05 more in every step.
    np.testing.assert_allclose(trajectory.rewards[:, 0], [2 / 7, 4 / 7] + [6 / 7] * 8, atol=1e-6)
    np.testing.assert_allclose(trajectory.rewards[:, 1], 0.05 * np.arange(1, 11), atol=1e-6)
    assert metrics["reward"] == pytest.approx(((6 / 7 + 8 * 6 / 7) / 10 + 0.275) / 2, abs=1e-6)
    assert metrics["success"] == 0
    assert metrics["arrived"] == 1
    assert metrics["travel_time"] == pytest.approx((0.3 + 1.0) / 2)
    assert metrics["makespan"] == pytest.approx(1.0)
    assert metrics["goals_per_robot_minute"] == pytest.approx(1 / (2 * 1 / 60))
    np.testing.assert_array_equal(trajectory.controls[:3, 0], [[1, 0]] * 3)
    assert not trajectory.controls[3:, 0].any()


def test_jerk_in_numbers() -> None:
    # Accelerations of 1 and 0.5 m/s^2 in turn change by 0.5 in 0.1 s: 5 m/s^3, squared 25, as long as it moves.
    problem = line_problem([0.35], model="holonomic2d", horizon=40)
    controls = np.zeros((40, 1, 2), np.float32)
    controls[::2, 0, 0], controls[1::2, 0, 0] = 1, 0.5
    episode = drive(problem, controls)
    assert episode.metrics["success"] == 1
    assert episode.metrics["mean_squared_jerk"] == pytest.approx(25, rel=1e-5)


def test_contact_in_numbers() -> None:
    # Robots of radius 0.15 m, 1 m apart, drive at each other: 0.6 m, 0.4 m, then 0.2 m between the centres.
    team = Team(("velocity2d",) * 2)
    problem = Problem(team, [[0, 0], [1, 0]], [[2, 0], [-1, 0]], horizon=6)
    episode = drive(problem, [[1, 0], [-1, 0]])
    # After t steps the centres are |1 - 0.2 t| apart: in contact (0.3 m) at steps 4 to 6.
    assert episode.trajectory.collided[:, 0].tolist() == [False] * 4 + [True] * 3
    np.testing.assert_array_equal(episode.trajectory.collided[:, 0], episode.trajectory.collided[:, 1])
    assert episode.metrics["collided"] == 2
    assert episode.metrics["collisions"] == 6
    assert episode.metrics["success"] == 0
    np.testing.assert_allclose(episode.trajectory.rewards[:, 0], [0.05, 0.1, 0.15, -0.8, -0.75, -0.7], atol=1e-5)


def test_a_docked_robot_that_is_run_into_counts_too() -> None:
    # robot_0 docks after one step and leaves; robot_1 then drives into it from above.
    problem = line_problem([0.1, 1.0], horizon=9)
    episode = drive(problem, [[1, 0], [0, -1]])
    trajectory = get_sampling_engine("cpu").rollout(problem, np.broadcast_to(np.float32([[1, 0], [0, -1]]), (9, 2, 2)))
    assert episode.trajectory.collided[:, 0].tolist() == [False] * 8 + [True] * 2
    for name in ("collided", "margin_violated"):
        np.testing.assert_array_equal(getattr(episode.trajectory, name), getattr(trajectory, name))
    np.testing.assert_allclose(episode.trajectory.rewards, trajectory.rewards, atol=1e-5)
    assert episode.metrics["collided"] == 2
    assert episode.metrics["reward"] == pytest.approx(episode.trajectory.rewards.mean(), abs=1e-5)


@pytest.mark.parametrize("num_robots", [1, 4])
def test_shapes(num_robots: int) -> None:
    env = navigation_v0.parallel_env(scenario="circle", num_robots=num_robots, model="differential_drive")
    episode = run_episode(env, make_policy("go-to-goal"))
    trajectory = episode.trajectory
    steps = len(trajectory.controls)
    assert trajectory.states.shape == (steps + 1, num_robots, 4)
    assert trajectory.positions.shape == (steps + 1, num_robots, 2)
    assert trajectory.controls.shape == (steps, num_robots, 2)
    assert trajectory.rewards.shape == (steps, num_robots)
    assert len(episode.observations) == len(episode.infos) == steps + 1
    for flags in (trajectory.arrived, trajectory.collided, trajectory.margin_violated):
        assert flags.shape == (steps + 1, num_robots)
        assert flags.dtype == bool
    assert {trajectory.states.dtype, trajectory.controls.dtype, trajectory.rewards.dtype} == {np.dtype(np.float32)}


def test_the_metrics_are_plain_numbers() -> None:
    episode = drive(line_problem([0.35, 2.0], horizon=10), [1, 0])
    assert all(type(value) is float and np.isfinite(value) for value in episode.metrics.values())


def test_the_executed_controls_are_recorded_not_the_wanted_ones() -> None:
    # Wanted: 3 m/s, where 1 m/s is the limit.
    episode = drive(line_problem([2.0], horizon=5), [3, 0])
    np.testing.assert_allclose(episode.trajectory.controls[:, 0], [[1, 0]] * 5, atol=1e-6)
    disturbed = drive(line_problem([2.0], horizon=5), [0.1, 0], control_noise_std=0.1)
    assert np.abs(disturbed.trajectory.controls[:, 0] - [0.1, 0]).max() > 0.02


def test_rolling_the_executed_controls_out_again_gives_the_episode() -> None:
    env = navigation_v0.parallel_env(scenario="four_obstacles", num_robots=6, control_noise_std=0.3)
    problem = env.unwrapped.problem
    episode = run_episode(env, make_policy("go-to-goal"), seed=8)
    steps = len(episode.trajectory.controls)
    again = get_sampling_engine("cpu").rollout(problem.replace(horizon=steps), episode.trajectory.controls)
    np.testing.assert_allclose(again.states, episode.trajectory.states, atol=1e-4)
    for name in ("arrived", "collided", "margin_violated"):
        np.testing.assert_array_equal(getattr(again, name), getattr(episode.trajectory, name), err_msg=name)
    np.testing.assert_allclose(again.rewards, episode.trajectory.rewards, atol=1e-4)


def test_a_shorter_episode() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([2.0]), max_cycles=7)
    episode = run_episode(env, Script(np.zeros((100, 1, 2))))
    assert len(episode.trajectory.controls) == 7
    assert episode.metrics["makespan"] == pytest.approx(0.7)


def test_every_episode_of_random_instances_is_of_its_own_problem() -> None:
    env = navigation_v0.parallel_env(scenario="random", num_robots=3, randomize_instance=True)
    starts = []
    for seed in (0, 1, 0):
        episode = run_episode(env, make_policy("go-to-goal"), seed=seed)
        np.testing.assert_array_equal(episode.trajectory.states[0], env.unwrapped.problem.start)
        starts.append(episode.trajectory.states[0])
    np.testing.assert_array_equal(starts[0], starts[2])
    assert not np.allclose(starts[0], starts[1])


def test_lifelong_metrics_count_goals_and_nothing_that_has_no_meaning_there() -> None:
    # Every goal is a metre or so away at 1 m/s, so half a minute sees several.
    env = navigation_v0.parallel_env(
        scenario="random", num_robots=2, size=3.0, model="velocity2d", lifelong=True, max_cycles=300
    )
    metrics = run_episode(env, make_policy("go-to-goal"), seed=0).metrics
    assert metrics["steps"] == 300
    assert metrics["goals_reached"] >= 10
    assert metrics["goals_per_robot_minute"] == pytest.approx(metrics["goals_reached"] / (2 * 30 / 60))
    assert "mean_squared_jerk" in metrics
    # Nobody ever comes to an end, so to call that a failure, or the duration a makespan, would mislead.
    assert not {"success", "makespan", "travel_time", "arrived"} & set(metrics)


def test_a_plan_of_a_lifelong_problem_runs_out_and_the_episode_goes_on() -> None:
    problem = hop_problem()
    plan = cheap_planner("d4orm").solve(problem)
    env = navigation_v0.parallel_env(problem=problem, lifelong=True, max_cycles=50)
    assert len(run_episode(env, OpenLoop(plan=plan)).trajectory.controls) == 50


@pytest.mark.parametrize("seed", [-1, 0.5, True])
def test_a_bad_seed_is_refused(seed: Any) -> None:
    env = navigation_v0.parallel_env(problem=make_problem("circle", num_robots=2))
    with pytest.raises(ValueError, match="seed"):
        run_episode(env, make_policy("go-to-goal"), seed=seed)


def test_a_range_without_rays_is_refused() -> None:
    with pytest.raises(ValueError, match="ray_range is of range sensors, and these robots have none"):
        open_env(hop_problem(), ray_range=3.0)
    assert open_env(hop_problem(), ray_range=3.0, observed_rays=4).unwrapped.options.ray_range == 3.0


@pytest.mark.parametrize("cycles", [None, 20])
def test_executed_controls_begin_a_plan(cycles: int | None) -> None:
    problem = line_problem([0.35, 1.5])
    horizon = problem.horizon if cycles is None else min(problem.horizon, cycles)
    env = navigation_v0.parallel_env(problem=problem, max_cycles=cycles)
    episode = run_episode(env, "go-to-goal")
    steps = min(len(episode.trajectory.controls), horizon)
    assert episode.controls.shape == (problem.horizon, 2, problem.control_size)
    np.testing.assert_array_equal(episode.controls[:steps], episode.trajectory.controls[:steps])
    assert not episode.controls[steps:].any()


def test_a_planner_has_nothing_to_do_where_an_episode_was_a_solution() -> None:
    problem = make_problem("random", 2, 3)
    episode = run_episode(navigation_v0.parallel_env(problem=problem), "ppo")
    assert episode.metrics["success"] == 1
    plan = cheap_planner("d4orm-d").solve(problem, seed=0, initial_controls=episode.controls)
    assert plan.solved
    assert plan.iterations == 0


def test_a_policy_that_changes_its_observations_changes_no_record() -> None:
    class InPlace(Policy):
        def act(self, observations: Any, state: Any) -> Any:
            actions = {agent: 0.1 * row[:2] for agent, row in observations.items()}
            for row in observations.values():
                row /= 100
            return actions

    class Pure(Policy):
        def act(self, observations: Any, state: Any) -> Any:
            return {agent: 0.1 * row[:2] for agent, row in observations.items()}

    seen = [
        run_episode(navigation_v0.parallel_env("random", num_robots=2, horizon=5), policy, seed=0).observations
        for policy in (InPlace(), Pure())
    ]
    for one, other in zip(*seen, strict=True):
        for agent in one:
            np.testing.assert_array_equal(one[agent], other[agent])
