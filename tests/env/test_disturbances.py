"""Disturbances: what each does, the same everywhere, and nothing at level zero."""

from __future__ import annotations

import copy
import math
import pickle
import warnings
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from disturbance_support import CASES, TOGETHER, Wind
from env_support import line_problem, mixed_problem, sampled_actions, slow, straight_drive
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
from pettingzoo.test.state_test import state_test
from registry_support import forgetting
from scipy import stats

from d4orm_env import navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.disturbances import (
    Bias,
    ControlNoise,
    CorrelatedNoise,
    Delay,
    Disturbance,
    DisturbanceEffect,
    Drag,
    Draws,
    Dropout,
    Gain,
    Intruder,
    Lag,
    LimitMismatch,
    Occlusion,
    Push,
    Quantisation,
    Stall,
    StateDelay,
    StateNoise,
)
from d4orm_env.disturbances.disturbance_registry import (
    DISTURBANCES,
    disturbance_at,
    disturbances_at,
    name_of,
    register_disturbance,
)
from d4orm_env.disturbances.disturbed_worlds import DisturbedWorlds
from d4orm_env.disturbances.draws import episode_keys
from d4orm_env.envs.joint_env import JointNavigationEnv
from d4orm_env.envs.joint_state import split_state
from d4orm_env.envs.vector_env import NavigationVectorEnv
from d4orm_env.render import plot_trajectory, save_animation
from d4orm_planners import run_episode

NAMES = pytest.mark.parametrize("name", CASES)
EARLY = line_problem([0.3, 0.5, 0.8], "holonomic2d", goal_radius=0.25, horizon=40)


def test_every_kind_is_tested() -> None:
    assert set(DISTURBANCES) <= {name.partition("-")[0] for name in CASES}


# The same everywhere


@NAMES
def test_pettingzoos_suite(name: str) -> None:
    case = {"problem": EARLY, "observed_rays": 3, "disturbances": [CASES[name]]}
    parallel_api_test(navigation_v0.parallel_env(**case), num_cycles=60)
    parallel_seed_test(partial(navigation_v0.parallel_env, **case), num_cycles=30)
    api_test(navigation_v0.env(**case), num_cycles=40)
    seed_test(partial(navigation_v0.env, **case), num_cycles=30)
    state_test(navigation_v0.env(**case), navigation_v0.parallel_env(**case), num_cycles=40)


@NAMES
def test_gymnasiums_suite(name: str) -> None:
    case = {"problem": EARLY, "observed_rays": 3, "disturbances": [CASES[name]]}
    env = gymnasium.make("d4orm/Navigation-v0", **case).unwrapped
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box action space|.*For Box")
        check_env(env, skip_render_check=True)


def joint_worlds(count: int, case: dict[str, Any]) -> list[JointNavigationEnv]:
    return [JointNavigationEnv(**case) for _ in range(count)]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, slow(AutoresetMode.SAME_STEP)], ids=lambda mode: mode.value)
@pytest.mark.parametrize("disturbances", [*([case] for case in CASES.values()), TOGETHER], ids=[*CASES, "together"])
def test_batched_worlds_are_the_joint_env_to_the_bit(disturbances: list[Any], mode: AutoresetMode) -> None:
    case = {"scenario": "random", "num_robots": 4, "max_cycles": 14, "disturbances": disturbances, "observed_rays": 3}
    batch, singles, random = NavigationVectorEnv(3, autoreset_mode=mode, **case), joint_worlds(3, case), None
    random = np.random.default_rng(0)
    observations, infos = batch.reset(seed=5)
    for world, env in enumerate(singles):
        np.testing.assert_array_equal(observations[world], env.reset(seed=5 + world)[0])
    over = np.zeros(3, bool)
    for _ in range(33):
        actions = (batch.action_space.high * random.uniform(-0.7, 1.3, batch.action_space.shape)).astype(np.float32)
        observations, rewards, terminated, truncated, infos = batch.step(actions)
        states = batch.state()
        for world, env in enumerate(singles):
            if over[world] and mode is AutoresetMode.NEXT_STEP:
                expected, info = env.reset()
                reward, over[world] = 0.0, False
            else:
                expected, reward, *ends, info = env.step(actions[world])
                over[world] = any(ends)
                told = infos["final_info"] if over[world] and mode is AutoresetMode.SAME_STEP else infos
                if over[world]:
                    for key, value in info["metrics"].items():
                        assert told["metrics"][key][world] == pytest.approx(value, abs=1e-4), key
                assert told["is_success"][world] == info["is_success"]
                if over[world] and mode is AutoresetMode.SAME_STEP:
                    expected, info = env.reset()
            assert (terminated | truncated)[world] == over[world]
            np.testing.assert_array_equal(observations[world], expected)
            np.testing.assert_array_equal(states[world], env.state())
            assert rewards[world] == pytest.approx(reward, abs=1e-5)
            for robot, agent in enumerate(info["agents"].values()):
                assert infos["collided"][world, robot] == agent["collided"]
                assert infos["margin_violated"][world, robot] == agent["margin_violated"]
        over &= mode is AutoresetMode.NEXT_STEP


