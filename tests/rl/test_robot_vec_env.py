"""The environment that Stable-Baselines3 learns from: features, masks, terminal observations, and the same worlds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from d4orm_env import make_problem, navigation_v0
from d4orm_env.core.observation_layout import ObservationLayout, ObservationSlices
from d4orm_env.envs.features import Features

MODELS = ("holonomic2d", "velocity2d", "differential_drive", "holonomic3d")


def observations_of(model: str, num_robots: int = 5, seed: int = 0, **kwargs: object) -> tuple[Features, np.ndarray]:
    env = navigation_v0.parallel_env(scenario="random", num_robots=num_robots, model=model, **kwargs)
    observations, _ = env.reset(seed=seed)
    layout = ObservationLayout.for_problem(env.unwrapped.problem)
    return Features.of(layout, model), np.stack(list(observations.values()))


@pytest.mark.parametrize("model", MODELS)
def test_sizes_are_those_of_the_observations(model: str) -> None:
    features, observations = observations_of(model)
    encoded, frames = features.encode(observations)
    assert observations.shape == (5, features.slices.size)
    assert encoded.shape == (5, features.size)
    assert encoded.dtype == np.float32
    assert frames.shape == (5, 2)
    assert np.abs(encoded).max() <= 1.5


def test_literal_features_of_a_robot_and_one_neighbor() -> None:
    # At rest, goal 3 m up the y axis; a neighbour 1 m away in that direction comes down at 0.5 m/s.
    own = [0, 0, 0, 0, 0, 0, 3, 0.25, 0, 0.15, 1, 2]
    neighbor = [1, 0, 1, 0, -0.5, 0.15]
    features, frames = Features(ObservationSlices(2, 1, 0), turned=True).encode(np.array([own + neighbor], np.float32))
    gap = 0.7
    expected = [0, 0, 0, 0, 1, 0, 1 / 4, np.exp(-12), 0.25, 0.15, 2]
    expected += [1, 1, 0, 1 / (1 + gap), np.exp(-4 * gap), -0.25, 0, 2 / 5, 1]
    np.testing.assert_allclose(frames, [[0, 1]], atol=1e-6)
    np.testing.assert_allclose(features[0, :-9], expected[:-9], atol=1e-6)
    # Order of a neighbour: presence, direction, two functions of the gap, velocity, time and miss of the closest point.
    np.testing.assert_allclose(features[0, -9:], expected[-9:], atol=1e-6)


def test_literal_features_of_a_robot_on_its_way_past_a_neighbor_and_an_obstacle() -> None:
    # Faces up the y axis and drives there at half its speed limit of 2 m/s, the goal 3 m ahead. What stands at 9 is
    # not looked at.
    own = [0, 1, 0, 1, 9, 0, 3, 0.25, 9, 0.15, 2, 3]
    # 1 m to its right, nearest in one second, and by its left an obstacle 0.4 m off.
    neighbor, obstacle = [1, 1, 0, -0.5, 0.5, 0.2], [1, -4, 3, 0.4]
    observation = np.array([own + neighbor + obstacle], np.float32)
    features, frames = Features(ObservationSlices(2, 1, 1), turned=True).encode(observation)
    gap, miss = 0.65, np.sqrt(0.5) - 0.35
    expected = [0.5, 0, 1, 0, 1, 0, 1 / 4, np.exp(-12), 0.25, 0.15, 1.5]
    expected += [1, 0, -1, 1 / (1 + gap), np.exp(-4 * gap), 0.125, 0.125, 1 / 5, np.exp(-4 * miss)]
    expected += [1, 0.6, 0.8, 1 / 1.4, np.exp(-1.6)]
    np.testing.assert_allclose(frames, [[0, 1]], atol=1e-6)
    np.testing.assert_allclose(features[0], expected, atol=1e-6)
    # What is not there is all zeros, whatever stands in its place.
    observation[0, [12, 18]] = 0
    np.testing.assert_allclose(
        Features(ObservationSlices(2, 1, 1), turned=True).encode(observation)[0][0, 11:], 0, atol=1e-6
    )


def test_robots_that_turn_see_the_world_along_their_heading() -> None:
    # Faces left and drives backwards at half its speed limit, the goal 3 m up the y axis.
    own = [0.5, 0, -1, 0, 0, 0, 3, 0.25, 0, 0.15, 1, 2]
    neighbor = [1, 0, 1, 0, -0.5, 0.15]
    features = Features.of(ObservationSlices(2, 1, 0), "differential_drive")
    seen, frames = features.encode(np.array([own + neighbor], np.float32))
    np.testing.assert_allclose(frames, [[-1, 0]], atol=1e-6)
    np.testing.assert_allclose(seen[0, :6], [-0.5, 0, 1, 0, 0, -1], atol=1e-6, err_msg="the goal is on its right")
    np.testing.assert_allclose(seen[0, 12:14], [0, -1], atol=1e-6, err_msg="and so is the neighbour")
    assert Features.of(ObservationSlices(2, 1, 0), "holonomic2d").frame == "goal"


@given(angle=st.floats(-3.1, 3.1), seed=st.integers(0, 50), along=st.sampled_from(["goal", "heading"]))
def test_a_turned_world_looks_the_same_and_is_answered_by_turned_controls(angle: float, seed: int, along: str) -> None:
    rng = np.random.default_rng(seed)
    features = Features(ObservationSlices(2, 2, 1), turned=True, frame=along)
    observation = rng.normal(size=(1, features.slices.size)).astype(np.float32)
    observation[0, [10, 11]] = 1
    observation[0, [12, 18, 24]] = 1
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = observation.copy()
    for begin in (0, 2, 5, 13, 15, 19, 21, 25):
        turned[0, begin : begin + 2] = turn @ observation[0, begin : begin + 2]
    (one, frame), (two, turned_frame) = features.encode(observation), features.encode(turned)
    np.testing.assert_allclose(one, two, atol=2e-4)
    action, limits = np.array([[0.3, -0.7]], np.float32), np.ones((1, 2), np.float32)
    control = features.decode(action, frame, limits)
    np.testing.assert_allclose(features.decode(action, turned_frame, limits)[0], turn @ control[0], atol=2e-4)


def test_controls_of_a_differential_drive_are_not_turned() -> None:
    features, observations = observations_of("differential_drive")
    _, frames = features.encode(observations)
    limits = np.tile(np.float32([1.5, 2.0]), (5, 1))
    controls = features.decode(np.full((5, 2), 2, np.float32), frames, limits)
    np.testing.assert_array_equal(controls, limits)


sb3 = pytest.importorskip("stable_baselines3")
from d4orm_env.envs.rewards import TrainingReward  # noqa: E402
from d4orm_planners.rl.masked_buffers import MaskedReplayBuffer, MaskedRolloutBuffer  # noqa: E402
from d4orm_planners.rl.robot_vec_env import RobotVecEnv  # noqa: E402


def drive(env: RobotVecEnv, features: np.ndarray) -> np.ndarray:
    """Straight to the goal: in a robot's frame that is along the first axis; brake close by."""
    actions = np.zeros((env.num_envs, 2), np.float32)
    actions[:, 0] = np.where(features[:, 6] > 0.6, -1, 1)
    return actions


