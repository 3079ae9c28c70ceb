from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from env_support import line_problem, mixed_problem
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.envs.joint_env import ENV_ID, JointNavigationEnv, register_environments
from d4orm_env.envs.vector_env import NavigationVectorEnv

FLAGS = ("arrived", "collided", "margin_violated")


@pytest.fixture(autouse=True)
def _registered() -> None:
    register_environments()


def obstacle_problem() -> Problem:
    world = World(circles=[[0.5, 0.6, 0.1]], boxes=[[-1, -1, -0.6, -0.5]], lower=[-2, -2], upper=[3, 3])
    return Problem(Team(("holonomic2d",) * 3), [[0, 0, 0, 0], [0, 1, 0, 0], [0, 2, 0, 0]],
                   [[0.3, 0], [1, 1], [1, 2]], world=world, horizon=30)  # fmt: skip


CASES: dict[str, dict[str, Any]] = {
    "circle": {"scenario": "circle", "num_robots": 5, "max_cycles": 23},
    "differential": {"scenario": "circle", "num_robots": 3, "model": "differential_drive", "max_cycles": 23},
    "mixed-team": {"problem": mixed_problem()},
    "obstacles": {"problem": obstacle_problem()},
    "3d-cylinders": {"scenario": "amswarm_2", "max_cycles": 17},
    "noise": {"scenario": "circle", "num_robots": 3, "control_noise_std": 0.4, "max_cycles": 40},
    "new-instances": {"scenario": "random", "num_robots": 3, "randomize_instance": True, "max_cycles": 11},
    "arrivals": {"problem": line_problem([0.12, 0.3], horizon=25), "control_noise_std": [0.1, 0.2]},
    "one-robot": {"problem": line_problem([0.3], horizon=25)},
    "few-seen": {"scenario": "circle", "num_robots": 4, "observed_robots": 1, "observed_obstacles": 0, "max_cycles": 9},
}


def drive(env: gymnasium.vector.VectorEnv[Any, Any, Any], random: np.random.Generator) -> np.ndarray:
    """Random actions, beyond the limits at times, with a drift that makes some robots arrive."""
    high = env.single_action_space.high
    return (high * random.uniform(-0.7, 1.3, env.action_space.shape)).astype(np.float32)


def singles(count: int, mode: AutoresetMode, **case: Any) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: JointNavigationEnv(**case)] * count, autoreset_mode=mode)


def assert_same_infos(batched: dict[str, Any], reference: dict[str, Any], mask: np.ndarray) -> None:
    agents = reference["agents"]
    for robot in range(batched["arrived"].shape[1]):
        for key in FLAGS:
            np.testing.assert_array_equal(batched[key][mask, robot], agents[f"robot_{robot}"][key][mask])
        distances = agents[f"robot_{robot}"]["distance_to_goal"]
        np.testing.assert_allclose(batched["distance_to_goal"][mask, robot], distances[mask], atol=1e-6)
    np.testing.assert_array_equal(batched["is_success"][mask], reference["is_success"][mask])


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP], ids=lambda mode: mode.value)
@pytest.mark.parametrize("name", CASES)
def test_every_world_is_the_joint_env(name: str, mode: AutoresetMode) -> None:
    case, count, random = CASES[name], 3, np.random.default_rng(5)
    batched, reference = NavigationVectorEnv(count, autoreset_mode=mode, **case), singles(count, mode, **case)
    assert batched.single_observation_space == reference.single_observation_space
    assert batched.action_space == reference.action_space
    observations, infos = batched.reset(seed=11)
    expected, expected_infos = reference.reset(seed=11)
    np.testing.assert_allclose(observations, expected, atol=2e-6)
    assert_same_infos(infos, expected_infos, np.ones(count, bool))
    ended = 0
    for _ in range(2 * batched.max_cycles + 4):
        actions = drive(batched, random)
        got, wanted = batched.step(actions), reference.step(actions)
        np.testing.assert_allclose(got[0], wanted[0], atol=5e-6)
        np.testing.assert_array_equal(got[1], wanted[1])
        np.testing.assert_array_equal(got[2], wanted[2])
        np.testing.assert_array_equal(got[3], wanted[3])
        assert_same_infos(got[4], wanted[4], np.ones(count, bool))
        done = got[2] | got[3]
        ended += int(done.sum())
        assert ("final_obs" in got[4]) == (mode is AutoresetMode.SAME_STEP and bool(done.any()))
        finals, wanted_finals = got[4], wanted[4]
        if "final_obs" in got[4]:
            finals, wanted_finals = got[4]["final_info"], wanted[4]["final_info"]
            np.testing.assert_array_equal(got[4]["_final_obs"], done)
            for world in np.flatnonzero(done):
                np.testing.assert_allclose(got[4]["final_obs"][world], wanted[4]["final_obs"][world], atol=5e-6)
            assert_same_infos(finals, wanted_finals, done)
        if done.any():
            np.testing.assert_array_equal(finals["_metrics"], done)
            for key, values in wanted_finals["metrics"].items():
                if not key.startswith("_"):
                    np.testing.assert_allclose(finals["metrics"][key][done], values[done], atol=1e-4, err_msg=key)
    assert ended >= 2 * count
    reference.close()


