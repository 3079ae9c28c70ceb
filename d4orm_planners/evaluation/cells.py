"""What to evaluate: configurations of policies, and problems by scenario, team size and seed."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from d4orm_env.core.arrays import duration, shown, whole_number
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios import load_problem, make_problem
from d4orm_env.scenarios.problems import is_scenario_file
from d4orm_planners.evaluation.store import LARGEST_NUMBER
from d4orm_planners.evaluation.trials import Configuration
from d4orm_planners.registry import PolicyLike, is_brought, list_policies, make_policy, origin

Policies: TypeAlias = PolicyLike | Iterable[PolicyLike] | Mapping[str, PolicyLike | Mapping[str, Any]]
"""A policy, several, or by label a policy or a mapping of settings; see :func:`configurations`."""


def configurations(policies: Policies, time_limit: float | None = None) -> list[Configuration]:
    """Policies with their settings, checked.

    Args:
        policies: A policy, several, or policies or settings by label. A policy is a name, an import path or whatever
            else :func:`~d4orm_planners.make_policy` takes; what has no label is called by its name. A label with
            settings is the policy's name, unless the settings have another policy as ``policy``.
        time_limit: Seconds for planning, for every planner that has no ``time_limit`` among its settings.

    Raises:
        ValueError: For an unknown name or setting, no policy, or a time limit that concerns none of them.
        ImportError: If a policy needs a library that is not installed.
    """
    chosen = []
    for label, (policy, settings) in _labelled(policies).items():
        named = isinstance(policy, str)
        choice = Configuration(label, policy if named else label, settings, origin(policy))
        if time_limit is not None and choice.planned:
            settings.setdefault("time_limit", duration(time_limit, "time_limit"))
        make_policy(policy, **settings)
        if not named and label in list_policies():
            raise ValueError(f"policies[{label!r}] has the name of another policy; give it another label")
        chosen.append(choice)
    if not chosen:
        raise ValueError("policies is empty; give at least one")
    if time_limit is not None and not any(choice.planned for choice in chosen):
        raise ValueError(f"time_limit {time_limit:g} is for planners, and none of the policies is one; leave it out")
    _check_distinct(chosen)
    return chosen


def _labelled(policies: Policies) -> dict[str, tuple[Any, dict[str, Any]]]:
    """Policies and their settings by label."""
    if isinstance(policies, Mapping):
        return {_checked_label(label): _checked(label, given) for label, given in policies.items()}
    labelled: dict[str, tuple[Any, dict[str, Any]]] = {}
    for policy in several(policies):
        label = policy if isinstance(policy, str) else getattr(policy, "__name__", type(policy).__name__)
        if not (isinstance(policy, str) or is_brought(policy)):
            _checked_label(policy)
        if labelled.setdefault(label, (policy, {}))[0] is not policy and not isinstance(policy, str):
            raise ValueError(f"two policies are called {label!r}; give a mapping that has a label for each")
    return labelled


def _checked_label(label: Any) -> str:
    if not isinstance(label, str):
        raise ValueError(f"policy {shown(label)} is no name; give one of {', '.join(list_policies())}")
    return label


def _checked(label: str, given: Any) -> tuple[Any, dict[str, Any]]:
    """A policy and its settings."""
    if isinstance(given, Mapping):
        settings = dict(given)
        return settings.pop("policy", label), settings
    if is_brought(given) or (isinstance(given, str) and ":" in given):
        return given, {}
    raise ValueError(
        f"policies[{label!r}] is {shown(given)}; give the settings of a policy, as {{}} or "
        "{'policy': 'd4orm', 'num_samples': 128}, or a policy or function of your own"
    )


def _check_distinct(chosen: Sequence[Configuration]) -> None:
    labels: dict[tuple[str, str], str] = {}
    for choice in chosen:
        other = labels.setdefault((choice.policy, choice.config), choice.label)
        if other != choice.label:
            raise ValueError(f"{other!r} and {choice.label!r} are one policy with the same settings; leave one out")


def problems(
    scenarios: Any,
    sizes: Sequence[int | None],
    seeds: Sequence[int],
    model: str | None,
) -> list[list[Problem]]:
    """One list per scenario and team size, with a problem for every seed.

    Args:
        scenarios: Scenario names, callables or ``"package.module:function"``, YAML files (``.yaml``, ``.yml``) or
            problems; the latter two have a team of their own and are the same for all seeds.
        sizes: Team sizes for the names; ``None`` is the scenario's own.
        seeds: Seeds of the scenarios.
        model: Robot model for the names; ``None`` is the scenario's own.

    Raises:
        ValueError: For a scenario that cannot be made.
    """
    cells = []
    named = False
    for scenario in dict.fromkeys(several(scenarios)):
        if isinstance(scenario, Problem):
            cells.append([scenario] * len(seeds))
        elif is_scenario_file(scenario):
            cells.append([_load(Path(scenario))] * len(seeds))
        else:
            named = True
            for size in sizes:
                cells.append([make_problem(scenario, num_robots=size, seed=seed, model=model) for seed in seeds])
    if not cells:
        raise ValueError("scenarios or num_robots is empty; give at least one of each")
    if not named and (model is not None or any(size is not None for size in sizes)):
        raise ValueError("num_robots and model do not go with scenario files; change them in the files")
    return cells


def _load(path: Path) -> Problem:
    problem = load_problem(path)
    # Two files that give no name are still told apart.
    return problem.replace(name=path.stem) if problem.name == "custom" else problem


def checked_seeds(seeds: Iterable[int]) -> tuple[int, ...]:
    """Seeds, each once.

    Raises:
        ValueError: If there are none, or they are no whole numbers from 0 to what a store has room for.
    """
    if not isinstance(seeds, Iterable):
        raise ValueError(f"seeds is {seeds!r}; give the seeds themselves, as range(50)")
    checked = tuple(dict.fromkeys(_checked_seed(seed) for seed in seeds))
    if not checked:
        raise ValueError("seeds is empty; give at least one")
    return checked


def _checked_seed(value: Any) -> int:
    seed = whole_number(value, "seed", 0)
    if seed > LARGEST_NUMBER:
        raise ValueError(f"seed is {seed}; a store of trials has room for seeds up to {LARGEST_NUMBER}")
    return seed


def several(values: Any) -> tuple[Any, ...]:
    """One value, or several."""
    alone = isinstance(values, str | os.PathLike) or not isinstance(values, Iterable)
    return (values,) if alone else tuple(values)