def test_a_robot_that_arrives_ends_its_episode_and_is_idle_until_its_world_begins_anew() -> None:
    env = RobotVecEnv(3, 2, "random", seed=3, randomize_instance=True, model="velocity2d", max_cycles=60)
    features = env.reset()
    acting = np.ones(6, bool)
    arrived_before_the_end = 0
    for _ in range(130):
        env.step_async(np.tile(np.float32([1, 0]), (6, 1)))
        features, rewards, dones, infos = env.step_wait()
        np.testing.assert_array_equal(env.acted, acting)
        ended = {world for world, *_ in env.finished}
        for i, info in enumerate(infos):
            assert ("terminal_observation" in info) == bool(dones[i] and acting[i])
            if not acting[i]:
                assert rewards[i] == 0
                assert dones[i] == (i // 2 in ended)
            elif dones[i]:
                assert info["terminal_observation"].any()
                assert info["TimeLimit.truncated"] != (info["terminal_observation"][6] > 0.9)
                arrived_before_the_end += i // 2 not in ended
            acting[i] = i // 2 in ended or (acting[i] and not dones[i])
            assert features[i].any() == acting[i]
    assert arrived_before_the_end > 0
    env.close()


def test_truncation_is_bootstrapped_and_arrival_is_not() -> None:
    env = RobotVecEnv(1, 2, "circle", max_cycles=4)
    env.reset()
    for step in range(4):
        env.step_async(np.zeros((2, 2), np.float32))
        _, rewards, dones, infos = env.step_wait()
        assert dones.all() == (step == 3)
    assert all(info["TimeLimit.truncated"] and not info["is_success"] for info in infos)
    np.testing.assert_allclose(rewards, -TrainingReward().time, atol=1e-6)
    assert infos[0]["episode"]["l"] == 4


@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive"])
def test_evaluate_policy_and_run_episode_agree_on_the_same_instances(model: str) -> None:
    from stable_baselines3.common.evaluation import evaluate_policy

    from d4orm_planners.base.episode import run_episode
    from d4orm_planners.base.policy import Policy

    worlds, robots, limit = 6, 3, make_problem("random", num_robots=3, model=model).team.control_limits

    class Straight:
        def predict(self, observations: np.ndarray, **kwargs: object) -> tuple[np.ndarray, None]:
            return drive_by(observations), None

    def drive_by(features: np.ndarray) -> np.ndarray:
        slow = features[:, 0] * 0.8
        return np.stack([np.clip(features[:, 6] * -2 + 1.6 - slow, -1, 1), 0.4 * features[:, 12]], axis=1)

    class StraightPolicy(Policy):
        def act(self, observations: dict, state: np.ndarray) -> dict:
            encoder = Features.of(ObservationLayout.for_problem(self.problem), model)
            features, frames = encoder.encode(np.stack(list(observations.values())))
            controls = encoder.decode(drive_by(features), frames, limit[: len(features)])
            return dict(zip(observations, controls))

    env = RobotVecEnv(worlds, robots, "random", seed=20, randomize_instance=True, model=model)
    seen: dict[int, bool] = {}

    def note(local: dict, _: dict) -> None:
        if local["dones"][local["i"]] and "is_success" in local["info"]:
            seen.setdefault(local["i"], local["info"]["is_success"])

    evaluate_policy(Straight(), env, n_eval_episodes=env.num_envs, callback=note, warn=False)
    by_world = [all(seen[world * robots + k] for k in range(robots)) for world in range(worlds)]
    single = navigation_v0.parallel_env(scenario="random", num_robots=robots, randomize_instance=True, model=model)
    expected = [bool(run_episode(single, StraightPolicy(), seed=20 + b).metrics["success"]) for b in range(worlds)]
    assert by_world == expected
    env.close()


def test_mixed_models_and_unknown_attributes_are_refused() -> None:
    with pytest.raises(ValueError, match="mixes differential_drive, holonomic2d"):
        RobotVecEnv(2, 4, "heterogeneous")
    env = RobotVecEnv(2, 2, "circle")
    with pytest.raises(AttributeError, match="'x' cannot be set"):
        env.set_attr("x", 1)
    with pytest.raises(AttributeError, match="'x' cannot be called"):
        env.env_method("x")
    env.close()


class Source:
    acted = np.array([True, False, True])


def test_the_rollout_buffer_hands_out_only_steps_in_which_robots_acted() -> None:
    import torch

    env = RobotVecEnv(3, 1, "random", randomize_instance=True)
    buffer = MaskedRolloutBuffer(4, env.observation_space, env.action_space, n_envs=3)
    buffer.source, buffer.random = Source(), np.random.default_rng(0)  # type: ignore[assignment]
    for step in range(4):
        events = np.full((3, env.features.size), step, np.float32) + np.float32([[0], [100], [10]])
        buffer.add(events, np.zeros((3, 2)), np.zeros(3), np.zeros(3), torch.zeros(3, 1), torch.zeros(3))
    buffer.compute_returns_and_advantage(torch.zeros(3), np.zeros(3))
    batches = [batch.observations[:, 0].tolist() for batch in buffer.get(4)]
    assert [len(batch) for batch in batches] == [4, 4]
    assert sorted(mark for batch in batches for mark in batch) == [0, 1, 2, 3, 10, 11, 12, 13]
    env.close()


def test_the_replay_buffer_likewise() -> None:
    env = RobotVecEnv(3, 1, "random", randomize_instance=True)
    buffer = MaskedReplayBuffer(30, env.observation_space, env.action_space, n_envs=3)
    buffer.source, buffer.random = Source(), np.random.default_rng(0)  # type: ignore[assignment]
    for step in range(5):
        events = np.full((3, env.features.size), step, np.float32) + np.float32([[0], [100], [10]])
        buffer.add(events, events, np.zeros((3, 2)), np.zeros(3), np.zeros(3), [{}] * 3)
    values = set(buffer.sample(200).observations[:, 0].tolist())
    assert values == {0, 1, 2, 3, 4, 10, 11, 12, 13, 14}
    env.close()


def test_the_replay_buffer_takes_running_out_of_time_for_no_end() -> None:
    """A robot that ran out of steps could have gone on, so what its last state is worth is learned from; an arrival
    is an end.
    """
    env = RobotVecEnv(3, 1, "random", randomize_instance=True)
    buffer = MaskedReplayBuffer(30, env.observation_space, env.action_space, n_envs=3)
    buffer.source, buffer.random = Source(), np.random.default_rng(0)  # type: ignore[assignment]
    cases = [(False, False, 0), (True, False, 1), (True, True, 0)]
    for step, (done, out_of_time, _) in enumerate(cases):
        events = np.full((3, env.features.size), step, np.float32)
        infos = [{"TimeLimit.truncated": out_of_time}] * 3
        buffer.add(events, events, np.zeros((3, 2)), np.zeros(3), np.full(3, done), infos)
    batch = buffer.sample(200)
    ends = {(int(mark), int(end)) for mark, end in zip(batch.observations[:, 0], batch.dones[:, 0], strict=True)}
    assert ends == {(step, end) for step, (*_, end) in enumerate(cases)}
    env.close()