@NAMES
def test_the_parallel_env_is_the_joint_env(name: str) -> None:
    case = {"scenario": "circle", "max_cycles": 12, "observed_rays": 3, "disturbances": [CASES[name]]}
    parallel, joint = navigation_v0.parallel_env(num_robots=3, **case), JointNavigationEnv(num_robots=3, **case)
    seen, _ = parallel.reset(seed=2)
    np.testing.assert_array_equal(np.concatenate(list(seen.values())), joint.reset(seed=2)[0])
    while len(parallel.agents) == 3:
        actions = sampled_actions(parallel)
        seen = parallel.step(actions)[0]
        np.testing.assert_array_equal(
            np.concatenate(list(seen.values())), joint.step(np.concatenate(list(actions.values())))[0]
        )
        np.testing.assert_array_equal(parallel.state(), joint.state())


@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive", "velocity2d", "unicycle", "car"])
def test_every_model_takes_them(model: str) -> None:
    inert = model in ("holonomic2d", "differential_drive", "car")
    for name, one in CASES.items():
        if (name == "drag" and not inert) or (name == "state_noise" and not inert):
            continue
        case = {"model": model, "max_cycles": 25, "observed_rays": 3, "disturbances": [one]}
        env = navigation_v0.parallel_env("circle", 3, **case)
        env.reset(seed=0)
        while env.agents:
            seen, *_ = env.step(sampled_actions(env))
            assert all(values in env.observation_space(agent) for agent, values in seen.items())
            assert env.state() in env.state_space


@pytest.mark.parametrize("name", ["push", "intruder", "stall", "state_noise", "occlusion"])
def test_in_three_dimensions(name: str) -> None:
    one = ControlNoise(0.2) if name == "control_noise" else CASES[name]
    batch = NavigationVectorEnv(2, "sphere", 4, max_cycles=20, disturbances=[one])
    batch.reset(seed=0)
    for _ in range(25):
        observations, *_ = batch.step(batch.action_space.sample())
        assert observations in batch.observation_space


def test_mixed_teams() -> None:
    together = [one for one in TOGETHER if not isinstance(one, Dropout)] + [Dropout(0.3, hold=False)]
    env = navigation_v0.parallel_env(problem=mixed_problem(), disturbances=together)
    env.reset(seed=0)
    while env.agents:
        env.step(sampled_actions(env))
        assert env.state() in env.state_space


# Level zero


ZERO: list[Disturbance[Any]] = [
    ControlNoise(0), CorrelatedNoise(0.0, 1.0), Bias((0, 0)), Delay(0), Delay((0, 0)), Dropout(0), Quantisation(0),
    Gain(0), StateNoise(0), StateDelay(0), Occlusion(math.inf), Push(0, 1), Push(1, 0), Stall(0), Stall(1.0, 0),
    Intruder(0), Drag(0), LimitMismatch(1), Lag(0),
]  # fmt: skip


def drive(problem: Problem, **options: Any) -> tuple[Any, list[np.ndarray], list[dict[str, np.ndarray]]]:
    env = navigation_v0.parallel_env(problem=problem, **options)
    seen = [env.reset(seed=3)[0]]
    states = [env.state()]
    controls = straight_drive(problem, 0.8)
    for control in controls:
        if not env.agents:
            break
        robots = [env.possible_agents.index(agent) for agent in env.agents]
        seen.append(env.step(dict(zip(env.agents, control[robots])))[0])
        states.append(env.state())
    return env, states, seen


@pytest.mark.parametrize("zero", ZERO, ids=repr)
def test_level_zero_is_the_undisturbed_environment(zero: Disturbance[Any]) -> None:
    (_, plain, seen), (env, disturbed, seen_too) = drive(EARLY), drive(EARLY, disturbances=[zero])
    np.testing.assert_array_equal(plain, disturbed)
    np.testing.assert_equal(seen, seen_too)
    assert env.state_space == navigation_v0.parallel_env(problem=EARLY).state_space


def test_the_short_form_is_the_first_disturbance() -> None:
    short = drive(EARLY, control_noise_std=(0.2, 0.1), disturbances=[Delay(1)])[1]
    np.testing.assert_array_equal(short, drive(EARLY, disturbances=[ControlNoise((0.2, 0.1)), Delay(1)])[1])
    assert not np.array_equal(short, drive(EARLY, disturbances=[Delay(1), ControlNoise((0.2, 0.1))])[1])


# Moments


def worlds(one: Disturbance[Any], count: int, problem: Problem | None = None, max_cycles: int = 100) -> Any:
    """``count`` worlds of ten robots with a disturbance, and the scene at their beginning."""
    problem = problem or line_problem([9.0] * 10, "holonomic2d")
    disturbed = DisturbedWorlds([one], problem, count, max_cycles)
    start, goal = (np.repeat(part[None], count, axis=0) for part in (problem.start, problem.goal))
    random = np.random.default_rng(1)
    disturbed.begin(np.arange(count), random.integers(2**63, size=count).tolist(), start, goal)
    none = np.zeros((count, problem.num_robots, problem.control_size), np.float32)
    arrived = np.zeros((count, problem.num_robots), bool)
    return disturbed, disturbed.scene(start, goal, start, none, arrived, np.zeros(count, np.int64))


def commands(one: Disturbance[Any], steps: int, count: int = 400, value: float = 1.0) -> np.ndarray:
    """``(steps, count, 10, 2)`` what becomes of a constant command."""
    disturbed, scene = worlds(one, count)
    executed = []
    for step in range(steps):
        scene = scene._replace(steps=np.full(count, step), bodies=disturbed.bodies)
        executed.append(disturbed.act(scene, np.full_like(scene.controls, value))[1].copy())
    return np.array(executed)


