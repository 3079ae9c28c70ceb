"""Settings of every planner and policy: converted and used, or refused by name."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import pytest
from fuzzing import ANYTHING, PLAIN, SCALAR, all_finite, few, refused
from hypothesis import given
from hypothesis import strategies as st
from planner_support import CHEAP, hop_problem

from d4orm_env import navigation_v0
from d4orm_planners import make_planner, make_policy
from d4orm_planners.base.planner import Planner
from d4orm_planners.base.planner_registry import PLANNERS, POLICIES
from d4orm_planners.base.policy import Policy

NEEDS = {"ipopt": "casadi", "orca": "pyrvo", "ppo": "torch", "sac": "torch"}
PROBLEM = hop_problem(2, horizon=4)
SMALL = {**CHEAP, "num_samples": 16, "repair_samples": 8, "coarse_samples": 8, "coarse_steps": 2, "predict_horizon": 3}
RUNS = 2_000
"""Larger numbers are accepted, rightly, and would take long to act upon."""


def settings_of(name: str) -> list[str]:
    kind: Any = PLANNERS.get(name) or POLICIES[name]
    return [] if kind.config_class is None else list(kind.config_class.setting_names())


@st.composite
def cases(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    names = [name for name in (*PLANNERS, *POLICIES) if name not in NEEDS or find_spec(NEEDS[name])]
    name = draw(st.sampled_from(names))
    known = [*settings_of(name), "engine"]
    keys = draw(st.lists(st.one_of(st.sampled_from(known), st.text(max_size=8)), min_size=1, max_size=2))
    values = st.one_of(SCALAR, ANYTHING, PLAIN)
    return name, {key: draw(values) for key in keys}


# NumPy warns of a masked number, which then counts as not a number and is refused.
@pytest.mark.filterwarnings("ignore:Warning. converting a masked element to nan")
@few(120)
@given(case=cases(), as_policy=st.booleans())
def test_settings_are_used_or_refused_by_name(case: tuple[str, dict[str, Any]], as_policy: bool) -> None:
    name, given_settings = case
    small = {key: value for key, value in SMALL.items() if key in settings_of(name)}
    everything = {**small, **given_settings}
    make: Any = make_policy if name in POLICIES or as_policy else make_planner
    made, _ = refused(lambda: make(name, **everything), *given_settings, name)
    if made is not None and _is_small(made):
        act(made, given_settings)


def _is_small(made: Planner | Policy) -> bool:
    config = made.config if isinstance(made, Planner) else getattr(made, "config", None)
    values = [] if config is None else config.keywords().values()
    return all(value <= RUNS for value in values if isinstance(value, int))


def act(made: Planner | Policy, given_settings: dict[str, Any]) -> None:
    """What was accepted works: it solves or acts, and what comes out is finite."""
    if isinstance(made, Planner):
        plan, _ = refused(lambda: made.solve(PROBLEM, max_iterations=1), *given_settings)
        assert plan is None or all_finite(plan.controls, plan.trajectory.states, plan.trajectory.rewards)
        return
    env = navigation_v0.parallel_env(problem=PROBLEM)
    observations, _ = env.reset(seed=0)
    _, was_refused = refused(lambda: made.reset(env, seed=0), *given_settings, made.name)
    if not was_refused:
        actions = made.act(observations, env.state())
        assert all_finite(actions)
        env.step(actions)


@few(30)
@given(name=ANYTHING, preset=ANYTHING)
@pytest.mark.parametrize("make", [make_planner, make_policy])
def test_names_and_presets_are_known_or_refused(make: Any, name: Any, preset: Any) -> None:
    assert refused(lambda: make(name), "unknown", "name")[1]
    refused(lambda: make("d4orm", preset=preset), "preset")


@few(60)
@given(seed=ANYTHING, time_limit=ANYTHING, max_iterations=st.one_of(st.none(), st.integers(-2, 3), st.text(max_size=3)))
def test_arguments_of_a_solve_are_used_or_refused_by_name(seed: Any, time_limit: Any, max_iterations: Any) -> None:
    planner = make_planner("d4orm", engine="cpu", num_samples=16, num_steps=2, max_iterations=2)
    budget = {"seed": seed, "time_limit": time_limit, "max_iterations": max_iterations}
    plan, _ = refused(lambda: planner.solve(PROBLEM, **budget), *budget)
    assert plan is None or all_finite(plan.controls, plan.metrics)


@few(40)
@given(controls=st.one_of(ANYTHING, st.lists(SCALAR, max_size=3)))
def test_initial_controls_are_used_or_refused(controls: Any) -> None:
    planner = make_planner("d4orm", engine="cpu", num_samples=16, num_steps=2)
    plan, _ = refused(lambda: planner.solve(PROBLEM, max_iterations=1, initial_controls=controls), "controls")
    assert plan is None or all_finite(plan.controls)
