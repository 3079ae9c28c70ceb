"""Putting robots elsewhere in the middle of an episode."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from env_support import act, line_problem, mixed_problem

from d4orm_env import navigation_v0
from d4orm_env.envs.joint_state import split_state
from d4orm_env.envs.vector_env import NavigationVectorEnv


def test_a_log_is_replayed() -> None:
    problem = mixed_problem()
    env, replay = (navigation_v0.parallel_env(problem=problem) for _ in range(2))
    env.reset(seed=0), replay.reset(seed=0)
    for control in np.random.default_rng(1).uniform(-1, 1, (5, 3, 2)).astype(np.float32):
        env.step(act(env, control))
        joint = split_state(problem, env.state())
        replay.unwrapped.set_state(joint.states)
        np.testing.assert_array_equal(split_state(problem, replay.state()).states, joint.states)
    assert split_state(problem, replay.state()).steps == 0


def test_flags_and_observations_follow_in_every_environment() -> None:
    problem = line_problem([2.0, 2.0])
    touching = np.float32([[0.5, 0.0], [0.7, 0.0]])
    parallel = navigation_v0.parallel_env(problem=problem)
    joint: Any = gymnasium.make("d4orm/Navigation-v0", problem=problem).unwrapped
    batched = NavigationVectorEnv(2, problem=problem)
    for env in (parallel, joint, batched):
        env.reset(seed=0)
    seen, infos = parallel.unwrapped.set_state(touching)
    flat, joint_infos = joint.set_state(touching)
    rows, batched_infos = batched.set_state(np.stack([touching, problem.start]))
    for agent, robot in zip(parallel.agents, range(2)):
        assert infos[agent] == joint_infos["agents"][agent]
        assert infos[agent]["collided"]
        assert infos[agent]["margin_violated"]
        np.testing.assert_array_equal(seen[agent], flat.reshape(2, -1)[robot])
        assert infos[agent]["distance_to_goal"] == pytest.approx([1.5, np.hypot(1.3, 1)][robot], abs=1e-5)
        assert parallel.observation_space(agent).contains(seen[agent])
    np.testing.assert_allclose(rows[0], flat, atol=1e-6)
    assert batched_infos["collided"].tolist() == [[True, True], [False, False]]
    assert batched_infos["distance_to_goal"][0, 0] == pytest.approx(1.5, abs=1e-5)
    # The next step goes on from there, and the contact counts from then on.
    assert parallel.metrics()["collisions"] == 0
    parallel.step(act(parallel, np.zeros((2, 2), np.float32)))
    batched.step(np.zeros((2, 4), np.float32))
    np.testing.assert_allclose(split_state(problem, parallel.state()).states, touching)
    assert parallel.metrics()["collisions"] == 2
    assert batched.metrics()["collisions"].tolist() == [2, 0]
    assert parallel.state_space.contains(parallel.state())


def test_a_robot_that_has_arrived_stays_so_where_it_is_put() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([0.1, 2.0], model="holonomic2d"))
    env.reset(seed=0)
    env.set_state([[0.05, 0, 1, 0], [0, 1, 0, 0]])
    assert env.agents == ["robot_0", "robot_1"]
    env.step(act(env, np.zeros((2, 2), np.float32)))
    assert env.agents == ["robot_1"]
    observations, infos = env.set_state([[0.5, -1, 0, 0], [0.5, 1, 0, 0]])
    assert [*observations] == [*infos] == ["robot_1"]
    env.step(act(env, np.zeros((2, 2), np.float32)))
    joint = split_state(env.problem, env.state())
    assert joint.arrived.tolist() == [True, False]
    np.testing.assert_allclose(joint.states[0], [0.5, -1, 0, 0])
    with pytest.raises(ValueError, match="robot_0 is moving, but the robot has docked; set its speed to zero"):
        env.set_state([[0.5, -1, 0.1, 0], [0.5, 1, 0, 0]])


def test_agents_that_act_in_turn_see_it_at_once() -> None:
    env = navigation_v0.env(problem=line_problem([2.0, 2.0]))
    env.reset(seed=0)
    env.step(np.zeros(2, np.float32))
    observations, _ = env.unwrapped.set_state([[0.5, 0], [0.7, 0]])
    seen, _, _, _, info = env.last()
    np.testing.assert_array_equal(seen, observations["robot_1"])
    assert info["collided"]


@pytest.mark.parametrize(
    ("states", "message"),
    [
        (np.zeros((2, 4)), r"states has shape \(2, 4\); expected \(3, 4\)"),
        ("far", "states must be an array of numbers"),
        ([[0, 0, 0, 0], [np.nan, 0, 0, 0], [2, 0, 0, 0]], "states.* is nan; every value must be finite"),
        ([[0, 0, 0, 1], [1, 0, 0, 0], [2, 0, 0, 0]], "state of robot_0 is .* set the padding after them to zero"),
        ([[0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 9, 0]], "state speed of robot_2 is 9 m/s, above its limit"),
        ([[0, 0, 0, 0], [1, 0, 0, 0], [900, 0, 0, 0]], "state of robot_2 is .* outside the state space"),
    ],
    ids=str,
)
def test_a_bad_state_is_named_and_changes_nothing(states: Any, message: str) -> None:
    env = navigation_v0.parallel_env(problem=mixed_problem())
    with pytest.raises(RuntimeError, match=r"call env\.reset"):
        env.set_state(states)
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ValueError, match=message):
        env.set_state(states)
    np.testing.assert_array_equal(env.state(), before)
    batched = NavigationVectorEnv(1, problem=mixed_problem())
    batched.reset(seed=0)
    with pytest.raises(ValueError, match="state"):
        batched.set_state([states])