def assert_normal(samples: np.ndarray, std: float) -> None:
    assert stats.kstest(samples.ravel() / std, "norm").pvalue > 1e-3
    numbers = samples.ravel() / std
    assert abs((numbers[1:] * numbers[:-1]).mean()) < 5 / math.sqrt(len(numbers))


def test_control_noise_is_white_and_gaussian() -> None:
    noise = commands(ControlNoise((0.2, 0.4)), 10) - 1
    assert_normal(noise[..., 0], 0.2)
    assert_normal(noise[..., 1], 0.4)
    pairs = noise.reshape(10, -1, 2) / (0.2, 0.4)
    assert abs((pairs[:-1] * pairs[1:]).mean()) < 0.02
    assert abs((pairs[..., 0] * pairs[..., 1]).mean()) < 0.02


def test_correlated_noise_has_its_time_constant() -> None:
    noise = commands(CorrelatedNoise(0.3, 0.5), 30) - 1
    assert_normal(noise[0], 0.3)
    assert_normal(noise[-1], 0.3)
    for lag in (1, 5, 10):
        correlation = (noise[lag:] * noise[:-lag]).mean() / 0.09
        assert correlation == pytest.approx(math.exp(-0.1 * lag / 0.5), abs=0.03)


def test_bias_and_gain_are_drawn_once_an_episode() -> None:
    bias, gain = commands(Bias(0.2), 3) - 1, commands(Gain(0.2), 3, value=2.0) / 2
    for drawn in (bias, gain):
        np.testing.assert_array_equal(drawn[0], drawn[-1])
    assert_normal(bias[0], 0.2)
    assert_normal(gain[0, ..., 0] - 1, 0.2)
    np.testing.assert_array_equal(gain[..., 0], gain[..., 1])
    assert commands(Gain(3.0), 1).min() == 0


def numbered(one: Disturbance[Any], steps: int, count: int = 200) -> np.ndarray:
    """``(steps, count, 10)`` numbers from 1 on of the commands that are executed, 0 for none."""
    disturbed, scene = worlds(one, count)
    executed = []
    for step in range(steps):
        scene = scene._replace(steps=np.full(count, step))
        executed.append(disturbed.act(scene, np.full_like(scene.controls, step + 1))[1][..., 0])
    return np.array(executed)


def test_delay_is_so_many_steps() -> None:
    np.testing.assert_array_equal(numbered(Delay(3), 8)[:, 0, 0], [0, 0, 0, 1, 2, 3, 4, 5])
    late = np.arange(1, 21)[4:, None, None] - numbered(Delay((1, 3)), 20)[4:]
    counts = np.bincount(late.astype(int).ravel(), minlength=5)
    assert counts[[0, 4]].sum() == 0
    assert stats.chisquare(counts[1:4]).pvalue > 1e-3


def test_actuators_lag_behind_by_their_time_constant() -> None:
    executed = commands(Lag(0.2), 30)[:, 0, 0, 0]  # they are told 1, and a step is 0.1 s
    ends = 1 - np.exp(-0.1 * np.arange(31) / 0.2)
    # The mean over a step of what rises like that: the velocity gained is that of the command, less what is left.
    np.testing.assert_allclose(np.cumsum(executed) * 0.1, 0.1 * np.arange(1, 31) - 0.2 * ends[1:], atol=1e-5)
    assert (np.diff(executed) > 0).all()
    assert executed[-1] == pytest.approx(1, abs=1e-5)


def test_dropout_loses_that_share_and_holds_the_last() -> None:
    executed = numbered(Dropout(0.3), 50)
    lost = executed != np.arange(1, 51)[:, None, None]
    assert lost.mean() == pytest.approx(0.3, abs=0.01)
    before = np.concatenate([np.zeros_like(executed[:1]), executed[:-1]])
    np.testing.assert_array_equal(executed[lost], before[lost])


def test_dropout_without_holding_brakes() -> None:
    problem = line_problem([9.0] * 2, "holonomic2d", horizon=40)
    env = navigation_v0.parallel_env(problem=problem, disturbances=[Dropout(1.0, hold=False)])
    env.reset(seed=0)
    moving = np.array(problem.start)
    moving[:, 2] = 0.5
    env.set_state(moving)
    for _ in range(8):
        env.step(dict.fromkeys(env.agents, np.array([1.0, 1.0], np.float32)))
    np.testing.assert_allclose(split_state(problem, env.state()).states[:, 2:], 0, atol=1e-6)


@given(step=st.floats(0.01, 2), value=st.floats(-3, 3))
@settings(max_examples=40, deadline=None)
def test_quantisation_rounds_to_the_nearest(step: float, value: float) -> None:
    executed = commands(Quantisation(step), 1, count=1, value=value)
    assert np.abs(executed - np.float32(value)).max() <= step / 2 * (1 + 1e-4)
    np.testing.assert_allclose(executed / np.float32(step), np.rint(executed / np.float32(step)), atol=1e-3)


def test_state_noise_has_its_moments_and_leaves_the_truth() -> None:
    problem = line_problem([9.0] * 10, "differential_drive")
    disturbed, scene = worlds(StateNoise(0.02, 0.05, 0.1), 300, problem)
    noise = disturbed.see(scene).states - scene.states
    for column, std in enumerate([0.02, 0.02, 0.1, 0.05]):
        assert_normal(noise[..., column], std)
    np.testing.assert_array_equal(scene.states, np.repeat(problem.start[None], 300, axis=0))


