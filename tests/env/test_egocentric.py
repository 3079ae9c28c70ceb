"""Egocentric environments: all show and do the same, whatever way a world is turned, and policies leave them alone."""

from __future__ import annotations

import math
from typing import Any

import jax
import numpy as np
import pytest
from env_support import mixed_problem, slow

from d4orm_env import make_problem, navigation_v0
from d4orm_env.core.observation_layout import ObservationSlices
from d4orm_env.core.problem import Problem
from d4orm_env.envs.features import Features
from d4orm_env.envs.joint_env import JointNavigationEnv
from d4orm_env.envs.vector_env import NavigationVectorEnv
from d4orm_env.jax.functional_env import FunctionalEnv
from d4orm_planners import make_policy, run_episode
from d4orm_planners.base.adapters import SharedPolicy

MODELS = ("holonomic2d", "differential_drive")


def stacked(values: dict[str, Any]) -> np.ndarray:
    return np.stack(list(values.values()))


def steer(features: np.ndarray) -> np.ndarray:
    """Ahead, and a little aside by what is seen."""
    return np.tanh(np.stack([1 + features[:, 0], features[:, 12] - features[:, 9]], axis=1)).astype(np.float32)


@pytest.mark.parametrize("model", [slow("holonomic2d"), "differential_drive"])
def test_all_environments_show_and_do_the_same(model: str) -> None:
    problem, random = make_problem("random", num_robots=3, seed=2, model=model), np.random.default_rng(0)
    options: dict[str, Any] = {"problem": problem, "reward": "training", "egocentric": True, "max_cycles": 12}
    parallel, joint = navigation_v0.parallel_env(**options), JointNavigationEnv(**options)
    batched, pure = NavigationVectorEnv(2, autoreset_mode="SameStep", **options), FunctionalEnv(**options)
    seen, _ = parallel.reset(seed=0)
    space, acts = parallel.observation_space("robot_0"), parallel.action_space("robot_0")
    assert (acts.low == -1).all()
    assert (acts.high == 1).all()
    assert pure.observation_shape == (3, *space.shape)
    first = stacked(seen)
    rest = joint.reset(seed=0)[0], batched.reset(seed=0)[0][1]
    (state, pure_seen), advance = pure.reset(jax.random.key(0)), jax.jit(pure.advance)
    for step in range(12):
        assert all(space.contains(row) for row in stacked(seen))
        np.testing.assert_array_equal(stacked(seen).ravel(), rest[0])
        np.testing.assert_array_equal(rest[0], rest[1])
        np.testing.assert_allclose(pure_seen, stacked(seen), atol=1e-4)
        actions = random.normal(size=(3, *acts.shape)).astype(np.float32)
        seen, rewards, _, truncated, _ = parallel.step(dict(zip(parallel.agents, actions)))
        once, *_ = joint.step(actions.ravel())
        many, *_, infos = batched.step(np.tile(actions.ravel(), (2, 1)))
        state, transition = advance(jax.random.key(0), state, actions)
        pure_seen, rest = transition.observations, (once, many[1])
        np.testing.assert_allclose(transition.rewards, list(rewards.values()), atol=1e-3)
        assert all(truncated.values()) == (step == 11)
    # The batch has begun anew, and keeps what was seen last.
    np.testing.assert_array_equal(infos["final_obs"][1], once)
    np.testing.assert_array_equal(many[1].reshape(3, -1), first)


@pytest.mark.parametrize("slices", [ObservationSlices(2, 3, 2, num_rays=8), ObservationSlices(3, 3, 0)])
def test_features_are_the_same_in_jax(slices: ObservationSlices) -> None:
    features = Features.of(slices, f"holonomic{slices.dimension}d")
    seen = np.abs(np.random.default_rng(0).normal(size=(4, slices.size))).astype(np.float32)
    (shown, frames), pure = features.encode(seen), features.encode(jax.numpy.asarray(seen))
    np.testing.assert_allclose(pure[0], shown, atol=1e-4)
    actions = seen[:, : slices.dimension] - 1
    limits = np.full_like(actions, 2)
    np.testing.assert_allclose(
        features.decode(jax.numpy.asarray(actions), pure[1], limits),
        features.decode(actions, frames, limits),
        atol=1e-4,
    )


def turned(problem: Problem, angle: float) -> Problem:
    cosine, sine = math.cos(angle), math.sin(angle)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    start = np.array(problem.start, np.float64)
    start[:, :2] = start[:, :2] @ rotation
    return Problem(problem.team, start, problem.goal @ rotation, dt=problem.dt, horizon=problem.horizon)


@pytest.mark.parametrize("model", ["holonomic2d", "velocity2d", "holonomic2d_jerk"])
def test_a_turned_world_is_the_same_world(model: str) -> None:
    problem = make_problem("random", num_robots=3, seed=4, model=model)
    envs = [navigation_v0.parallel_env(problem=one, egocentric=True) for one in (problem, turned(problem, 2.1))]
    seen = [stacked(env.reset(seed=0)[0]) for env in envs]
    for _ in range(20):
        np.testing.assert_allclose(seen[0], seen[1], atol=1e-3)
        actions = steer(seen[0])
        seen = [stacked(env.step(dict(zip(env.agents, actions)))[0]) for env in envs]


def test_full_ahead_leads_to_the_goal() -> None:
    env = navigation_v0.parallel_env("random", num_robots=1, egocentric=True, goal_speed=math.inf)
    for seed in range(3):
        env.reset(seed=seed)
        while env.agents:
            env.step({"robot_0": np.array([1, 0], np.float32)})
        assert env.metrics()["success"] == 1


@pytest.mark.parametrize("model", MODELS)
def test_what_learned_there_drives_in_plain_environments(model: str) -> None:
    options: dict[str, Any] = {"scenario": "random", "num_robots": 3, "model": model, "goal_speed": math.inf}
    env = navigation_v0.parallel_env(**options, egocentric=True)
    observations, _ = env.reset(seed=6)
    while env.agents:
        observations, *_ = env.step(dict(zip(env.agents, steer(stacked({a: observations[a] for a in env.agents})))))
    policy = SharedPolicy(steer, None, egocentric=True)
    episode = run_episode(navigation_v0.parallel_env(**options), policy, seed=6)
    assert {name: episode.metrics[name] for name in env.metrics()} == pytest.approx(env.metrics())


def test_policies_brake_where_the_goal_speed_is_limited() -> None:
    env = navigation_v0.parallel_env("random", num_robots=1)
    assert np.isfinite(env.problem.goal_speed).all()
    ahead = SharedPolicy(lambda seen: np.tile(np.float32([1, 0]), (len(seen), 1)), None, egocentric=True)
    assert run_episode(env, ahead, seed=0).metrics["success"] == 1


def test_what_makes_no_sense_is_refused() -> None:
    with pytest.raises(ValueError, match="observed_path"):
        navigation_v0.parallel_env("random", num_robots=2, egocentric=True, observed_path=True)
    with pytest.raises(ValueError, match="egocentric is 1"):
        navigation_v0.parallel_env("random", num_robots=2, egocentric=1)
    with pytest.raises(ValueError, match="the team mixes"):
        navigation_v0.parallel_env(problem=mixed_problem(), egocentric=True)
    env = navigation_v0.parallel_env("random", num_robots=2, egocentric=True)
    for policy in (make_policy("go-to-goal"), SharedPolicy(steer, None, egocentric=True)):
        with pytest.raises(ValueError, match="this environment is egocentric"):
            run_episode(env, policy, seed=0)
