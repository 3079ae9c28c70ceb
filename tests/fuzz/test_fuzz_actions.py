"""Actions of every kind in the three environments: acted upon, or refused; then nothing has changed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from fuzzing import ANYTHING, DECIMAL, SCALAR, few, refused
from hypothesis import given
from hypothesis import strategies as st

from d4orm_env import navigation_v0

SIZE = {"num_robots": 2, "horizon": 30}
ENTRY = st.one_of(DECIMAL, SCALAR)


def rows(count: int) -> Any:
    """A row of an action: mostly of the right length, of numbers of some kind or of anything."""
    numbers = st.lists(DECIMAL, min_size=count, max_size=count)
    arrays = st.builds(
        lambda values, kind: np.array(values).astype(kind),
        st.lists(st.floats(-5, 5), min_size=count, max_size=count),
        st.sampled_from(["f2", "f4", "f8", "i4", "u1", "?", "c8", "O", "S4", ">f4"]),
    )
    return st.one_of(numbers, arrays, st.lists(ENTRY, max_size=count + 2), numbers.map(np.array), ANYTHING)


def check(act: Callable[[], Any], state: Callable[[], Any], proceed: Callable[[], Any]) -> None:
    """Either the action is acted upon and all is finite, or it is refused and changes nothing; then it goes on."""
    before = np.array(state())
    result, was_refused = refused(act, "action", "agent", "robot")
    if was_refused:
        np.testing.assert_array_equal(state(), before)
        result = proceed()
    else:
        assert not np.array_equal(state(), before), "a step, at least the time has changed"
    observations, rewards = result[:2]
    for values in (observations, rewards):
        for value in values.values() if isinstance(values, dict) else [values]:
            assert np.isfinite(value).all()
    assert np.isfinite(state()).all()


# NumPy warns of a masked number, which then counts as not a number and is refused.
@pytest.mark.filterwarnings("ignore:Warning. converting a masked element to nan")
@few(100)
@given(data=st.data())
def test_actions_of_the_parallel_environment(data: st.DataObject) -> None:
    env = navigation_v0.parallel_env(scenario="circle", **SIZE)
    env.reset(seed=0)
    names = st.one_of(st.sampled_from(["robot_0", "robot_1"]), st.sampled_from(["robot_2", "", None, 0]))
    both = st.fixed_dictionaries({"robot_0": rows(2), "robot_1": rows(2)})
    actions = data.draw(st.one_of(both, both, st.dictionaries(names, rows(2), max_size=3), ANYTHING))
    check(lambda: env.step(actions), env.state, lambda: env.step({agent: np.zeros(2, "f4") for agent in env.agents}))


@few(60)
@given(action=rows(2))
def test_actions_of_the_turn_by_turn_environment(action: Any) -> None:
    env = navigation_v0.env(scenario="circle", **SIZE)
    env.reset(seed=0)
    env.step(np.zeros(2, np.float32))
    before = env.state()
    _, was_refused = refused(lambda: env.step(action), "action", "robot_1")
    if was_refused:
        np.testing.assert_array_equal(env.state(), before)
        env.step(np.zeros(2, np.float32))
    assert np.isfinite(env.state()).all()
    assert np.isfinite(list(env.rewards.values())).all()


@few(60)
@given(action=rows(4))
def test_actions_of_the_joint_environment(action: Any) -> None:
    env: Any = gymnasium.make("d4orm/Navigation-v0", scenario="circle", disable_env_checker=True, **SIZE).unwrapped
    env.reset(seed=0)
    check(lambda: env.step(action), env.state, lambda: env.step(np.zeros(4, np.float32)))


@few(60)
@given(actions=st.one_of(st.lists(rows(4), min_size=3, max_size=3), rows(4)))
def test_actions_of_the_vector_environment(actions: Any) -> None:
    env: Any = gymnasium.make_vec(
        "d4orm/Navigation-v0", num_envs=3, vectorization_mode="vector_entry_point", scenario="circle", **SIZE
    )
    first, _ = env.reset(seed=0)
    result, was_refused = refused(lambda: env.step(actions), "action", "robot", "world")
    if was_refused:
        result = env.step(np.zeros((3, 4), np.float32))
        again, _ = env.reset(seed=0)
        np.testing.assert_array_equal(again, first)
    assert np.isfinite(result[0]).all()
    assert np.isfinite(result[1]).all()


@pytest.mark.parametrize("make", [navigation_v0.parallel_env, navigation_v0.env])
@few(40)
@given(seed=ANYTHING, options=ANYTHING)
def test_arguments_of_a_reset(make: Any, seed: Any, options: Any) -> None:
    env = make(scenario="circle", **SIZE)
    refused(lambda: env.reset(seed=seed, options=options), "seed", "options")
    env.reset(seed=0)
    assert np.isfinite(env.state()).all()


KEYWORDS = ("scenario", "num_robots", "model", "horizon", "control_noise_std", "lifelong", "render_mode", "max_cycles")


@pytest.mark.parametrize("make", [navigation_v0.parallel_env, navigation_v0.env])
@few(60)
@given(keyword=st.one_of(st.sampled_from(KEYWORDS), st.text(max_size=5)), value=ANYTHING)
def test_arguments_of_an_environment(make: Any, keyword: str, value: Any) -> None:
    env, _ = refused(lambda: make(**{**SIZE, keyword: value}), keyword, "unknown")
    if env is not None:
        env.reset(seed=0)
        assert np.isfinite(env.state()).all()
