"""One policy object drives one episode at a time: what would mix those of several threads is refused."""

from __future__ import annotations

import copy
import pickle
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from planner_support import hop_problem
from test_policies import cheap_policy

from d4orm_env import navigation_v0
from d4orm_planners import Policy, list_policies, make_policy
from d4orm_planners.base.adapters import SharedPolicy


def episode() -> Any:
    env = navigation_v0.parallel_env(problem=hop_problem(2))
    return env, env.reset(seed=0)[0]


def elsewhere(function: Callable[[], Any]) -> Any:
    """What a function returns in another thread."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function).result()


def zeros(stacked: Any) -> Any:
    return np.zeros((len(stacked), 2), np.float32)


class Idle(Policy):
    def act(self, observations: Any, state: Any) -> Any:
        return {agent: np.zeros(2, np.float32) for agent in observations}


MAKERS: dict[str, Callable[[], Policy]] = {
    **{name: lambda name=name: cheap_policy(name) for name in list_policies()},
    "adapter": lambda: SharedPolicy(zeros, None),
    "team function": lambda: make_policy(lambda observations, state: Idle().act(observations, state)),
    "robot function": lambda: make_policy(lambda observation: np.zeros(2, np.float32)),
    "own": Idle,
}


@pytest.mark.parametrize("name", MAKERS)
def test_who_has_been_replaced_by_another_thread_does_not_act(name: str) -> None:
    policy = MAKERS[name]()
    (env, seen), (other, _) = episode(), episode()
    policy.reset(env, seed=0)
    elsewhere(lambda: policy.reset(other, seed=0))
    with pytest.raises(RuntimeError, match=r"another thread has reset this policy .*; make a policy for every thread"):
        policy.act(seen, env.state())
    policy.reset(env, seed=0)
    assert set(policy.act(seen, env.state())) == set(seen)


class Slow(Policy):
    """Acts until it is told to stop."""

    def __init__(self) -> None:
        self.inside, self.leave = threading.Event(), threading.Event()

    def act(self, observations: Any, state: Any) -> Any:
        self.inside.set()
        assert self.leave.wait(60)
        return {}


def test_calls_do_not_overlap() -> None:
    policy, (env, seen) = Slow(), episode()
    policy.reset(env)
    with ThreadPoolExecutor(1) as pool:
        acting = pool.submit(policy.act, seen, env.state())
        assert policy.inside.wait(60)
        try:
            for call in (lambda: policy.act(seen, env.state()), lambda: policy.reset(env)):
                with pytest.raises(RuntimeError, match="another thread is using this policy at this moment; make a"):
                    call()
        finally:
            policy.leave.set()
        assert acting.result() == {}
    policy.reset(env)


def test_an_episode_may_go_on_in_another_thread() -> None:
    policy, (env, seen) = Idle(), episode()
    for _ in range(2):
        policy.reset(env)
        assert set(elsewhere(lambda: policy.act(seen, env.state()))) == set(seen)
        assert set(policy.act(seen, env.state())) == set(seen)


def test_threads_one_after_the_other_may_share_a_policy() -> None:
    policy = Idle()

    def run() -> int:
        env, seen = episode()
        policy.reset(env=env)
        return len(policy.act(observations=seen, state=env.state()))

    assert [elsewhere(run), run(), elsewhere(run)] == [2, 2, 2]


class Picky(Idle):
    def __getstate__(self) -> Any:
        return dict(vars(self))


def pickled(policy: Policy) -> Policy:
    twin: Policy = pickle.loads(pickle.dumps(policy))
    return twin


@pytest.mark.parametrize(
    ("kind", "duplicate"), [(Idle, copy.copy), (Idle, copy.deepcopy), (Idle, pickled), (Picky, pickled)]
)
def test_copies_are_driven_by_themselves(kind: type[Policy], duplicate: Callable[[Policy], Policy]) -> None:
    policy = kind()
    (env, seen), (other, _) = episode(), episode()
    policy.reset(env)
    twin = duplicate(policy)
    elsewhere(lambda: twin.reset(other))
    assert set(policy.act(seen, env.state())) == set(seen)
    assert policy.identity() == twin.identity() == {}


@pytest.mark.parametrize("duplicate", [copy.deepcopy, pickled])
@pytest.mark.parametrize("used", [False, True])
@pytest.mark.parametrize("name", list_policies())
def test_every_policy_is_copied_whole(name: str, used: bool, duplicate: Callable[[Policy], Policy]) -> None:
    policy = cheap_policy(name)
    (env, seen), (other, _) = episode(), episode()
    if used:
        policy.reset(env, seed=1)
        policy.act(seen, env.state())
    twin = duplicate(policy)
    policy.reset(env, seed=2)
    twin.reset(other, seed=2)
    actions, again = policy.act(seen, env.state()), twin.act(seen, other.state())
    np.testing.assert_array_equal(list(actions.values()), list(again.values()))
