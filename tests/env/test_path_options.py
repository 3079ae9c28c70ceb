"""Rewards along the shortest path, and observations of it, in every environment."""

from __future__ import annotations

import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest

from d4orm_env import Problem, Team, World, navigation_v0
from d4orm_env.core.observation_layout import ObservationLayout, ObservationSlices
from d4orm_env.envs.rewards import TrainingReward

BATCHED = {"vectorization_mode": "vector_entry_point"}


def walled(spatial: bool = False) -> Problem:
    """Two robots that have to go round a wall, or over it."""
    d = 3 if spatial else 2
    team = Team(("holonomic3d" if spatial else "holonomic2d",) * 2)
    start, goal = np.zeros((2, 2 * d)), np.zeros((2, d))
    start[:, :2], goal[:, :2] = [[-1, -0.4], [-1, 0.4]], [[1, -0.4], [1, 0.4]]
    wall = [-0.1, -1, -1, 0.1, 1, 1] if spatial else [-0.1, -1, 0.1, 1]
    return Problem(team, start, goal, World(d, boxes=[wall]), horizon=30)


def joint(**options: Any) -> Any:
    return gymnasium.make("d4orm/Navigation-v0", disable_env_checker=True, **options).unwrapped


def random_actions(problem: Problem, steps: int) -> np.ndarray:
    size = (steps, problem.num_robots, problem.control_size)
    return np.random.default_rng(5).uniform(-2, 2, size).astype(np.float32)


