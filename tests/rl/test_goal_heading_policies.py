"""Policies and goal headings: who has learned to read them does, and who has not acts as without."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d4orm_env import Problem, make_problem, navigation_v0
from d4orm_planners import make_policy, run_episode
from d4orm_planners.rl.learned import SHIPPED
from d4orm_planners.rl.network import load_network

pytest.importorskip("stable_baselines3")
from d4orm_planners.rl.imitation import record_samples
from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.training import TrainingSettings, train

DRIVES: dict[str, Any] = {"model": "differential_drive"}
PLAIN = make_problem("random", num_robots=2, seed=1, **DRIVES)
TURNING = PLAIN.replace(goal_heading=[1.0, np.nan])
TINY = TrainingSettings(
    scenario="circle", num_robots=2, steps=2 * 16 * 32, num_envs=16, stages=2, validation_worlds=2, seed=5,
    scenario_settings={"goal_heading": 1.0}, **DRIVES,
)  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(TINY, tmp_path_factory.mktemp("turning")).policy_path


def first_actions(problem: Problem, **settings: Any) -> np.ndarray:
    policy = make_policy("ppo", **settings)
    env = navigation_v0.parallel_env(problem=problem, **policy.observation_options(problem))
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    return np.stack(list(policy.act(observations, env.state()).values()))


def test_a_policy_trained_without_acts_as_without() -> None:
    np.testing.assert_array_equal(first_actions(TURNING), first_actions(PLAIN))


def test_a_policy_trained_with_them_reads_them(trained: Path) -> None:
    """It was trained in instances of ``random`` too, in which no robot has one."""
    network = load_network(trained)
    assert network.header.goal_headings
    actions = first_actions(TURNING, path=trained)
    assert (actions[0] != first_actions(TURNING.replace(goal_heading=[-2.0, np.nan]), path=trained)[0]).any()
    without = first_actions(PLAIN, path=trained)
    assert (actions[0] != without[0]).any()
    np.testing.assert_array_equal(actions[1], without[1], err_msg="it has none here either")
    for problem in (PLAIN, TURNING):
        run_episode(navigation_v0.parallel_env(problem=problem, max_cycles=5), make_policy("ppo", path=trained), seed=0)


def test_a_training_goes_on_with_policies_that_read_the_same(trained: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"start_from is .*policy.safetensors, which reads goal headings; give"):
        train(replace(TINY, scenario_settings={}, start_from=str(trained)), tmp_path / "on")


def test_files_of_policies_that_read_none_do_not_speak_of_it() -> None:
    for file in SHIPPED.glob("*.safetensors"):
        assert "goal_headings" not in load_network(file).header.text()


def test_robots_without_one_learn_from_zeros_beside_others() -> None:
    options: dict[str, Any] = {"scenario": "random", "num_robots": 2, "randomize_instance": False, **DRIVES}
    plain = RobotVecEnv(2, **options).reset()
    told = RobotVecEnv(2, goal_headings=True, **options).reset()
    turning = RobotVecEnv(2, goal_heading=0.5, **options).reset()
    np.testing.assert_array_equal(told[:, 11:13], 0)
    np.testing.assert_allclose(np.square(turning[:, 11:13]).sum(axis=1), 1, atol=1e-6)
    for features in (told, turning):
        np.testing.assert_array_equal(np.delete(features, [11, 12], axis=1), plain)


def test_all_parts_of_a_mixture_tell_them() -> None:
    settings = TrainingSettings(mixture=("circle 2 goal_heading=1.0", "random 2"), num_envs=8, **DRIVES)
    worlds = settings.validation()
    features = worlds.reset()
    assert worlds.features.slices.goal_headings
    assert (features[:2, 11:13] != 0).any(axis=1).all()
    assert (features[2:, 11:13] == 0).all()


def given(problem: Problem, seed: int, num_robots: int) -> Problem:
    return problem


def test_policies_are_told_goal_hitch_angles_too(trained: Path) -> None:
    header = load_network(trained).header
    assert header.goal_headings is True, "files say it as before"
    told = header.model_copy(update={"goal_headings": 2})
    assert type(header).model_validate_json(told.text()) == told
    straight = make_problem("circle", num_robots=2, model="car_with_1_trailer", goal_heading=1.0)
    bent = straight.replace(goal_hitches=[[0.2], [np.nan]])
    plain, seen = (RobotVecEnv(1, 2, partial(given, problem)).reset() for problem in (straight, bent))
    np.testing.assert_array_equal(np.delete(seen, [13, 14], axis=1), plain)
    np.testing.assert_allclose(seen[:, 13:15], [[np.cos(0.2), np.sin(0.2)], [0, 0]], atol=1e-6)
    padded = RobotVecEnv(1, 2, partial(given, straight), goal_headings=2).reset()
    np.testing.assert_array_equal(padded[:, 13:15], 0)
    np.testing.assert_array_equal(np.delete(padded, [13, 14], axis=1), plain)


def test_where_robots_look_along_paths_too() -> None:
    options: dict[str, Any] = {"num_robots": 2, "shortest_paths": True, "randomize_instance": False, **DRIVES}
    plain, told = (RobotVecEnv(1, scenario="rooms", goal_headings=told, **options).reset() for told in (None, True))
    np.testing.assert_array_equal(np.delete(told, [11, 12], axis=1), plain)


@pytest.mark.parametrize(("problem", "wanted"), [(PLAIN, True), (TURNING, True), (TURNING, False)])
def test_demonstrations_are_as_the_learner_wants_them(problem: Problem, wanted: bool) -> None:
    env = navigation_v0.parallel_env(problem=problem, max_cycles=3)
    layout = env.unwrapped.layout
    samples = record_samples(env, make_policy("go-to-goal"), 0, goal_headings=wanted)
    assert samples.observations.shape == (6, layout.size + 2 * (wanted - layout.goal_headings))
    if wanted:
        told = samples.observations[:, 12:14]
        assert (told[1::2] == 0).all()
        assert (told[::2] != 0).any() == layout.goal_headings
