"""Teams whose robots follow different policies."""

from __future__ import annotations

import copy
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d4orm_env import make_problem, navigation_v0
from d4orm_planners import MixedPolicy, Policy, evaluate, make_policy, run_episode
from d4orm_planners.evaluation.store import STORE, TrialStore

PROBLEM = make_problem("circle", num_robots=4, horizon=30)


class Constant(Policy):
    """One control for all, with what it was told."""

    def __init__(self, control: float) -> None:
        self.control = control
        self.asked: list[tuple[tuple[str, ...], bytes]] = []
        self.seeds: list[int] = []

    def reset(self, env: Any, seed: int = 0) -> None:
        super().reset(env, seed)
        self.seeds.append(seed)

    def act(self, observations: Any, state: Any) -> Any:
        self.asked.append((tuple(observations), state.tobytes()))
        return {agent: np.array([self.control, 0]) for agent in observations}


def controls(policy: Any, seed: int = 0) -> np.ndarray:
    return run_episode(navigation_v0.parallel_env(problem=PROBLEM), policy, seed).trajectory.controls


def test_every_robot_does_what_its_policy_says() -> None:
    mixed = controls(MixedPolicy({"robot_1": "orca", "robot_3": lambda observation: [0.25, 0]}, others="go-to-goal"))
    np.testing.assert_array_equal(mixed[0, [0, 2]], controls("go-to-goal")[0, [0, 2]])
    np.testing.assert_allclose(mixed[0, 1], controls("orca")[0, 1], rtol=1e-6)
    np.testing.assert_array_equal(mixed[0, 3], [0.25, 0])
    assert not np.allclose(mixed[0, 1], controls("go-to-goal")[0, 1])


def test_a_shared_policy_is_asked_once_for_all_its_robots_and_all_see_one_state() -> None:
    one, other = Constant(1), Constant(-1)
    mixed = controls(MixedPolicy({"robot_0": one, "robot_1": other, "robot_2": one, "robot_3": other}), seed=7)
    np.testing.assert_array_equal(mixed[0, :, 0], [1, -1, 1, -1])
    assert one.seeds == other.seeds == [7]
    assert len(one.asked) == len(other.asked) == len(mixed)
    assert one.asked[0][0] == ("robot_0", "robot_2")
    assert [state for _, state in one.asked] == [state for _, state in other.asked]


def test_one_kind_for_all_is_that_policy_and_seeds_decide() -> None:
    np.testing.assert_array_equal(controls(MixedPolicy({}, others="random"), 3), controls("random", 3))
    mixed = MixedPolicy({"robot_0": "random"}, others="go-to-goal")
    np.testing.assert_array_equal(controls(mixed, 3)[0, 0], controls("random", 3)[0, 0])
    assert (controls(mixed, 3)[0, 0] != controls(mixed, 4)[0, 0]).any()


@pytest.mark.parametrize("duplicate", [copy.copy, lambda policy: pickle.loads(pickle.dumps(policy))])
def test_copies_have_policies_of_their_own(duplicate: Any) -> None:
    mixed = MixedPolicy({"robot_0": Constant(1), "robot_1": "random"}, others=Constant(-1))
    same = duplicate(mixed)
    np.testing.assert_array_equal(controls(same), controls(mixed))
    assert not {id(member) for member in same._members} & {id(member) for member in mixed._members}


def test_robots_observe_the_most_that_any_policy_wants() -> None:
    few, many = Constant(0), Constant(0)
    few.observation_options = lambda problem: {"observed_robots": 2}  # type: ignore[method-assign]
    many.observation_options = lambda problem: {"observed_robots": 3, "ray_range": 2.0}  # type: ignore[method-assign]
    options = MixedPolicy({"robot_0": many, "robot_1": "orca"}, others=few).observation_options(PROBLEM)
    assert options == {"observed_robots": 3, "ray_range": 2.0}
    assert MixedPolicy({"robot_0": "orca"}, others="ppo").observation_options(PROBLEM) == make_policy(
        "ppo"
    ).observation_options(PROBLEM)


@pytest.mark.parametrize(
    ("policies", "others", "message"),
    [
        ({"robot_4": "orca", "robot_9": "orca"}, "ppo", "for robot_4, robot_9, and this team is robot_0 to robot_3"),
        ({"robot_0": "orca", "robot_2": "orca"}, None, "no policy is given for robot_1, robot_3; give theirs, or othe"),
        ("orca", None, "policies is 'orca'; give them by agent, as {'robot_0': 'orca'}"),
        ({}, None, "policies is empty; give one by agent"),
        ({"robot_0": "orka"}, "ppo", "policy 'orka' is unknown"),
        ({"robot_0": 3}, "ppo", "policy 3 is unknown"),
    ],
)
def test_what_is_wrong_is_named(policies: Any, others: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        controls(MixedPolicy(policies, others))


def test_a_comparison_tells_mixtures_apart(tmp_path: Path) -> None:
    mixtures = {
        "two": MixedPolicy({"robot_0": Constant(1)}, others="go-to-goal"),
        "other": MixedPolicy({"robot_0": Constant(-1)}, others="go-to-goal"),
    }
    rows = evaluate(mixtures, [PROBLEM], seeds=range(2), out=tmp_path, workers=1)
    assert [(row.label, row.errors) for row in rows] == [("two", 0), ("other", 0)]
    stored = [json.loads(trial.config) for trial in TrialStore(tmp_path / STORE).trials()]
    assert {one["robot_0"]["control"] for one in stored} == {1, -1}
    assert {one["others"]["policy"] for one in stored} == {"go-to-goal"}
    assert all(len(one["robot_0"]["source"]) == 64 for one in stored)


class Team(Constant):
    """It answers for all robots, whoever asks."""

    def act(self, observations: Any, state: Any) -> Any:
        return {agent: np.array([self.control, 0]) for agent in (f"robot_{k}" for k in range(4))}


def test_a_member_that_answers_for_others_does_not_drive_them() -> None:
    still = Constant(0)
    for members in ({"robot_0": Team(1), "others": still}, {"others": still, "robot_0": Team(1)}):
        others = members.pop("others")
        np.testing.assert_array_equal(controls(MixedPolicy(members, others=others))[0, :, 0], [1, 0, 0, 0])
    mixed = MixedPolicy({"robot_1": still, "robot_2": still}, others=Team(1))
    np.testing.assert_array_equal(controls(mixed)[0, :, 0], [1, 0, 0, 1])