def test_infos_and_metrics_tell_the_truth() -> None:
    env = navigation_v0.parallel_env(problem=EARLY, disturbances=[StateNoise(0.5), StateDelay(3)])
    true = navigation_v0.parallel_env(problem=EARLY)
    env.reset(seed=0), true.reset(seed=0)
    assert not np.allclose(env.state(), true.state())
    while true.agents:
        action = dict.fromkeys(true.agents, np.array([0.6, 0.0], np.float32))
        got, expected = env.step(action), true.step(action)
        np.testing.assert_equal(got[1:], expected[1:])
    assert env.metrics() == true.metrics()


def test_state_delay_shows_the_past() -> None:
    (_, true, seen), (_, late, late_seen) = drive(EARLY), drive(EARLY, disturbances=[StateDelay(2)])
    problem, past = EARLY, [0, 0, 0, *range(1, len(true))]
    for now, then in enumerate(past[: len(true)]):
        joint, before = split_state(problem, late[now]), split_state(problem, true[then])
        np.testing.assert_array_equal(joint.states, before.states)
        np.testing.assert_array_equal(joint.controls, before.controls)
        assert joint.steps == now
    assert late_seen[5]["robot_2"][0] == seen[3]["robot_2"][0]


def test_looking_again_sees_the_same() -> None:
    env = navigation_v0.parallel_env(problem=EARLY, disturbances=TOGETHER)
    env.reset(seed=0)
    for _ in range(3):
        env.step(dict.fromkeys(env.agents, np.array([0.3, 0.0], np.float32)))
    before = env.state()
    env.set_state(env._simulation.states)
    np.testing.assert_array_equal(env.state(), before)


def test_occlusion_hides_what_is_far() -> None:
    problem = line_problem([3.0] * 4, horizon=10)
    layout = navigation_v0.parallel_env(problem=problem)._simulation.setup.layout
    for reach, present in ((0.9, [0, 0, 0, 0]), (1.1, [1, 2, 2, 1]), (2.1, [2, 3, 3, 2])):
        env = navigation_v0.parallel_env(problem=problem, disturbances=[Occlusion(reach)])
        rows = layout.neighbors(np.array(list(env.reset(seed=0)[0].values())))
        assert rows[..., layout.neighbor.present].sum(axis=(1, 2)).tolist() == present
        assert not rows[rows[..., 0] == 0].any()


def test_occlusion_hides_intruders_from_the_state() -> None:
    env = navigation_v0.parallel_env("circle", 4, disturbances=[Intruder(9, 0.5), Occlusion(1.0)], max_cycles=60)
    truth = navigation_v0.parallel_env("circle", 4, disturbances=[Intruder(9, 0.5)], max_cycles=60)
    env.reset(seed=1), truth.reset(seed=1)
    hidden = shown = 0
    while env.agents:
        seen, bodies = (split_state(one.problem, one.state()) for one in (env, truth))
        gaps = np.linalg.norm(bodies.bodies[:, None, :2] - seen.states[:, :2], axis=-1).min(axis=1)
        np.testing.assert_array_equal(seen.bodies[gaps > 1.0], 0)
        np.testing.assert_array_equal(seen.bodies[gaps <= 1.0], bodies.bodies[gaps <= 1.0])
        hidden, shown = hidden + (gaps > 1.0).sum(), shown + (gaps <= 1.0).sum()
        for one in (env, truth):
            one.step(dict.fromkeys(one.agents, np.zeros(2, np.float32)))
    assert hidden
    assert shown


def test_pushes_come_at_their_rate_with_their_speed() -> None:
    disturbed, scene = worlds(Push(1.5, 0.3), 500)
    given = []
    for step in range(20):
        scene = scene._replace(steps=np.full(500, step))
        states, _ = disturbed.act(scene, scene.controls)
        given.append(disturbed.effect(scene).pushed.copy())
        np.testing.assert_allclose(states[..., 2:] - scene.states[..., 2:], given[-1], atol=1e-6)
    speed = np.linalg.norm(given, axis=-1)
    hit = speed > 0
    assert hit.mean() == pytest.approx(1 - math.exp(-0.15), abs=0.005)
    np.testing.assert_allclose(speed[hit], 0.3, rtol=1e-5)
    angles = np.arctan2(*np.moveaxis(np.array(given)[hit], -1, 0))
    assert stats.kstest(angles, stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-3


def test_a_push_across_the_wheels_is_a_slip() -> None:
    problem = line_problem([9.0], "differential_drive")  # it heads along x
    disturbed, scene = worlds(Push(1e5, 0.3), 300, problem)
    states, _ = disturbed.act(scene, scene.controls)
    given = disturbed.effect(scene).pushed
    np.testing.assert_allclose(states[..., 3], given[..., 0], atol=1e-6)
    np.testing.assert_allclose(states[..., 1], 0.1 * given[..., 1], atol=1e-6)
    np.testing.assert_allclose(states[..., 0], 0, atol=1e-6)


def test_docked_robots_are_not_pushed() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([0.1, 5.0]), disturbances=[Push(1e5, 0.5), Wind(0.5)])
    env.reset(seed=0)
    env.set_state([[0.1, 0.0], [0.0, 1.0]])
    env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    where = []
    while env.agents:
        where.append(env._simulation.states[0].copy())
        env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    if env._simulation.arrived[0]:
        np.testing.assert_array_equal(where[0], where[-1])


