"""Learned policies among walls: robots that see their goals along their shortest paths."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from d4orm_env import make_problem, navigation_v0
from d4orm_env.core.observation_layout import ObservationSlices
from d4orm_env.envs.features import Features
from d4orm_env.envs.joint_state import JointState
from d4orm_env.envs.vector_env import NavigationVectorEnv
from d4orm_planners import make_policy, run_episode
from d4orm_planners.base.episode import open_env
from d4orm_planners.rl.learned import SEEN_OBSTACLES, SHIPPED, Detours
from d4orm_planners.rl.network import Header, Network, load_network

OWN, NEIGHBOR, OBSTACLE = 11, 9, 5


def save_network(path: Path, shortest_paths: bool | None = True) -> Network:
    """A network of sets of random weights, in a file."""
    random = np.random.default_rng(0)
    shapes = {"reward_variance": (), "weight_0": (2, OWN + 2 * 7 + 2 * 3), "bias_0": (2,)}
    for kind, row, width in (("neighbor", NEIGHBOR, 7), ("obstacle", OBSTACLE, 3)):
        shapes |= {f"{kind}_weight_0": (width, row), f"{kind}_own": (width, OWN), f"{kind}_bias_0": (width,)}
        shapes |= {f"{kind}_weight_1": (width, width), f"{kind}_bias_1": (width,)}
    header = Header(
        format=1, algorithm="ppo", model="holonomic2d", dimension=2, num_neighbors=4, num_obstacles=4,
        activation="relu", squashed=False, layers=1, encoder="sets", shortest_paths=shortest_paths, training={},
    )  # fmt: skip
    network = Network(header, {name: random.normal(0, 0.3, shape).astype(np.float32) for name, shape in shapes.items()})
    network.save(path)
    return network


def actions_of(path: Path, env: navigation_v0.parallel_env) -> np.ndarray:
    """``(K, m)`` what the policy does at the start."""
    observations, _ = env.reset(seed=0)
    policy = make_policy("ppo", path=path)
    policy.reset(env)
    return np.stack(list(policy.act(observations, env.state()).values()))


def test_goals_are_seen_along_the_paths_where_there_are_any() -> None:
    features = Features(ObservationSlices(2, 0, 0), turned=True)
    seen = np.zeros((4, 12), np.float32)
    goal = features.slices.own.goal
    seen[:, goal] = [[3, 4], [3, 4], [3, 4], [3, 4]]
    direction = np.array([[0.6, 0.8], [0, -1], [0, 0], [1, 0]])
    features.along(seen, direction, np.array([5, 7, 0, np.inf]))
    np.testing.assert_allclose(seen[:, goal], [[3, 4], [0, -7], [3, 4], [3, 4]], atol=1e-6)
    assert not np.delete(seen, np.arange(12)[goal], axis=1).any()


def test_files_say_whether_robots_look_along_paths(tmp_path: Path) -> None:
    save_network(tmp_path / "paths.safetensors")
    assert load_network(tmp_path / "paths.safetensors").header.shortest_paths
    straight = save_network(tmp_path / "straight.safetensors", shortest_paths=None)
    assert "shortest_paths" not in json.loads(straight.header.text()), "as earlier versions know it"


def test_a_policy_looks_along_paths_among_walls_and_nowhere_else(tmp_path: Path) -> None:
    along, straight = tmp_path / "along.safetensors", tmp_path / "straight.safetensors"
    save_network(along)
    save_network(straight, shortest_paths=None)
    for scenario, differ in (("random", False), ("rooms", True)):
        env = navigation_v0.parallel_env(scenario, num_robots=6)
        assert (actions_of(along, env) != actions_of(straight, env)).any() == differ
    bent = make_problem("rooms", num_robots=6, seed=0)
    apart = bent.shortest_paths.length > np.linalg.norm(bent.goal - bent.start[:, :2], axis=1) * 1.01
    assert apart.any()


def test_a_robot_with_a_new_goal_sees_that_itself(tmp_path: Path) -> None:
    along, straight = tmp_path / "along.safetensors", tmp_path / "straight.safetensors"
    save_network(along)
    save_network(straight, shortest_paths=None)
    env = navigation_v0.parallel_env("rooms", num_robots=4)
    observations, _ = env.reset(seed=0)
    found = {}
    for path in (along, straight):
        policy = make_policy("ppo", path=path)
        policy.reset(env)
        elsewhere = make_problem("rooms", num_robots=4, seed=1).goal
        state = env.state().copy()
        goals = slice(env.unwrapped.problem.start.size, env.unwrapped.problem.start.size + elsewhere.size)
        np.testing.assert_array_equal(state[goals], env.unwrapped.problem.goal.ravel())
        state[goals] = elsewhere.ravel()
        found[path] = np.stack(list(policy.act(observations, state).values()))
    np.testing.assert_array_equal(found[along], found[straight])


def test_the_policy_of_the_package_is_that_for_the_world() -> None:
    policy = make_policy("ppo")
    worlds = {"random": False, "rooms": True, "four_obstacles": False, "forest": True, "warehouse": True}
    for scenario, along in worlds.items():
        env = navigation_v0.parallel_env(scenario, num_robots=4)
        env.reset(seed=0)
        policy.reset(env)
        assert bool(policy._actor.header.shortest_paths) == along
        assert policy._actor.header.num_obstacles == SEEN_OBSTACLES


def test_programs_that_make_the_environment_have_robots_observe_what_the_policy_was_trained_with() -> None:
    policy = make_policy("ppo")
    for scenario, file in (("random", "ppo"), ("rooms", "ppo-walls")):
        problem, header = make_problem(scenario, num_robots=12), load_network(SHIPPED / f"{file}.safetensors").header
        assert open_env(problem, policy=policy).unwrapped.options.observed_robots == header.num_neighbors != 4
        assert open_env(problem, policy=policy, observed_robots=4).unwrapped.options.observed_robots == 4
    assert open_env(problem, policy=make_policy("go-to-goal")).unwrapped.options.observed_robots == 4


def test_robots_head_round_docked_ones_that_are_in_the_way_and_straight_otherwise() -> None:
    """Robots 2 to 4 have docked in a row across the way of robot 0, not of robot 1."""
    row = [[0, 0], [0, 0.5], [0, -0.5]]
    start = np.pad([[-2, 0], [-2, 2], *row], ((0, 0), (0, 2)))
    problem = make_problem("circle", num_robots=5).replace(start=start, goal=[[3, 0], [3, 2], *row])
    positions = problem.start[:, :2].copy()
    joint = JointState(problem.start, problem.goal, np.zeros((5, 2), np.float32), np.arange(5) >= 2, 1)
    detours = Detours(problem)
    none = detours.goals(joint._replace(arrived=np.zeros(5, bool)), positions)
    np.testing.assert_array_equal(none, problem.goal)
    heads = detours.goals(joint, positions)
    np.testing.assert_array_equal(heads[1:], problem.goal[1:])
    beside, length = np.abs(heads[0, 1]), np.linalg.norm(heads[0] - positions[0])
    assert beside > 0.5, "past the end of the row"
    assert 5 < length < 6, "the length of the way, on its first stretch"
    parts = positions + 0.1 * (heads - positions)
    np.testing.assert_allclose(detours.goals(joint, parts)[0] - positions[0], heads[0] - positions[0], rtol=0.02)


def test_a_learned_policy_takes_no_detours_where_it_is_told_or_robots_are_hidden() -> None:
    env = navigation_v0.parallel_env("random", num_robots=2)
    hiding = navigation_v0.parallel_env("random", num_robots=2, communication_range=2.0)
    for own, world, expected in (({}, env, True), ({"detours": False}, env, False), ({}, hiding, False)):
        policy = make_policy("ppo", **own)
        world.reset(seed=0)
        policy.reset(world)
        assert (policy._detours is not None) == expected


def test_the_policy_of_the_package_goes_through_doors() -> None:
    """The other one, which knows nothing of paths, drives into the walls."""
    # Not all of them, for matrices are multiplied by the processor's own library, and one robot late is one too many.
    for path, expected in ((None, {2, 3}), (SHIPPED / "ppo.safetensors", {0})):
        policy = make_policy("ppo", path=path)
        envs = [navigation_v0.parallel_env("rooms", num_robots=4) for _ in range(3)]
        solved = [run_episode(env, policy, seed=seed).metrics["success"] for seed, env in enumerate(envs)]
        assert sum(solved) in expected


pytest.importorskip("stable_baselines3")
from d4orm_planners.rl.robot_vec_env import RobotVecEnv  # noqa: E402
from d4orm_planners.rl.training import TrainingSettings, train  # noqa: E402


@pytest.mark.parametrize("scenario", ["rooms", "random", "four_obstacles"])
def test_training_sees_what_the_policy_sees(scenario: str, tmp_path: Path) -> None:
    network = save_network(tmp_path / "along.safetensors")
    worlds = RobotVecEnv(1, 6, scenario, shortest_paths=True)
    features = worlds.reset()
    env = navigation_v0.parallel_env(scenario, num_robots=6)
    limits = env.unwrapped.problem.team.control_limits
    expected = network.features.decode(network(features), worlds.frames, limits)
    np.testing.assert_allclose(actions_of(tmp_path / "along.safetensors", env), expected, atol=2e-5)
    policy = make_policy("ppo", path=tmp_path / "along.safetensors")
    observations, _ = env.reset(seed=0)
    policy.reset(env)
    for _ in range(5):
        actions = policy.act(observations, env.state())
        features, *_ = worlds.step(network(features))
        observations, *_ = env.step(actions)
    expected = network.features.decode(network(features), worlds.frames, limits)
    np.testing.assert_allclose(np.stack(list(policy.act(observations, env.state()).values())), expected, atol=2e-4)
    worlds.close()


def test_without_obstacles_paths_change_nothing_in_training() -> None:
    along, straight = (
        RobotVecEnv(2, 3, "random", shortest_paths=shortest_paths, randomize_instance=True)
        for shortest_paths in (True, False)
    )
    np.testing.assert_allclose(along.reset(), straight.reset(), atol=1e-6)
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 2)).astype(np.float32)
    for ours, theirs in zip(along.step(actions)[:3], straight.step(actions)[:3]):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_robots_are_paid_for_progress_along_paths() -> None:
    env = RobotVecEnv(1, 6, "rooms", shortest_paths=True)
    env.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 2)).astype(np.float32)
    controls = env.features.decode(actions, env.frames, env.problem.team.control_limits)
    paid = {}
    for progress in ("path", "straight"):
        worlds = NavigationVectorEnv(1, "rooms", 6, reward="training", progress=progress)
        worlds.reset(seed=0)
        worlds.step(controls.reshape(1, -1))
        paid[progress] = worlds.robot_rewards[0]
    rewards = env.step(actions)[1]
    np.testing.assert_allclose(rewards, paid["path"], atol=1e-6)
    assert (rewards != paid["straight"]).any()


def test_a_training_along_paths_says_so(tmp_path: Path) -> None:
    settings = TrainingSettings(
        steps=64,
        num_envs=4,
        stages=1,
        validation_worlds=2,
        network="sets",
        mixture=("rooms 2", "random 2"),
        shortest_paths=True,
    )
    network = train(settings, tmp_path).network
    assert network.header.shortest_paths
    assert network.header.training["shortest_paths"] is True
    with pytest.raises(ValueError, match="whose robots look along their shortest paths; give --shortest-paths"):
        train(
            replace(settings, shortest_paths=False, start_from=str(tmp_path / "policy.safetensors")),
            tmp_path / "straight",
        )
    assert not (tmp_path / "straight").exists()
    flat = TrainingSettings(steps=64, num_envs=4, stages=1, validation_worlds=2, scenario="rooms", num_robots=2)
    assert train(flat, tmp_path / "flat").network.header.shortest_paths is None
