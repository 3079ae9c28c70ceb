"""The test suites of PettingZoo, on every kind of scenario, with models in turn, with warnings as errors."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from env_support import line_problem, mixed_problem, sampled_actions, scenario_params
from pettingzoo.test import api_test, max_cycles_test, parallel_api_test, parallel_seed_test, render_test, seed_test
from pettingzoo.test.state_test import state_test

from d4orm_env import navigation_v0
from d4orm_env.envs.wrappers import GaussianControlNoise

SCENARIOS = scenario_params(num_robots=3)
VARIANTS: list[dict[str, Any]] = [
    {"problem": line_problem([0.3, 0.5, 0.8], "holonomic2d", goal_radius=0.25)},
    {"problem": mixed_problem()},
    {"problem": line_problem([1.0])},
    {"problem": line_problem([0.3, 0.5], goal_radius=0.25), "lifelong": True},
    {"scenario": "circle", "num_robots": 3, "control_noise_std": (0.2, 0.1)},
    {"scenario": "random", "num_robots": 3, "randomize_instance": True},
    {"scenario": "circle", "num_robots": 2, "observed_robots": 0, "observed_obstacles": 0},
]
VARIANT_NAMES = ["early-arrivals", "mixed-team", "one-robot", "lifelong", "noise", "new-instances", "blind"]
CASES = [
    *(case for case in SCENARIOS if not case.marks),
    *(pytest.param(case, id=name) for case, name in zip(VARIANTS, VARIANT_NAMES, strict=True)),
]


@pytest.mark.parametrize("case", {case.id: case for case in (*SCENARIOS, *CASES)}.values())
def test_parallel_api(case: dict[str, Any]) -> None:
    parallel_api_test(navigation_v0.parallel_env(**case), num_cycles=150)


@pytest.mark.parametrize("case", CASES)
def test_api(case: dict[str, Any]) -> None:
    api_test(navigation_v0.env(**case), num_cycles=110)


@pytest.mark.parametrize("case", CASES[-len(VARIANTS) :])
def test_api_without_the_check_of_order(case: dict[str, Any]) -> None:
    api_test(navigation_v0.raw_env(**case), num_cycles=110)


@pytest.mark.parametrize("case", CASES)
def test_seed(case: dict[str, Any]) -> None:
    seed_test(partial(navigation_v0.env, **case), num_cycles=40)
    parallel_seed_test(partial(navigation_v0.parallel_env, **case), num_cycles=40)


@pytest.mark.parametrize("case", CASES)
def test_state(case: dict[str, Any]) -> None:
    state_test(navigation_v0.env(**case), navigation_v0.parallel_env(**case), num_cycles=110)


@pytest.mark.parametrize("case", CASES)
def test_render(case: dict[str, Any]) -> None:
    render_test(partial(navigation_v0.env, **case))


@pytest.mark.parametrize("case", CASES[: -len(VARIANTS)])
def test_max_cycles(case: dict[str, Any]) -> None:
    module = SimpleNamespace(
        parallel_env=partial(navigation_v0.parallel_env, **case), env=partial(navigation_v0.env, **case)
    )
    max_cycles_test(module)


def test_module_defaults() -> None:
    max_cycles_test(navigation_v0)


def test_wrapped_env_conforms() -> None:
    def make() -> GaussianControlNoise:
        return GaussianControlNoise(navigation_v0.parallel_env(**VARIANTS[0]), 0.2)

    parallel_api_test(make(), num_cycles=60)
    parallel_seed_test(make, num_cycles=60)


def test_variants_reach_what_they_are_for() -> None:
    """Random actions end early, so that the suites above see agents leave."""
    env = navigation_v0.parallel_env(**VARIANTS[0])
    env.reset(seed=0)
    for agent in env.possible_agents:
        env.action_space(agent).seed(0)
    left = set()
    while env.agents:
        _, _, terminations, _, _ = env.step(sampled_actions(env))
        left |= {agent for agent, terminated in terminations.items() if terminated}
    assert left