def test_a_robot_that_has_stalled_stands_and_need_not_arrive() -> None:
    env = navigation_v0.parallel_env(problem=EARLY, disturbances=[Stall(1.0, robots=1)], max_cycles=40)
    outcomes = set()
    for seed in range(12):
        env.reset(seed=seed)
        while env.agents:
            stalled = env._simulation.effect().stalled[0]
            env.step(dict.fromkeys(env.agents, np.array([0.5, 0.0], np.float32)))
            assert not (env._simulation.effect().stalled[0] & env._simulation.arrived).any()
            if env._simulation.out_of_time:
                moving = np.linalg.norm(env._simulation.states[:, 2:], axis=1)
                np.testing.assert_allclose(moving[stalled], 0, atol=1e-6)
        lost = int(env._simulation.effect().lost.sum())
        assert lost <= 1
        assert env.metrics()["arrived"] == 3 - lost
        assert env.metrics()["success"] == 1
        outcomes.add(lost)
    assert outcomes == {0, 1}  # it may stall after it has arrived


def test_stalls_come_with_their_probability_and_end() -> None:
    disturbed, scene = worlds(Stall(0.25, 2.0), 500)
    stalled = []
    for step in range(100):
        stalled.append(disturbed.effect(scene._replace(steps=np.full(500, step))).stalled)
    steps = np.sum(stalled, axis=0)
    assert set(np.unique(steps)) == {0, 20}
    assert (steps > 0).mean() == pytest.approx(0.25, abs=0.02)
    began = np.argmax(stalled, axis=0)[steps > 0]
    assert stats.kstest(began + 0.5, stats.uniform(0, 50).cdf).pvalue > 1e-3
    assert not disturbed.effect(scene).lost.any()


@pytest.mark.parametrize("dimension", [2, 3])
def test_intruders_keep_their_course_and_off_starts_and_goals(dimension: int) -> None:
    scenario = "circle" if dimension == 2 else "sphere"
    env = navigation_v0.parallel_env(scenario, 6, disturbances=[Intruder(4, 0.5)], max_cycles=300)
    env.reset(seed=4)
    problem, still = env.problem, np.zeros(dimension, np.float32)
    stands = np.concatenate([problem.start[:, :dimension], problem.goal])
    before, seen, met = split_state(problem, env.state()).bodies, [], 0
    while env.agents:
        *_, infos = env.step(dict.fromkeys(env.agents, still))
        after = split_state(problem, env.state()).bodies
        np.testing.assert_allclose(np.linalg.norm(after[:, dimension:-1], axis=1), 0.5, rtol=1e-5)
        same = (before[:, dimension:] == after[:, dimension:]).all(axis=1)
        np.testing.assert_allclose(
            after[same, :dimension], before[same, :dimension] + 0.1 * before[same, dimension:-1], atol=1e-5
        )
        gaps = np.linalg.norm(after[:, None, :dimension] - stands, axis=-1)
        assert gaps.min() > 0.3
        met += sum(info["collided"] for info in infos.values())
        before = after
        seen.append(same)
    assert met == 0
    assert not np.all(seen)  # some left, and came again


def test_touching_an_intruder_is_a_collision() -> None:
    case = {"problem": line_problem([9.0] * 3, horizon=400), "disturbances": [Intruder(30, 1.0)]}
    env, batch = JointNavigationEnv(**case), NavigationVectorEnv(1, **case)
    env.reset(seed=3), batch.reset(seed=3)
    touched = 0
    for _ in range(60):
        action = np.tile(np.array([0.5, 0.0], np.float32), 3)
        *_, info = env.step(action)
        batch.step(action[None])
        joint = split_state(env.problem, env.state())
        gaps = np.linalg.norm(joint.states[:, None] - joint.bodies[:, :2], axis=-1) - 0.3
        for robot, agent in enumerate(info["agents"].values()):
            assert agent["collided"] == (gaps[robot] <= 0).any()
            assert agent["margin_violated"] == (gaps[robot] <= 0.05).any()
            touched += agent["collided"]
    assert touched
    assert info["metrics"]["collisions"] == touched
    assert not info["is_success"]
    np.testing.assert_allclose(batch.metrics()["reward"], info["metrics"]["reward"], atol=1e-5)


def test_drag_slows_by_its_law() -> None:
    problem = line_problem([30.0], "holonomic2d")
    env = navigation_v0.parallel_env(problem=problem, disturbances=[Drag(0.5)])
    env.reset(seed=0)
    env.set_state([[0, 0, 0.8, -0.3]])
    for _ in range(10):
        env.step(dict.fromkeys(env.agents, np.zeros(2, np.float32)))
    speed = split_state(problem, env.state()).states[0, 2:]
    np.testing.assert_allclose(speed, np.array([0.8, -0.3]) * math.exp(-0.5), rtol=1e-5)


