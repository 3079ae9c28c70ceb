"""The environment for RLlib: it agrees with PettingZoo's, ends for all, and an algorithm learns from it."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ray.rllib", reason="RLlib is not installed: it asks for Gymnasium 1.2.2", exc_type=ImportError)

from ray.rllib.algorithms.ppo import PPOConfig

from d4orm_env import navigation_v0
from d4orm_env.integrations.rllib import RLlibNavigation
from d4orm_planners import make_policy

WORLD = {"scenario": "circle", "num_robots": 3, "max_cycles": 150}


def test_steps_are_those_of_pettingzoo() -> None:
    ours, theirs = RLlibNavigation(WORLD), navigation_v0.parallel_env(**WORLD)
    observations, _ = ours.reset(seed=1)
    expected, _ = theirs.reset(seed=1)
    assert observations.keys() == expected.keys() == set(ours.agents)
    for _ in range(5):
        actions = {agent: ours.action_spaces[agent].sample() for agent in ours.agents}
        *mine, infos = ours.step(actions)
        *others, expected_infos = theirs.step(actions)
        for got, wanted in zip(mine, others):
            assert {agent: np.asarray(got[agent]).tolist() for agent in wanted} == {
                agent: np.asarray(value).tolist() for agent, value in wanted.items()
            }
        assert all(infos[agent] == info | {"is_success": False} for agent, info in expected_infos.items())


@pytest.mark.parametrize(("robots", "cycles", "terminated"), [(1, 150, True), (3, 5, False)])
def test_an_episode_ends_for_all(robots: int, cycles: int, terminated: bool) -> None:
    env = RLlibNavigation(WORLD | {"num_robots": robots, "max_cycles": cycles})
    observations, _ = env.reset(seed=0)
    policy = make_policy("go-to-goal")
    policy.reset(env.env, seed=0)
    over = False
    while not over:
        observations, _, ended, late, infos = env.step(policy.act(observations, env.env.state()))
        over = ended["__all__"] or late["__all__"]
    assert (ended["__all__"], late["__all__"]) == (terminated, not terminated)
    assert env.agents == []
    assert all(info["is_success"] is terminated for info in infos.values())


def test_a_robot_that_arrives_when_time_is_up_for_another_ends_the_episode() -> None:
    policy, env = make_policy("go-to-goal"), RLlibNavigation(WORLD | {"scenario": "random", "num_robots": 2, "seed": 0})
    observations, _ = env.reset(seed=0)
    policy.reset(env.env, seed=0)
    steps = 0
    while len(env.agents) == 2:  # until the first arrives
        observations, *_ = env.step(policy.act(observations, env.env.state()))
        steps += 1
    env.env.max_cycles = steps
    observations, _ = env.reset(seed=0)
    policy.reset(env.env, seed=0)
    for _ in range(steps):
        observations, _, ended, late, _ = env.step(policy.act(observations, env.env.state()))
    assert sorted(late[agent] for agent in env.possible_agents) == [False, True]
    assert (ended["__all__"], late["__all__"]) == (False, True)


def test_unknown_arguments_are_refused() -> None:
    with pytest.raises(TypeError, match="colour"):
        RLlibNavigation({"colour": "red"})


def test_ppo_takes_a_step_of_training() -> None:
    config = PPOConfig().environment(RLlibNavigation, env_config={"num_robots": 2, "reward": "training"})
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=4, rollout_fragment_length=16)
    config.multi_agent(policies={"robot"}, policy_mapping_fn=lambda agent, episode, **others: "robot")
    config.training(train_batch_size_per_learner=64, minibatch_size=64, num_epochs=1)
    algorithm = config.build_algo()
    try:
        result = algorithm.train()
    finally:
        algorithm.stop()
    assert result["env_runners"]["num_env_steps_sampled"] == 64
    assert np.isfinite(result["learners"]["robot"]["total_loss"])
