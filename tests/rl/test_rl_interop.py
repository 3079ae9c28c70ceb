"""The environments in the reinforcement learning libraries that people use."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from env_support import line_problem, sampled_actions, straight_drive

from d4orm_env import navigation_v0
from d4orm_env.envs.joint_env import ENV_ID, register_environments

# TorchRL names the one release of PettingZoo it is tested with, and warns about every other.
ignore_torchrl_version = pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested using version")

UNIT_MODELS = ("holonomic2d", "velocity2d", "holonomic3d")


def one_after_another(model: str) -> Any:
    """A team whose robots arrive one by one, driven straight or drifting under random actions."""
    return line_problem([0.3, 0.5, 0.9], model, goal_radius=0.25)


@pytest.mark.parametrize("model", [*UNIT_MODELS, "differential_drive"])
def test_stable_baselines3_accepts_the_joint_env(model: str) -> None:
    env_checker = pytest.importorskip("stable_baselines3.common.env_checker")
    register_environments()
    env = gymnasium.make(ENV_ID, num_robots=3, model=model, render_mode="rgb_array").unwrapped
    with warnings.catch_warnings():
        if model not in UNIT_MODELS:
            # Actions are in physical units on purpose, and the turn rate exceeds 1.
            warnings.filterwarnings("ignore", "We recommend you to use a symmetric and normalized Box action space")
        env_checker.check_env(env, skip_render_check=False)


def test_stable_baselines3_trains_on_the_joint_env() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    register_environments()
    env = gymnasium.make(ENV_ID, num_robots=2, max_cycles=20)
    model = sb3.PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(64)
    assert model.num_timesteps == 64


@pytest.mark.parametrize("base_class", ["gymnasium", "stable_baselines3"])
@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive"])
def test_supersuit_pipeline(base_class: str, model: str) -> None:
    supersuit = pytest.importorskip("supersuit")
    problem = one_after_another(model)
    env = navigation_v0.parallel_env(problem=problem, max_cycles=25)
    size = env.observation_space("robot_0").shape[0]
    vec = supersuit.pettingzoo_env_to_vec_env_v1(supersuit.black_death_v3(env))
    envs = supersuit.concat_vec_envs_v1(vec, 2, num_cpus=0, base_class=base_class)
    result = envs.reset()
    observations = result if base_class == "stable_baselines3" else result[0]
    assert observations.shape == (6, size)
    ended, gone = 0, 0
    actions = np.tile(straight_drive(problem)[0], (2, 1))
    for _ in range(120):
        observations, rewards, *ends, _infos = envs.step(actions)
        assert observations.shape == (6, size)
        assert observations.dtype == np.float32
        assert np.isfinite(rewards).all()
        # Three robots are one world: after the last has ended, all begin again together.
        done = np.any(ends, axis=0).reshape(2, 3)
        assert (done.all(axis=1) == done.any(axis=1)).all()
        ended += int(done.all(axis=1).sum())
        gone += int((~observations.any(axis=1)).sum())
    assert ended >= 2
    assert gone > 0


def test_supersuit_with_stable_baselines3_trains() -> None:
    supersuit, sb3 = pytest.importorskip("supersuit"), pytest.importorskip("stable_baselines3")
    env = navigation_v0.parallel_env("circle", 3, max_cycles=15)
    vec = supersuit.pettingzoo_env_to_vec_env_v1(supersuit.black_death_v3(env))
    envs = supersuit.concat_vec_envs_v1(vec, 2, num_cpus=0, base_class="stable_baselines3")
    model = sb3.PPO("MlpPolicy", envs, n_steps=20, batch_size=60, n_epochs=1, device="cpu")
    model.learn(120)
    assert model.num_timesteps == 120


@ignore_torchrl_version
@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive", "holonomic3d"])
def test_torchrl_accepts_the_parallel_env(model: str) -> None:
    pytest.importorskip("torchrl")
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper
    from torchrl.envs.utils import check_env_specs

    base = navigation_v0.parallel_env(problem=one_after_another(model), max_cycles=25)
    env = PettingZooWrapper(base, return_state=True, use_mask=True, done_on_any=False, device="cpu")
    env.set_seed(0)
    check_env_specs(env)
    rollout = env.rollout(60, break_when_any_done=True)
    mask = rollout["next", "robot", "mask"]
    assert len(rollout) <= 25
    assert bool(rollout["next", "done"][-1])
    # Once a robot is masked out it stays out.
    assert not (mask[1:].int() - mask[:-1].int() > 0).any()
    assert not mask[-1].any()


@ignore_torchrl_version
def test_torchrl_sees_the_same_episode() -> None:
    pytest.importorskip("torchrl")
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper

    base = navigation_v0.parallel_env("circle", 3)
    env = PettingZooWrapper(navigation_v0.parallel_env("circle", 3), use_mask=True, done_on_any=False, device="cpu")
    data = env.reset()
    observations, _ = base.reset()
    for _ in range(5):
        actions = sampled_actions(base)
        data["robot", "action"] = data["robot", "observation"].new_tensor(np.stack(list(actions.values())))
        data = env.step(data)["next"]
        observations, rewards, *_ = base.step(actions)
        np.testing.assert_array_equal(data["robot", "observation"].numpy(), np.stack(list(observations.values())))
        np.testing.assert_allclose(data["robot", "reward"].numpy().ravel(), list(rewards.values()), rtol=1e-6)


@ignore_torchrl_version
def test_torchrl_makes_the_joint_env_by_name() -> None:
    pytest.importorskip("torchrl")
    from torchrl.envs.libs.gym import GymEnv

    register_environments()
    env = GymEnv(ENV_ID, num_robots=2, max_cycles=15, device="cpu")
    env.set_seed(0)
    rollout = env.rollout(30)
    assert len(rollout) == 15
    assert bool(rollout["next", "truncated"][-1])
    assert rollout["observation"].shape[-1] == env.observation_spec["observation"].shape[-1]
    with pytest.raises(TypeError, match="unexpected keyword argument 'colour': scenario 'circle' takes no argument"):
        GymEnv(ENV_ID, num_robots=2, colour="red")


@ignore_torchrl_version
@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_torchrl_wraps_the_batched_env(mode: str) -> None:
    pytest.importorskip("torchrl")
    from torchrl.envs.libs.gym import GymWrapper

    register_environments()
    base = gymnasium.make_vec(
        ENV_ID, num_envs=3, vectorization_mode="vector_entry_point", num_robots=2, max_cycles=15, autoreset_mode=mode
    )
    assert base.unwrapped.autoreset_mode.value == mode
    env = GymWrapper(base, device="cpu")
    assert env.batch_size == (3,)
    rollout = env.rollout(40, break_when_any_done=False)
    done = rollout["next", "done"][..., 0]
    assert done.shape == (3, 40)
    assert done[:, [14, 29]].all()
    assert int(done.sum()) == 6
