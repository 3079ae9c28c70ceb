"""Rewards of the user's own, in numbers and in all three environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from env_support import act, line_problem, mixed_problem

from d4orm_env import navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.disturbances import Disturbance, Intruder
from d4orm_env.envs.joint_env import JointNavigationEnv
from d4orm_env.envs.rewards import RewardInput, TrainingReward, turns_left
from d4orm_env.envs.vector_env import NavigationVectorEnv
from d4orm_planners import make_policy, run_episode


def closer(step: RewardInput) -> Any:
    """Metres made towards the goal."""
    return step.previous_distances - step.distances


def joint_env(problem: Problem, **settings: Any) -> Any:
    return gymnasium.make("d4orm/Navigation-v0", problem=problem, disable_env_checker=True, **settings).unwrapped


def test_a_step_in_numbers() -> None:
    seen: list[RewardInput] = []

    def look(step: RewardInput) -> Any:
        seen.append(step)
        return [1, 2]

    env = navigation_v0.parallel_env(problem=line_problem([0.15, 2.0]), reward=look)
    env.reset(seed=0)
    _, rewards, _, _, _ = env.step(act(env, np.float32([[1, 0], [1, 0]])))
    assert rewards == {"robot_0": 1.0, "robot_1": 2.0}
    assert len(seen) == 1
    step = seen[0]
    np.testing.assert_allclose(step.previous_positions, [[0, 0], [0, 1]])
    np.testing.assert_allclose(step.positions, [[0.1, 0], [0.1, 1]], atol=1e-6)
    np.testing.assert_allclose(step.previous_distances, [0.15, 2.0], atol=1e-6)
    np.testing.assert_allclose(step.distances, [0.05, 1.9], atol=1e-6)
    np.testing.assert_allclose(step.initial_distances, [0.15, 2.0], atol=1e-6)
    np.testing.assert_allclose(step.paper, [2 / 3, 0.05], atol=1e-6)
    assert step.arrived.tolist() == [True, False]
    assert not step.previously_arrived.any()
    assert not (step.collided | step.margin_violated).any()
    assert step.dt == 0.1
    with pytest.raises(ValueError, match="read-only"):
        step.states[0] = 0
    # Who has left is still computed, and paid to nobody.
    _, rewards, _, _, _ = env.step(act(env, np.float32([[1, 0], [1, 0]])))
    assert rewards == {"robot_1": 2.0}
    assert seen[1].previously_arrived.tolist() == [True, False]


def test_the_three_environments_give_the_same_rewards() -> None:
    problem = mixed_problem()
    controls = np.random.default_rng(0).uniform(-1, 1, (20, 3, 2)).astype(np.float32)
    batched = NavigationVectorEnv(2, problem=problem, reward=closer)
    joint, parallel = joint_env(problem, reward=closer), navigation_v0.parallel_env(problem=problem, reward=closer)
    batched.reset(seed=0), joint.reset(seed=0), parallel.reset(seed=0)
    total = 0.0
    for control in controls:
        mean = joint.step(control.ravel())[1]
        rewards = parallel.step(act(parallel, control))[1]
        many = batched.step(np.stack([control.ravel()] * 2))[1]
        np.testing.assert_allclose(many, mean, atol=1e-6)
        for agent, reward in rewards.items():
            assert batched.robot_rewards[1, int(agent[-1])] == pytest.approx(reward, abs=1e-6)
        assert mean == pytest.approx(float(batched.robot_rewards[0].mean()), abs=1e-6)
        total += mean
        if not parallel.agents:
            break
    for env in (joint, parallel):
        assert env.metrics()["reward"] * env.metrics()["steps"] == pytest.approx(total, abs=1e-5)
    np.testing.assert_allclose(batched.metrics()["reward"], joint.metrics()["reward"], atol=1e-6)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_reset_world_gets_nothing_and_the_metrics_begin_anew(mode: str) -> None:
    env = NavigationVectorEnv(2, problem=line_problem([2.0]), reward=closer, max_cycles=3, autoreset_mode=mode)
    env.reset(seed=0)
    ahead = np.tile(np.float32([1, 0]), (2, 1))
    rewards = np.stack([env.step(ahead)[1] for _ in range(3)])
    np.testing.assert_allclose(rewards, 0.1, atol=1e-6)
    later = np.stack([env.step(ahead)[1] for _ in range(3)])
    np.testing.assert_allclose(later[0], 0.0 if mode == "NextStep" else 0.1, atol=1e-6)
    np.testing.assert_allclose(later[1:], 0.1, atol=1e-6)


def test_an_episode_records_the_reward_of_all_robots() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([0.1, 0.5]), reward=lambda step: step.arrived + 0.25)
    episode = run_episode(env, make_policy("go-to-goal"))
    np.testing.assert_allclose(episode.trajectory.rewards[0], [1.25, 0.25])
    np.testing.assert_allclose(episode.trajectory.rewards[:, 0], 1.25)
    np.testing.assert_allclose(episode.trajectory.rewards.mean(), episode.metrics["reward"], rtol=1e-6)


def test_the_training_reward_in_numbers() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([0.15, 2.0]), reward="training")
    env.reset(seed=0)
    scale = TrainingReward()
    rewards = env.step(act(env, np.float32([[1, 0], [1, 0]])))[1]
    assert rewards["robot_1"] == pytest.approx(scale.progress - scale.time, abs=1e-5)
    assert rewards["robot_0"] == pytest.approx(scale.progress + scale.arrival - scale.time, abs=1e-5)
    env.step(act(env, np.float32([[1, 0], [1, 0]])))
    assert env.last_step.rewards[0] == 0


def test_the_training_reward_pays_turns_to_goal_headings() -> None:
    """Beside its goal, on its way, backing up, and without a goal heading; at the largest turn rate and half of it."""
    team = Team(("differential_drive",) * 4, max_turn_rate=[1.0, 2.0, 1.0, 1.0])
    start, goal = [[0, 0, 3, 0], [0, 2, 0.5, 0], [0, 4, 3, 0], [0, 6, 0, 0]], [[0.05, 0], [1, 2], [1, 4], [1, 6]]
    problem = Problem(team, start, goal, goal_heading=[-3, -1, 3, np.nan])
    turning, seen = np.float32([[1, 0]] * 4), []

    def look(step: RewardInput) -> Any:
        seen.append(step)
        return step.paper

    env = navigation_v0.parallel_env(problem=problem, reward=look)
    env.reset(seed=0)
    env.step(act(env, turning))
    backwards = 2 * (np.pi - 3)
    np.testing.assert_allclose(seen[0].previous_turns, [2 * np.pi - 6, 1.5, backwards, 0], atol=1e-5)
    np.testing.assert_allclose(seen[0].turns, [2 * np.pi - 6.1, 1.6, backwards - 0.1, 0], atol=1e-5)
    env = navigation_v0.parallel_env(problem=problem, reward="training")
    env.reset(seed=0)
    rewards, scale = env.step(act(env, turning))[1], TrainingReward()
    for robot, paid in enumerate([scale.progress, -scale.progress / 2, scale.progress, 0]):
        assert rewards[f"robot_{robot}"] == pytest.approx(paid - scale.time, abs=1e-5)


def test_turns_to_goal_hitch_angles_are_left_too() -> None:
    """Straightening, bending the wrong way round, a second trailer only, and any angle; in JAX the same."""
    start = [[0, 2 * robot, 0, 0.3, 0.4] for robot in range(4)]
    options: dict[str, Any] = {
        "goal_heading": 0.0,
        "goal_hitches": [[0.0, np.nan], [0.4, np.nan], [np.nan, -0.1], [np.nan, np.nan]],
    }
    goals = np.float32([[1, 2 * robot] for robot in range(4)])
    problem, seen = Problem(Team(("car_with_2_trailers",) * 4), start, goals, **options), []

    def look(step: RewardInput) -> Any:
        seen.append(step)
        return step.paper

    env = navigation_v0.parallel_env(problem=problem, reward=look)
    env.reset(seed=0)
    env.step(act(env, np.float32([[1, 0]] * 4)))
    np.testing.assert_allclose(seen[0].previous_turns, [0.3, 0.1, 0.5, 0], atol=1e-6)
    first, second = seen[0].states[0, 3:]
    np.testing.assert_allclose(seen[0].turns, [first, 0.4 - first, 0.1 + second, 0], atol=1e-6)
    assert first < 0.3
    np.testing.assert_allclose(
        turns_left(problem, jnp.asarray(start), jnp.asarray(goals)), [0.3, 0.1, 0.5, 0], atol=1e-6
    )


@pytest.mark.parametrize("terms", [[np.zeros(2)], {"near": np.zeros(2)}, {"fast": np.zeros(2), "more": np.zeros(2)}])
def test_terms_that_are_not_the_named_ones_are_refused(terms: object) -> None:
    class Own:
        term_names = ("fast",)

        def terms(self, step: RewardInput) -> Any:
            return terms

        def __call__(self, step: RewardInput) -> Any:
            return step.distances

    env = navigation_v0.parallel_env(problem=line_problem([0.15, 2.0]), reward=Own())
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"it must return a dictionary with an array \(2,\) for each of fast"):
        env.step(act(env, np.zeros((2, 2), np.float32)))


def test_infos_say_what_the_training_reward_is_made_of() -> None:
    problem = line_problem([0.15, 2.0])
    options: dict[str, Any] = {"problem": problem, "reward": "training"}
    env, joint, batched = navigation_v0.parallel_env(**options), joint_env(**options), NavigationVectorEnv(2, **options)
    names = [f"reward_{name}" for name in TrainingReward.term_names]
    _, infos = env.reset(seed=0)
    joint.reset(seed=0)
    _, many = batched.reset(seed=0)
    assert all(infos[agent][name] == 0 and not many[name].any() for name in names for agent in infos)
    ahead = np.float32([[1, 0], [1, 0]])
    for count in range(3):
        _, rewards, _, _, infos = env.step(act(env, ahead))
        whole = joint.step(ahead.ravel())[4]["agents"]
        _, _, _, _, many = batched.step(np.stack([ahead.ravel()] * 2))
        for agent, reward in rewards.items():
            assert sum(infos[agent][name] for name in names) == pytest.approx(reward, abs=1e-6)
            robot = int(agent[-1])
            for name in names:
                assert whole[agent][name] == infos[agent][name] == pytest.approx(many[name][1, robot], abs=1e-6)
        assert (whole["robot_0"]["reward_arrival"] > 0) == (count == 0)
        assert infos["robot_1"]["reward_time"] == pytest.approx(-TrainingReward().time)
    _, many = batched.reset(options={"reset_mask": np.array([True, False])})
    assert (many["reward_time"] != 0).any(axis=1).tolist() == [False, False]
    plain = navigation_v0.parallel_env(problem=problem)
    assert not [name for name in plain.reset(seed=0)[1]["robot_0"] if name.startswith("reward_")]


def test_the_paper_is_the_default() -> None:
    one, other = (navigation_v0.parallel_env("circle", 3, **given) for given in ({}, {"reward": "paper"}))
    one.reset(seed=0), other.reset(seed=0)
    zero = np.zeros((3, 2), np.float32)
    assert one.step(act(one, zero))[1] == other.step(act(other, zero))[1]


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        ("papers", "reward 'papers' is unknown; choose one of paper, training"),
        (3, "reward 3 is unknown"),
        (lambda step: 1.0, r"reward '<lambda>' returned shape \(\); expected \(K,\) = \(2,\)"),
        (lambda step: [1.0], r"returned shape \(1,\)"),
        (lambda step: [1.0, np.nan], "returned nan for robot_1; rewards must be finite"),
        (lambda step: "much", "reward '<lambda>': it does not hold numbers only"),
    ],
)
def test_a_bad_reward_is_named(reward: Any, message: str) -> None:
    def run() -> None:
        env = navigation_v0.parallel_env(problem=line_problem([1.0, 1.0]), reward=reward)
        env.reset(seed=0)
        env.step(act(env, np.zeros((2, 2), np.float32)))

    with pytest.raises(ValueError, match=message):
        run()


def test_lifelong_rewards_are_for_the_goals_of_the_step() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([0.15]), reward=closer, lifelong=True)
    env.reset(seed=0)
    assert env.step({"robot_0": np.float32([1, 0])})[1]["robot_0"] == pytest.approx(0.1, abs=1e-6)


@pytest.mark.parametrize("disturbances", [[], [Intruder(30, 1.0)]], ids=["robots and obstacles", "intruders"])
def test_the_collision_penalty_is_an_argument(disturbances: list[Disturbance]) -> None:
    """What it takes off more is what 1 takes off, as often as a robot is within the margin of one kind of thing."""
    settings: dict[str, Any] = {"num_obstacles": 9, "bounds": 0.3, "seed": 1, "disturbances": disturbances}
    envs = [JointNavigationEnv("random", 8, collision_penalty=penalty, **settings) for penalty in (1.0, 3.0)]
    batch = NavigationVectorEnv(1, "random", 8, collision_penalty=3.0, **settings)
    for env in (*envs, batch):
        env.reset(seed=0)
    counts = set()
    for _ in range(30):
        action = envs[0].action_space.high
        (_, usual, *_, info), (_, dear, *_) = (env.step(action) for env in envs)
        kinds = (usual - dear) / 2 * 8
        assert kinds == pytest.approx(round(kinds), abs=1e-4)
        violated = sum(agent["margin_violated"] for agent in info["agents"].values())
        assert violated <= round(kinds) <= 3 * violated
        counts.add(round(kinds))
        assert batch.step(action[None])[1][0] == pytest.approx(dear, abs=1e-5)
    assert len(counts) > 2


def test_a_collision_penalty_must_be_positive() -> None:
    for wrong in (0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="collision_penalty"):
            navigation_v0.parallel_env("circle", num_robots=2, collision_penalty=wrong)
        with pytest.raises(ValueError, match="collision_penalty"):
            line_problem([1.0]).replace(collision_penalty=wrong)


def test_another_penalty_is_another_problem() -> None:
    problem = line_problem([1.0])
    assert problem.replace(collision_penalty=2.0) != problem == problem.replace(collision_penalty=1.0)