@pytest.mark.parametrize("count", [1, 63, 64, 65, 130])
def test_batches_of_any_size_and_number_of_threads(count: int) -> None:
    case = {"scenario": "circle", "num_robots": 3, "max_cycles": 6, "control_noise_std": 0.2}
    one, two = (NavigationVectorEnv(count, num_threads=threads, **case) for threads in (1, 3))
    random = np.random.default_rng(0)
    np.testing.assert_array_equal(one.reset(seed=0)[0], two.reset(seed=0)[0])
    for _ in range(14):
        actions = drive(one, random)
        first, second = one.step(actions), two.step(actions)
        for a, b in zip(first[:4], second[:4]):
            np.testing.assert_array_equal(a, b)
    single = NavigationVectorEnv(1, **case)
    single.reset(seed=count - 1)
    one.reset(seed=0)
    actions = drive(one, random)
    np.testing.assert_array_equal(single.step(actions[-1:])[0][0], one.step(actions)[0][-1])


def test_gymnasium_makes_it() -> None:
    env = gymnasium.make_vec(ENV_ID, num_envs=5, vectorization_mode="vector_entry_point", num_robots=2)
    assert isinstance(env.unwrapped, NavigationVectorEnv)
    assert env.num_envs == 5
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.observation_space == batch_space(env.single_observation_space, 5)
    observations, infos = env.reset(seed=1)
    assert observations in env.observation_space
    observations, rewards, terminated, truncated, infos = env.step(env.action_space.sample())
    assert observations in env.observation_space
    assert (rewards.dtype, rewards.shape) == (np.float64, (5,))
    assert (terminated.dtype, truncated.dtype) == (np.bool_, np.bool_)
    assert all(infos[f"_{key}"].all() and len(infos[key]) == 5 for key in infos if not key.startswith("_"))
    env.close()


def test_gymnasiums_wrappers_work_with_it() -> None:
    env = gymnasium.make_vec(ENV_ID, num_envs=3, num_robots=2, max_cycles=4, autoreset_mode="SameStep")
    recorded = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    listed = gymnasium.wrappers.vector.DictInfoToList(recorded)
    recorded.reset(seed=0)
    total = np.zeros(3)
    for _ in range(4):
        _, rewards, _, _, infos = listed.step(env.action_space.sample())
        total += rewards
    assert [info["episode"]["l"] for info in infos] == [4, 4, 4]
    np.testing.assert_allclose([info["episode"]["r"] for info in infos], total, rtol=1e-6)


def test_an_ended_world_ignores_its_action_when_it_is_reset() -> None:
    env = NavigationVectorEnv(2, problem=line_problem([0.5]), max_cycles=3)
    start, _ = env.reset()
    forward = np.array([[1.0, 0.0], [0.5, 0.0]], np.float32)
    for _ in range(3):
        _, _, _, truncated, _ = env.step(forward)
    assert truncated.all()
    observations, rewards, terminated, truncated, _ = env.step(forward)
    np.testing.assert_array_equal(observations, start)
    assert not rewards.any()
    assert not (terminated | truncated).any()


