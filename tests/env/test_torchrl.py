"""The batched environment for TorchRL: its specs, the same worlds behind it, and episodes that begin one by one."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from env_support import line_problem

pytest.importorskip("torchrl")

from torchrl.envs.utils import check_env_specs

from d4orm_env import make_problem
from d4orm_env.integrations.torchrl import TorchRLNavigation

SETTINGS: dict[str, Any] = {"num_robots": 3, "reward": "training", "max_cycles": 12}


@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive", "holonomic3d"])
def test_it_keeps_to_its_specs(model: str) -> None:
    env = TorchRLNavigation(2, "random", model=model, seed=0, **SETTINGS)
    check_env_specs(env)
    assert env.group_map == {"robots": ["robot_0", "robot_1", "robot_2"]}
    limits = make_problem("random", 3, model=model).team.control_limits
    np.testing.assert_array_equal(env.action_spec["robots", "action"].space.high[1].numpy(), limits)
    env.close()


def test_it_is_the_batched_environment() -> None:
    env = TorchRLNavigation(4, "random", seed=7, **SETTINGS)
    worlds = gymnasium.make_vec(
        "d4orm/Navigation-v0", 4, vectorization_mode="vector_entry_point", scenario="random",
        autoreset_mode="Disabled", **SETTINGS,
    )  # fmt: skip
    observations, _ = worlds.reset(seed=7)
    data = env.reset()
    for step in range(12):
        np.testing.assert_array_equal(data["robots", "observation"].reshape(4, -1).numpy(), observations)
        data = env.rand_action(data)
        actions = data["robots", "action"].reshape(4, -1).numpy()
        data = env.step(data)["next"]
        observations, _, terminated, truncated, infos = worlds.step(actions)
        np.testing.assert_array_equal(data["terminated"][:, 0].numpy(), terminated)
        np.testing.assert_array_equal(data["truncated"][:, 0].numpy(), truncated)
        np.testing.assert_array_equal(data["robots", "info", "acting"][..., 0].numpy(), ~infos["arrived"])
        np.testing.assert_array_equal(data["robots", "reward"][..., 0].numpy(), worlds.unwrapped.robot_rewards)
        assert bool(data["done"].all()) == (step == 11)
    env.close()
    worlds.close()


def test_the_first_arrival_ends_no_episode_and_is_paid_for_once() -> None:
    problem = line_problem([0.35, 1.5], "holonomic2d")
    env = TorchRLNavigation(1, problem=problem, reward="training", max_cycles=20)
    data, acting, rewards = env.reset(), [], []
    forward = np.array([[[1.0, 0.0], [0.0, 0.0]]], np.float32)
    for _ in range(20):
        data["robots", "action"] = data["robots", "observation"].new_tensor(forward)
        data = env.step(data)["next"]
        acting.append(bool(data["robots", "info", "acting"][0, 0, 0]))
        rewards.append(float(data["robots", "reward"][0, 0, 0]))
        if bool(data["done"]):
            break
    arrived = acting.index(False)
    assert 0 < arrived < 12
    assert rewards[arrived] > 0
    assert rewards[arrived + 1 :] == [0.0] * (19 - arrived)
    assert bool(data["truncated"])
    assert not bool(data["robots", "info", "success"].any())
    env.close()


def test_worlds_begin_anew_one_by_one_and_by_their_seed() -> None:
    env, other = (TorchRLNavigation(3, "random", seed=5, **SETTINGS) for _ in range(2))
    rollout = env.rollout(30, break_when_any_done=False)
    assert rollout["next", "done"][..., 0].sum(dim=1).tolist() == [2, 2, 2]
    begun = rollout["robots", "observation"]
    assert not bool((begun[:, 0] == begun[:, 12]).all())  # another instance
    again = other.rollout(1)["robots", "observation"]
    np.testing.assert_array_equal(again[:, 0].numpy(), begun[:, 0].numpy())
    other.set_seed(5)
    np.testing.assert_array_equal(other.reset()["robots", "observation"].numpy(), begun[:, 0].numpy())
    for each in (env, other):
        each.close()


def test_bad_arguments_are_named() -> None:
    with pytest.raises(TypeError, match="takes no argument 'colour'"):
        TorchRLNavigation(2, "random", colour="red")
    with pytest.raises(ValueError, match="num_envs is 0"):
        TorchRLNavigation(0, "random")
