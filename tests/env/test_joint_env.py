from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from env_support import line_problem, mixed_problem, scenario_params, straight_drive
from gymnasium.utils.env_checker import check_env, data_equivalence

from d4orm_env import navigation_v0
from d4orm_env.envs.joint_env import ENV_ID, JointNavigationEnv, register_environments
from d4orm_env.scenarios import make_problem


@pytest.fixture(autouse=True)
def _registered() -> None:
    register_environments()


def check(**arguments: Any) -> None:
    """Gymnasium's own checks, nothing skipped."""
    env = gymnasium.make(ENV_ID, **arguments).unwrapped
    with warnings.catch_warnings():
        if np.abs(env.action_space.high).max() > 1:
            # Actions are in physical units on purpose, and a turn rate exceeds 1.
            warnings.filterwarnings("ignore", ".*we recommend using a symmetric and normalized space.*")
        check_env(env)
    env.close()


@pytest.mark.parametrize("case", [case for case in scenario_params(3) if not case.marks])
def test_gymnasium_accepts_it(case: dict[str, Any]) -> None:
    check(**case)


@pytest.mark.parametrize(
    "case",
    [
        {"problem": mixed_problem()},
        {"num_robots": 1, "lifelong": True},
        {"num_robots": 2, "control_noise_std": 0.2},
        {"scenario": "random", "num_robots": 2, "randomize_instance": True},
    ],
    ids=["mixed-team", "lifelong", "noise", "new-instances"],
)
def test_gymnasium_accepts_variants(case: dict[str, Any]) -> None:
    check(**case)


def test_registering_twice_changes_nothing() -> None:
    spec = gymnasium.registry[ENV_ID]
    register_environments()
    assert gymnasium.registry[ENV_ID] is spec


def test_it_agrees_with_the_parallel_env() -> None:
    problem = make_problem("circle", num_robots=4)
    joint = gymnasium.make(ENV_ID, problem=problem, control_noise_std=0.1)
    parallel = navigation_v0.parallel_env(problem=problem, control_noise_std=0.1)
    observation, info = joint.reset(seed=3)
    observations, infos = parallel.reset(seed=3)
    np.testing.assert_array_equal(observation, np.concatenate(list(observations.values())))
    assert info["agents"] == infos
    for control in straight_drive(problem, [1, 0.9, 0.8, 0.7])[:20]:
        observation, reward, terminated, truncated, info = joint.step(control.ravel())
        observations, rewards, _, _, infos = parallel.step(dict(zip(parallel.agents, control)))
        np.testing.assert_array_equal(observation, np.concatenate(list(observations.values())))
        assert type(reward) is float
        assert reward == pytest.approx(np.mean(list(rewards.values())), abs=1e-6)
        assert (terminated, truncated) == (False, False)
        assert info["agents"] == infos
        assert info["metrics"] == parallel.metrics()
    np.testing.assert_array_equal(joint.unwrapped.state(), parallel.state())


def test_terminates_when_all_have_arrived() -> None:
    env = gymnasium.make(ENV_ID, problem=line_problem([0.2, 0.4]))
    _, info = env.reset()
    assert info["is_success"] is False
    ends = [env.step(np.array([1, 0, 1, 0], np.float32))[2:] for _ in range(4)]
    assert [(terminated, truncated) for terminated, truncated, _ in ends] == [(False, False)] * 3 + [(True, False)]
    assert [info["agents"]["robot_0"]["arrived"] for *_, info in ends] == [False, True, True, True]
    assert [info["is_success"] for *_, info in ends] == [False, False, False, True]
    with pytest.raises(RuntimeError, match="episode is over"):
        env.unwrapped.step(np.zeros(4, np.float32))


def test_truncates_at_the_horizon() -> None:
    env = gymnasium.make(ENV_ID, problem=line_problem([0.1, 5.0]), max_cycles=3)
    env.reset()
    ends = [env.step(np.array([1, 0, 1, 0], np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    with pytest.raises(RuntimeError, match="episode is over"):
        env.unwrapped.step(np.zeros(4, np.float32))


def test_spaces_follow_the_robots_own_limits() -> None:
    env = JointNavigationEnv(problem=mixed_problem())
    np.testing.assert_allclose(env.action_space.high, [0.5, 0.5, np.pi / 2, 0.5, 2, 2], rtol=1e-6)
    np.testing.assert_array_equal(env.action_space.low, -env.action_space.high)
    per_robot = navigation_v0.parallel_env(problem=mixed_problem()).observation_space("robot_0").shape
    assert env.observation_space.shape == (3 * per_robot[0],)
    assert env.action_space.dtype == env.observation_space.dtype == np.float32


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(3), "action has shape"),
        (np.zeros((2, 2)), "action has shape"),
        (np.array([0, 0, np.nan, 0]), "action of robot_1"),
        (np.array([0, 1e300, 0, 0]), "action of robot_0"),
        (np.array([0, 0, 2e19, 0]), r"action of robot_1 is .*; every value must be finite and at most 1e\+15"),
        (None, "action has shape"),
        (["a", "b", "c", "d"], "action must be an array of"),
        ([10**400, 0, 0, 0], "action must be an array of .* too large for a float"),
    ],
)
def test_bad_actions_are_refused(action: np.ndarray, message: str) -> None:
    env = JointNavigationEnv(num_robots=2)
    env.reset()
    with pytest.raises(ValueError, match=message):
        env.step(action)


def test_options_that_would_be_ignored_are_refused() -> None:
    env = JointNavigationEnv(num_robots=2)
    with pytest.raises(ValueError, match="reset takes no option 'problem'"):
        env.reset(options={"problem": env.problem})


def test_calls_before_reset_are_refused() -> None:
    with pytest.raises(RuntimeError, match="reset"):
        JointNavigationEnv(num_robots=2).step(np.zeros(4, np.float32))


def test_a_seed_is_a_whole_number_of_any_kind() -> None:
    env = JointNavigationEnv("random", 2)
    np.testing.assert_array_equal(env.reset(seed=np.int64(3))[0], env.reset(seed=3)[0])
    for seed, message in ((-1, "seed is -1; it must be at least 0"), (1.5, "seed must be a whole number")):
        with pytest.raises(ValueError, match=message):
            env.reset(seed=seed)


def test_episodes_repeat_with_their_seed() -> None:
    def log(seed: int) -> list[Any]:
        env = gymnasium.make(ENV_ID, num_robots=2, control_noise_std=0.2)
        env.action_space.seed(0)
        return [env.reset(seed=seed), *(env.step(env.action_space.sample()) for _ in range(100))]

    assert data_equivalence(log(0), log(0), exact=True)
    assert not data_equivalence(log(0), log(1))


def test_vectorised_by_gymnasium() -> None:
    envs = gymnasium.make_vec(ENV_ID, num_envs=2, vectorization_mode="sync", scenario="circle", num_robots=2)
    observations, _ = envs.reset(seed=0)
    assert observations.shape == envs.observation_space.shape
    for _ in range(3):
        _, rewards, _, _, infos = envs.step(envs.action_space.sample())
    assert rewards.shape == (2,)
    assert infos["metrics"]["steps"].tolist() == [3, 3]
    envs.close()