def test_seeds() -> None:
    case: dict[str, Any] = {"scenario": "random", "num_robots": 2, "randomize_instance": True}
    env = NavigationVectorEnv(3, **case)
    first, _ = env.reset(seed=4)
    later, _ = env.reset()
    assert not np.array_equal(first, later)
    assert not np.array_equal(first[0], first[1])
    again, _ = env.reset(seed=[4, 5, 6])
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(later, env.reset()[0])
    shifted, _ = env.reset(seed=5)
    np.testing.assert_array_equal(shifted[:2], first[1:])
    assert not np.array_equal(NavigationVectorEnv(3, **case).reset()[0], NavigationVectorEnv(3, **case).reset()[0])


def test_reset_mask_leaves_the_others_alone() -> None:
    case: dict[str, Any] = {"scenario": "circle", "num_robots": 2, "control_noise_std": 0.3}
    env, undisturbed = NavigationVectorEnv(3, **case), NavigationVectorEnv(3, **case)
    start, _ = env.reset(seed=0)
    undisturbed.reset(seed=0)
    actions = np.ones(env.action_space.shape, np.float32)
    moved = env.step(actions)[0]
    undisturbed.step(actions)
    options = {"reset_mask": np.array([False, True, False])}
    observations, infos = env.reset(options=options)
    assert options["reset_mask"].tolist() == [False, True, False]
    np.testing.assert_array_equal(observations[1], start[1])
    np.testing.assert_array_equal(observations[[0, 2]], moved[[0, 2]])
    np.testing.assert_array_equal(infos["_arrived"], [False, True, False])
    kept = [0, 2]
    np.testing.assert_array_equal(env.step(actions)[0][kept], undisturbed.step(actions)[0][kept])


def test_without_autoreset_ended_worlds_wait_for_the_user() -> None:
    env = NavigationVectorEnv(2, problem=line_problem([0.5]), max_cycles=2, autoreset_mode="Disabled")
    env.reset()
    for _ in range(2):
        _, _, _, truncated, _ = env.step(np.zeros((2, 2), np.float32))
    assert truncated.all()
    with pytest.raises(RuntimeError, match="episode of world 0 is over"):
        env.step(np.zeros((2, 2), np.float32))
    env.reset(options={"reset_mask": truncated})
    assert not env.step(np.zeros((2, 2), np.float32))[3].any()


def test_what_is_returned_is_the_callers() -> None:
    env = NavigationVectorEnv(2, scenario="circle", num_robots=2)
    results = [env.reset(seed=0)[0], *env.step(np.ones((2, 4), np.float32))]
    arrays = [item for item in results if isinstance(item, np.ndarray)]
    arrays += [item for item in results[-1].values() if isinstance(item, np.ndarray)]
    before = [array.copy() for array in arrays]
    actions = np.full((2, 4), 2.0, np.float32)
    env.step(actions)
    assert (actions == 2.0).all()
    for array, copy in zip(arrays, before):
        np.testing.assert_array_equal(array, copy)
    reused = NavigationVectorEnv(2, scenario="circle", num_robots=2, copy=False)
    first = reused.reset(seed=0)[0]
    assert np.shares_memory(first, reused.step(actions)[0])


def test_state_is_that_of_the_joint_env() -> None:
    env, single = NavigationVectorEnv(2, scenario="circle", num_robots=3), JointNavigationEnv("circle", 3)
    env.reset(seed=0)
    single.reset(seed=0)
    action = np.array([[0.1, 0.2, 0.3, -0.4, 2.0, 0.0]], np.float32)
    env.step(action.repeat(2, axis=0))
    single.step(action[0])
    np.testing.assert_allclose(env.state(), np.stack([single.state()] * 2), atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0"),
        ({"lifelong": True}, "lifelong"),
        ({"render_mode": "rgb_array"}, "render_mode"),
        ({"autoreset_mode": "Sometimes"}, "autoreset_mode 'Sometimes' is unknown"),
        ({"num_threads": 0}, "num_threads is 0"),
        ({"scenario": "random", "randomize_instance": 1}, "randomize_instance is 1"),
        ({"scenario": "circle", "randomize_instance": True}, "same for every seed"),
        ({"scenario": "nowhere"}, "unknown"),
    ],
    ids=str,
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NavigationVectorEnv(**arguments)