def test_limits_are_truly_lower_and_seen_as_before() -> None:
    problem = line_problem([30.0], "holonomic2d")
    env = navigation_v0.parallel_env(problem=problem, disturbances=[LimitMismatch(0.6)])
    seen, _ = env.reset(seed=0)
    layout = env._simulation.setup.layout
    for _ in range(30):
        seen, *_ = env.step(dict.fromkeys(env.agents, np.array([1.0, 0.0], np.float32)))
        assert split_state(problem, env.state()).controls[0, 0] == pytest.approx(0.6)
        assert seen["robot_0"][layout.own.max_speed] == 1
    assert seen["robot_0"][layout.own.speed] == pytest.approx(0.6, abs=1e-5)


def test_robots_are_weaker_backwards_and_to_the_right_too() -> None:
    own = {"max_reverse_speed": 0.5, "max_right_turn_rate": 0.5}
    problem = line_problem([30.0], "unicycle1").replace(team=Team(("unicycle1",), max_turn_rate=1.0, own_limits=own))
    env = navigation_v0.parallel_env(problem=problem, disturbances=[LimitMismatch(0.8)])
    env.reset(seed=0)
    env.step({"robot_0": np.array([-0.5, -0.5], np.float32)})
    np.testing.assert_allclose(split_state(problem, env.state()).controls[0], -0.4)


# Draws


def test_a_disturbance_draws_the_same_whatever_stands_beside_it() -> None:
    problem = line_problem([9.0] * 3, "holonomic2d")
    pushes = []
    for beside in ([], [ControlNoise(0.3)], [Delay(2), Stall(0.5), Intruder(1)]):
        env = navigation_v0.parallel_env(problem=problem, disturbances=[*beside, Push(3.0, 0.3)])
        env.reset(seed=8)
        log = []
        for _ in range(20):
            env.step(dict.fromkeys(env.agents, np.zeros(2, np.float32)))
            log.append(env._simulation.effect().pushed.copy())
        pushes.append(log)
    np.testing.assert_array_equal(pushes[0], pushes[1])
    np.testing.assert_array_equal(pushes[0], pushes[2])
    assert np.any(pushes[0])


def test_two_of_a_kind_draw_differently() -> None:
    twice = drive(EARLY, disturbances=[ControlNoise(0.2), ControlNoise(0.2)])[1]
    once = drive(EARLY, disturbances=[ControlNoise(0.4)])[1]
    assert not np.array_equal(twice, once)


def test_draws_of_some_worlds_are_those_of_all() -> None:
    keys, steps = episode_keys([5, 6, 2**63 - 1, 7]), np.arange(4)
    some, rest = np.array([2, 0]), Draws(keys, steps, 9, 1)
    rest.normal(1)
    part = rest.of(some)
    np.testing.assert_array_equal(part.uniform(3, 2), rest.uniform(3, 2)[some])
    assert len(np.unique(Draws(keys, steps, 9, 1).uniform(50))) == 200


@given(
    seeds=st.lists(st.integers(0, 2**63 - 1), min_size=1, max_size=4), low=st.integers(-5, 5), width=st.integers(0, 9)
)
@settings(max_examples=30, deadline=None)
def test_whole_numbers_keep_their_range(seeds: list[int], low: int, width: int) -> None:
    numbers = Draws(episode_keys(seeds), np.zeros(len(seeds), np.int64), 1, 0).whole(low, low + width, 50)
    assert numbers.shape == (len(seeds), 50)
    assert numbers.min() >= low
    assert numbers.max() <= low + width


def test_an_environment_under_way_can_be_copied_and_sent() -> None:
    env = navigation_v0.parallel_env("circle", 3, disturbances=TOGETHER)
    env.reset(seed=0)
    for _ in range(4):
        env.step(sampled_actions(env))
    action = sampled_actions(env)
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        twin = copy.deepcopy(other)
        for _ in range(5):
            np.testing.assert_equal(twin.step(action), other.step(action))
            np.testing.assert_array_equal(twin.state(), other.state())


