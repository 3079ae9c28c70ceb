"""The environment for JaxMARL: its API, and the same worlds behind it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from d4orm_env import make_problem

pytest.importorskip("jaxmarl", reason="JaxMARL is not installed: it asks for an older Gymnasium")

from d4orm_env.integrations.jaxmarl import JaxMARLNavigation
from d4orm_env.jax.functional_env import FunctionalEnv

PROBLEM = make_problem("circle", num_robots=2, model="velocity2d")
KEY = jax.random.key(0)


def test_it_steps_the_same_world_robot_by_robot() -> None:
    options = {"problem": PROBLEM, "reward": "training", "max_cycles": 8}
    env, world = JaxMARLNavigation(**options), FunctionalEnv(**options)
    assert env.agents == ["robot_0", "robot_1"]
    assert env.num_agents == 2
    assert env.agent_classes == {"robots": env.agents}
    observations, state = env.reset(KEY)
    expected_state, expected = world.reset(KEY)
    limit = env.action_space("robot_0").high
    dones = []
    advance = jax.jit(world.advance)
    for count in range(10):
        if count < 8:
            np.testing.assert_allclose([observations[agent] for agent in env.agents], expected, atol=1e-6)
        for agent in env.agents:
            assert observations[agent].shape == env.observation_space(agent).shape
            assert bool(env.observation_space(agent).contains(observations[agent]))
        actions = {agent: (-1) ** robot * limit * 0.5 for robot, agent in enumerate(env.agents)}
        observations, state, rewards, done, infos = env.step(KEY, state, actions)
        dones.append(bool(done["__all__"]))
        assert set(done) == {*env.agents, "__all__"}
        assert infos["distance_to_goal"].shape == (2,)
        expected_state, transition = advance(KEY, expected_state, jnp.stack([actions[agent] for agent in env.agents]))
        expected = transition.observations
        if count < 8:
            np.testing.assert_allclose([rewards[agent] for agent in env.agents], transition.rewards, atol=1e-5)
    assert dones == [False] * 7 + [True, False, False]
    assert int(state.team.steps) == 2
    np.testing.assert_allclose(env.get_obs(state)["robot_1"], observations["robot_1"], atol=1e-6)


def test_who_has_arrived_is_done_and_earns_nothing_more() -> None:
    near = PROBLEM.replace(goal=PROBLEM.start[:, :2] + np.array([[0.15, 0], [-3, 0]], np.float32))
    env = JaxMARLNavigation(problem=near)
    _, state = env.reset(KEY)
    ahead = {"robot_0": jnp.array([1.0, 0.0]), "robot_1": jnp.array([0.0, 0.0])}
    for _ in range(3):
        _, state, rewards, done, _ = env.step(KEY, state, ahead)
    assert (bool(done["robot_0"]), bool(done["robot_1"]), bool(done["__all__"])) == (True, False, False)
    assert float(rewards["robot_0"]) == 0.0