def test_bad_calls() -> None:
    env = NavigationVectorEnv(2, scenario="circle", num_robots=2)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros((2, 4), np.float32))
    with pytest.raises(RuntimeError, match="without a mask"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="reset takes no option 'problem'; it takes reset_mask"):
        env.reset(options={"problem": env.problem})
    for seed, message in ((1.5, "seed must be a whole number"), (-1, "seed is -1"), ([1, "a"], r"seed\[1\] must be")):
        with pytest.raises(ValueError, match=message):
            env.reset(seed=seed)
    for bad in (None, "left", [10**400] * 2):
        with pytest.raises(ValueError, match="actions"):
            env.step(bad)
    with pytest.raises(ValueError, match=r"shape \(4,\)"):
        env.step(np.zeros(4, np.float32))
    actions = np.zeros((2, 4), np.float32)
    actions[1, 2] = np.nan
    with pytest.raises(ValueError, match="robot_1 in world 1"):
        env.step(actions)
    actions[1, 2] = 2e19
    with pytest.raises(ValueError, match=r"robot_1 in world 1 is .*e\+19, 0.0\]; every value .* at most 1e\+15"):
        env.step(actions)
    with pytest.raises(ValueError, match="one per world"):
        env.reset(seed=[1])
    with pytest.raises(TypeError, match="array of bool"):
        env.reset(options={"reset_mask": [True, False]})
    with pytest.raises(ValueError, match="at least one world"):
        env.reset(options={"reset_mask": np.zeros(2, bool)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert env.step(np.full((2, 4), 1e300 / 1e290))[0].shape == env.observation_space.shape


def test_a_pool_of_instances_is_drawn_by_the_seed_and_chosen_from() -> None:
    arguments = {"scenario": "random", "num_robots": 2, "randomize_instance": True, "max_cycles": 2}
    env = NavigationVectorEnv(8, num_instances=3, **arguments)

    def starts(seed: int | None) -> list[tuple[float, ...]]:
        env.reset(seed=seed)
        return [tuple(row[: 2 * 4].tolist()) for row in env.state()]

    first, second, again = starts(4), starts(None), starts(4)
    assert first == again
    assert len({*first, *second}) <= 3
    assert len(set(first)) > 1
    assert set(starts(5)).isdisjoint(first)
    with pytest.raises(ValueError, match="without randomize_instance"):
        NavigationVectorEnv(8, "random", 2, num_instances=3, randomize_instance=False)
    with pytest.raises(ValueError, match="draws nothing at random"):
        NavigationVectorEnv(8, "circle", 2, num_instances=3)
    with pytest.raises(ValueError, match="num_instances"):
        NavigationVectorEnv(8, num_instances=0, **arguments)


def test_a_world_that_is_reset_at_once_has_no_rewards_yet() -> None:
    env = NavigationVectorEnv(1, "circle", 2, max_cycles=2, reward="training", autoreset_mode="SameStep")
    env.reset(seed=0)
    for _ in range(2):
        *_, infos = env.step(np.ones((1, 4), np.float32))
    assert infos["final_info"]["reward_time"].tolist() == [[pytest.approx(-0.05)] * 2]
    for name in ("reward_time", "reward_progress"):
        np.testing.assert_array_equal(infos[name], 0)


def test_whether_observations_are_copied_is_true_or_false() -> None:
    with pytest.raises(ValueError, match="copy is None; it must be True or False"):
        NavigationVectorEnv(1, "circle", 2, copy=None)  # type: ignore[arg-type]