# What makes no sense


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: ControlNoise(-0.1), "ControlNoise std is -0.1"),
        (lambda: ControlNoise("much"), "ControlNoise std must be a number"),
        (lambda: ControlNoise(True), "ControlNoise std must be a number .*, not True; .* text and True are none"),
        (lambda: Bias((True, 0.1)), r"Bias std must be a number .*, not \(True, 0.1\)"),
        (lambda: ControlNoise([[0.1]]), "ControlNoise std has shape"),
        (lambda: CorrelatedNoise(0.1, 0), "CorrelatedNoise time_constant is 0"),
        (lambda: Bias(float("nan")), "Bias std is nan"),
        (lambda: Delay(-1), "Delay steps is -1"),
        (lambda: Delay(1.5), "Delay steps must be a whole number"),
        (lambda: Delay((3, 1)), "Delay steps is 1; it must be at least 3"),
        (lambda: Delay((1, 2, 3)), r"Delay steps is \(1, 2, 3\)"),
        (lambda: Delay(10**6), "Delay steps is 1000000; it must be at most 1000"),
        (lambda: Lag(-1), "Lag time_constant is -1"),
        (lambda: Dropout(1.5), "Dropout probability is 1.5; it must be at most 1"),
        (lambda: Dropout(0.5, hold="no"), "Dropout hold is 'no'"),
        (lambda: Quantisation(-1), "Quantisation step is -1"),
        (lambda: Gain(float("inf")), "Gain std is inf"),
        (lambda: StateNoise(0.1, -1), "StateNoise velocity_std is -1"),
        (lambda: StateDelay(0.5), "StateDelay steps must be a whole number"),
        (lambda: Occlusion(0), "Occlusion range is 0"),
        (lambda: Push(-1, 1), "Push rate is -1"),
        (lambda: Push(1, None), "Push speed must be a number"),
        (lambda: Stall(2), "Stall probability is 2"),
        (lambda: Stall(0.5, -1), "Stall duration is -1"),
        (lambda: Stall(0.5, robots=0), "Stall robots is 0"),
        (lambda: Intruder(-1, 1), "Intruder count is -1"),
        (lambda: Intruder(1, 1, 0), "Intruder radius is 0"),
        (lambda: Drag(-0.5), "Drag coefficient is -0.5"),
        (lambda: LimitMismatch(1.2), "LimitMismatch factor is 1.2; it must be at most 1"),
        (lambda: LimitMismatch(0), "LimitMismatch factor is 0"),
    ],
)
def test_levels_without_sense_are_refused(make: Any, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint) as error:
        make()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("disturbances", "complaint"),
    [
        ([Drag(0.5)], "Drag slows what has inertia, and robot_0, a velocity2d"),
        ([StateNoise(0.1, velocity_std=0.1)], "no state of velocity2d holds a velocity"),
        ([StateNoise(0.1, heading_std=0.1)], "no state of velocity2d holds a heading"),
        ([Bias((0.1, 0.1, 0.1))], r"Bias std has shape \(3,\); give one number, or 2"),
        ([Stall(1.0, robots=2)], "Stall robots is 2; the team has 1, so give at most that"),
        ("delay", "disturbances is 'delay'; give a list"),
        ([2], "disturbances holds 2, which is none"),
        ([Delay], "disturbances holds <class"),
        (7, "disturbances is 7"),
    ],
)
def test_what_an_environment_cannot_have_is_refused(disturbances: Any, complaint: str) -> None:
    for make in (navigation_v0.parallel_env, navigation_v0.env, JointNavigationEnv, partial(NavigationVectorEnv, 2)):
        with pytest.raises(ValueError, match=complaint):
            make(problem=line_problem([1.0]), disturbances=disturbances)


@pytest.mark.parametrize(
    ("method", "complaint"),
    [
        ({"command": lambda self, controls, memory, scene, draws: controls[:, :1]},
         r"command returned shape \(1, 1, 2\); expected \(1, 3, 2\)"),
        ({"command": lambda self, controls, memory, scene, draws: controls * np.nan},
         r"command returned array\(\[nan.*; expected finite numbers"),
        ({"move": lambda self, states, controls, *rest: states}, "move returned array.*; expected 2 arrays"),
        ({"see": lambda self, seen, memory, scene, draws: None}, "see returned None; expected 3 arrays"),
        ({"begin": lambda self, scene, draws: np.zeros(1)}, r"begin returned array\(\[0.\]\); expected a NamedTuple"),
        ({"command": lambda self, controls, *rest: "fast"}, "command returned 'fast'; expected numbers of shape"),
        ({"effect": lambda self, memory, scene: None}, r"effect returned None; expected a DisturbanceEffect"),
        ({"effect": lambda self, memory, scene: DisturbanceEffect(bodies=np.zeros((1, 4)))},
         r"effect returned .* pushed \(1, 3, 2\), .* bodies \(1, None, 5\)"),
        ({"slack": lambda self, problem: 0.5}, "slack returned 0.5; expected a BoundsSlack"),
        ({"limits": lambda self, limits: None}, r"limits returned shape \(\); expected \(3, 3\)"),
        ({"limits": lambda self, limits: limits[0]}, r"limits returned shape \(3,\); expected \(3, 3\)"),
        ({"limits": lambda self, limits: limits * np.nan}, r"limits returned array\(\[nan.*; expected finite"),
        ({"limits": lambda self, limits: limits * [[1, 1, 0]]}, r"limits returned array\(\[0.*; expected numbers of"),
        ({"command": lambda self, controls, memory: controls}, "command takes .* is called with .*scene, draws"),
    ],
)  # fmt: skip
def test_a_users_disturbance_that_returns_nonsense_is_named(method: Any, complaint: str) -> None:
    wrong = type("Wrong", (Disturbance,), method)

    def go() -> None:
        env = navigation_v0.parallel_env("circle", 3, disturbances=[wrong()])
        env.reset(seed=0)
        env.step(sampled_actions(env))

    with pytest.raises(ValueError, match=f"disturbance Wrong: {complaint}"):
        go()


# Names