def team_steps(problem: Problem, actions: np.ndarray, **options: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rewards ``(T, K)``, positions ``(T + 1, K, d)`` and observations ``(T, K, D)`` of the PettingZoo environment."""
    env = navigation_v0.parallel_env(problem=problem, **options)
    env.reset(seed=0)
    rewards, positions, seen = [], [problem.start[:, : problem.dimension]], []
    for action in actions:
        observations, given, _, _, _ = env.step(dict(zip(env.agents, action, strict=True)))
        rewards.append(list(given.values()))
        seen.append(list(observations.values()))
        k, n = problem.num_robots, problem.state_size
        positions.append(env.state()[: k * n].reshape(k, n)[:, : problem.dimension])
    return np.array(rewards), np.array(positions), np.array(seen)


@pytest.mark.parametrize("spatial", [False, True])
def test_the_papers_reward_along_the_way(spatial: bool) -> None:
    problem = walled(spatial)
    actions = random_actions(problem, 8)  # too few to come near to anything
    rewards, positions, _ = team_steps(problem, actions, progress="path")
    np.testing.assert_allclose(
        rewards, 1 - problem.shortest_paths.distance(positions[1:]) / problem.shortest_paths.length, atol=1e-5
    )
    straight, _, _ = team_steps(problem, actions)
    assert (np.abs(rewards - straight) > 1e-3).any()


def test_a_reward_to_learn_from_along_the_way() -> None:
    problem = walled()
    reward = TrainingReward(progress=1.0, arrival=0, margin=0, contact=0, time=0)
    rewards, positions, _ = team_steps(problem, random_actions(problem, 12), progress="path", reward=reward)
    lengths = problem.shortest_paths.distance(positions)
    longest = problem.team.max_speed * problem.dt
    np.testing.assert_allclose(rewards, (lengths[:-1] - lengths[1:]) / longest, atol=1e-4)


@pytest.mark.parametrize("reward", ["paper", "training"])
@pytest.mark.parametrize("spatial", [False, True])
def test_environments_agree(spatial: bool, reward: str) -> None:
    problem, count = walled(spatial), 3
    actions = random_actions(problem, 10)
    options = {"progress": "path", "observed_path": True, "reward": reward}
    rewards, _, seen = team_steps(problem, actions, **options)
    single, batch = (
        joint(problem=problem, **options),
        gymnasium.make_vec("d4orm/Navigation-v0", num_envs=count, problem=problem, **BATCHED, **options),
    )
    single.reset(seed=0)
    batch.reset(seed=0)
    for row, action in enumerate(actions):
        flat = action.reshape(-1)
        observation, given, *_ = single.step(flat)
        observations, teams, *_ = batch.step(np.tile(flat, (count, 1)))
        assert given == pytest.approx(rewards[row].mean(), abs=1e-5)
        np.testing.assert_allclose(teams, given, atol=1e-5)
        np.testing.assert_array_equal(observation, seen[row].reshape(-1))
        np.testing.assert_array_equal(observations, np.tile(observation, (count, 1)))


def test_an_open_world_has_the_same_rewards_to_the_bit() -> None:
    problem = walled().replace(world=World())
    actions = random_actions(problem, 10)
    for reward in ("paper", "training"):
        straight, _, _ = team_steps(problem, actions, reward=reward)
        along, _, _ = team_steps(problem, actions, reward=reward, progress="path")
        np.testing.assert_array_equal(straight, along)


@pytest.mark.parametrize("spatial", [False, True])
@pytest.mark.parametrize("closed", [False, True])
def test_the_way_is_observed_at_the_end(spatial: bool, closed: bool) -> None:
    problem = walled(spatial) if closed else walled(spatial).replace(world=World(3 if spatial else 2))
    d, actions = problem.dimension, random_actions(walled(spatial), 6)
    _, positions, seen = team_steps(problem, actions, observed_path=True)
    _, _, plain = team_steps(problem, actions)
    layout = ObservationLayout.for_problem(problem, observed_path=True)
    np.testing.assert_array_equal(seen[..., : -d - 1], plain)
    np.testing.assert_allclose(
        layout.paths(seen)[..., layout.path.direction], problem.shortest_paths.direction(positions[1:]), atol=1e-6
    )
    np.testing.assert_allclose(layout.paths(seen)[..., d], problem.shortest_paths.distance(positions[1:]), rtol=1e-6)
    assert layout.obstacles(seen).shape[-2:] == (4, d + 2)
    assert layout.names[-d - 1 :] == (*(f"path.direction_{axis}" for axis in "xyz"[:d]), "path.length")
    assert layout.names[: -d - 1] == ObservationLayout.for_problem(problem).names
    assert np.isfinite(layout.bounds).all()
    assert (layout.low <= seen).all()
    assert (seen <= layout.high).all()


def test_nothing_is_observed_of_the_path_by_default() -> None:
    slices = ObservationSlices(2, 4, 4)
    assert not slices.observed_path
    assert slices.paths(np.zeros((3, slices.size))).shape == (3, 0)


def test_spaces_hold_what_is_observed() -> None:
    env = navigation_v0.parallel_env("four_obstacles", observed_path=True)
    observations, _ = env.reset(seed=1)
    for agent, observation in observations.items():
        assert env.observation_space(agent).contains(observation)
    batch = gymnasium.make_vec(
        "d4orm/Navigation-v0", num_envs=2, scenario="four_obstacles", observed_path=True, **BATCHED
    )
    assert batch.observation_space.contains(batch.reset(seed=1)[0])


def drawn(seed: int, num_robots: int) -> Problem:
    """Round walls in different places, with goals in different ones."""
    random = np.random.default_rng(seed)
    start, goal = np.zeros((2, 4)), np.zeros((2, 2))
    start[:, 0], goal[:, 0], start[:, 1] = -2, 2, [-0.5, 0.5]
    goal[:, 1] = start[:, 1] + random.uniform(-0.2, 0.2, 2)
    return Problem(
        Team(("holonomic2d",) * 2), start, goal, World(circles=[[random.uniform(-1, 1), 0, 0.6]]), horizon=20
    )


def test_instances_have_paths_of_their_own() -> None:
    options = {"scenario": drawn, "num_robots": 2, "progress": "path", "observed_path": True}
    single = joint(**options)
    batch = gymnasium.make_vec("d4orm/Navigation-v0", num_envs=2, **BATCHED, **options)
    observations, _ = batch.reset(seed=3)
    for action in random_actions(drawn(0, 2), 4):
        observations, rewards, *_ = batch.step(np.tile(action.reshape(-1), (2, 1)))
    assert rewards[0] != rewards[1]
    for world in range(2):
        single.reset(seed=3 + world)
        for action in random_actions(drawn(0, 2), 4):
            observation, reward, *_ = single.step(action.reshape(-1))
        np.testing.assert_array_equal(observation, observations[world])
        assert reward == pytest.approx(rewards[world], abs=1e-5)


def test_environments_travel_with_their_ways() -> None:
    env = joint(problem=walled(), progress="path", observed_path=True)
    env.reset(seed=0)
    action = random_actions(walled(), 1).reshape(-1)
    copy = pickle.loads(pickle.dumps(env))
    one, other = env.step(action), copy.step(action)
    np.testing.assert_array_equal(one[0], other[0])
    assert one[1] == other[1]


def test_bad_options_are_named() -> None:
    with pytest.raises(ValueError, match="progress is 'round'; choose one of straight, path"):
        navigation_v0.parallel_env("circle", progress="round")
    with pytest.raises(ValueError, match="observed_path is 1; it must be True or False"):
        navigation_v0.parallel_env("circle", observed_path=1)
    with pytest.raises(ValueError, match="need goals that stay"):
        navigation_v0.parallel_env("circle", observed_path=True, lifelong=True)
    cage = [[-2, -2, -1.8, 2], [1.8, -2, 2, 2], [-1.8, -2, 1.8, -1.8], [-1.8, 1.8, 1.8, 2]]
    problem = walled().replace(world=World(boxes=cage), goal=[[1, -0.4], [3, 0.4]])
    with pytest.raises(ValueError, match="robot_1 has no path from start to goal"):
        navigation_v0.parallel_env(problem=problem, progress="path")
    env = navigation_v0.parallel_env(problem=problem, observed_path=True)
    seen = env.reset(seed=0)[0]["robot_1"]
    assert seen[-1] == env.observation_space("robot_1").high[-1]
    np.testing.assert_array_equal(seen[-3:-1], [0, 0])