def test_disturbances_by_name_and_level() -> None:
    assert disturbance_at("delay", 2) == Delay(2)
    assert disturbance_at("push.speed", 0.5) == Push(speed=0.5)
    assert disturbances_at({"push.speed": 0.5, "delay": 1, "push.rate": 2}) == (Push(2, 0.5), Delay(1))
    assert disturbance_at(f"{Wind.__module__}:Wind.speed", 0.3) == Wind(0.3)
    assert disturbance_at("push(rate=0.5).speed", 0.2) == Push(0.5, 0.2)
    assert disturbance_at("stall(duration=inf, robots=1)", 0.5) == Stall(0.5, math.inf, 1)
    assert disturbance_at(f"{CorrelatedNoise.__module__}:CorrelatedNoise(std=[0.1, 0.2]).time_constant", 2) == (
        CorrelatedNoise((0.1, 0.2), 2.0)
    )
    assert disturbances_at({"stall(robots=1)": 1, "stall.duration": 2}) == (Stall(1.0, 2.0, 1),)
    assert [name_of(one) for one in (Delay(1), Push(1, 1), Wind())] == ["delay", "push", "disturbance_support:Wind"]
    with forgetting(DISTURBANCES):
        register_disturbance("wind", Wind)
        assert disturbance_at("wind", 0.3) == Wind(0.3)
        assert name_of(Wind()) == "wind"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("dely", "disturbance 'dely' is unknown; choose one of control_noise, "),
        ("push.force", "disturbance 'push' has no 'force'; it has rate, speed"),
        ("state_noise.velocity_std", "needs position_std too"),
        ("no.such:Wind", "disturbance 'no.such:Wind' cannot be imported"),
        ("math:pi", "disturbance 'math:pi' is 3.14"),
        ("push(rate=1", r"disturbance 'push\(rate=1' is not of the form push\(rate=0.5\).speed"),
        ("push(rate=1)speed", "is not of the form"),
        ("push(rate).speed", "write what is in brackets as name=value"),
        ("push(rate=[).speed", "what is in brackets is not YAML"),
        ("push(force=1).speed", "disturbance 'push' has no 'force'"),
        ("push(speed=1).speed", "gives speed twice"),
        ("push(rate=-1).speed", "Push rate is -1"),
    ],
)
def test_names_that_mean_nothing(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        disturbance_at(text, 0.1)


def test_an_attribute_is_given_once() -> None:
    with pytest.raises(ValueError, match=r"disturbance 'push\(rate=2\).speed' gives rate once more"):
        disturbances_at({"push.rate": 1, "push(rate=2).speed": 1})


# What pictures and records of an execution show


def test_an_episode_records_the_truth_and_where_it_was_disturbed(tmp_path: Any) -> None:
    quiet, noisy = (
        run_episode(navigation_v0.parallel_env(problem=EARLY, disturbances=[*perception, Push(2.0, 0.2)]), "random")
        for perception in ([], [StateNoise(0.3), StateDelay(2)])
    )
    # A policy that looks at nothing moves the same whatever is seen.
    np.testing.assert_array_equal(quiet.trajectory.states, noisy.trajectory.states)
    events = noisy.events
    assert events.pushed.shape == (len(events.stalled), 3, 2)
    assert len(events.pushed) == len(noisy.trajectory.states)
    assert events.pushed.any()
    assert not events.pushed[0].any()
    assert run_episode(navigation_v0.parallel_env(problem=EARLY), "random").events is None


def test_events_until_a_step_end_with_it() -> None:
    env = navigation_v0.parallel_env("circle", 3, disturbances=[Push(2.0, 0.3), Intruder(2)], max_cycles=8)
    events = run_episode(env, "go-to-goal").events
    for step in (0, 5):
        first = events.until(step)
        assert len(first.pushed) == len(first.stalled) == len(first.bodies) == step + 1
        np.testing.assert_array_equal(first.bodies, events.bodies[: step + 1])


@pytest.mark.parametrize("scenario", ["circle", "sphere"])
def test_pictures_show_where_it_was_disturbed(scenario: str, tmp_path: Any) -> None:
    disturbances = [Push(2.0, 0.3), Stall(1.0, robots=1), Intruder(2)]
    episode = run_episode(
        navigation_v0.parallel_env(scenario, 3, disturbances=disturbances, max_cycles=30), "go-to-goal"
    )
    problem, trajectory, events = episode.problem, episode.trajectory, episode.events
    figure = plot_trajectory(problem, trajectory, events=events)
    told = {text.get_text() for text in figure.legends[0].get_texts()}
    assert told >= {"push", "moving obstacle"}
    assert ("stalls" in told) == events.stalled.any()
    assert not {text.get_text() for text in plot_trajectory(problem, trajectory).legends[0].get_texts()} & {"push"}
    save_animation(problem, trajectory, tmp_path / "plain.gif", max_frames=4)
    save_animation(problem, trajectory, tmp_path / "marked.gif", max_frames=4, events=events)
    assert (tmp_path / "plain.gif").read_bytes() != (tmp_path / "marked.gif").read_bytes()


def test_frames_show_intruders() -> None:
    frames = []
    for disturbances in ([], [Intruder(5)]):
        env = navigation_v0.parallel_env("circle", 2, render_mode="rgb_array", disturbances=disturbances)
        env.reset(seed=0)
        frames.append(env.render())
        env.close()
    assert (frames[0] != frames[1]).any()


WEIRD = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 2000),
    st.floats(),
    st.text(max_size=3),
    st.tuples(st.integers(), st.floats()),
)


@given(name=st.sampled_from(sorted(DISTURBANCES)), level=WEIRD)
@settings(max_examples=60, deadline=None)
def test_any_level_works_or_is_refused_in_one_line(name: str, level: Any) -> None:
    complaint = ""
    try:
        env = navigation_v0.parallel_env(problem=EARLY, disturbances=[disturbance_at(name, level)])
    except ValueError as error:
        complaint = str(error)
    assert "\n" not in complaint
    if complaint:
        return
    env.reset(seed=0)
    for _ in range(3):
        seen, *_ = env.step(dict.fromkeys(env.agents, np.array([0.5, 0.0], np.float32)))
        assert all(values in env.observation_space(agent) for agent, values in seen.items())
        assert env.state() in env.state_space
