"""Study: policies with their settings, on problems by scenario, team size and seed, under conditions."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from numbers import Real
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np

from d4orm_env.core.arrays import duration, positive_number, short_repr
from d4orm_env.core.errors import unknown
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import checked_seeds
from d4orm_env.disturbances import Disturbance
from d4orm_env.disturbances.disturbance import AnyDisturbance, checked_disturbances
from d4orm_env.disturbances.disturbance_registry import attributes_of, disturbance_at
from d4orm_env.envs.options import OBSERVATION, EnvOptions
from d4orm_env.envs.setup import EnvSetup
from d4orm_env.scenarios import load_problem, make_problem
from d4orm_env.scenarios.problems import is_scenario_file
from d4orm_planners.base.episode import find_physics
from d4orm_planners.base.planner_registry import PolicyLike, called, fresh_policy, is_brought, list_policies, origin
from d4orm_planners.evaluation.trials import Condition, Configuration, Job

T = TypeVar("T")

Policies: TypeAlias = PolicyLike | Iterable[PolicyLike] | Mapping[str, PolicyLike | Mapping[str, object]]
Scenario: TypeAlias = str | os.PathLike[str] | Problem | Callable[..., Problem]
Scenarios: TypeAlias = Scenario | Iterable[Scenario]
Levels: TypeAlias = Iterable[object]
DisturbanceLevels: TypeAlias = Mapping[str, Levels]
"""Levels by name, as ``{"delay": [0, 1, 2], "push.speed": [0.2, 0.5]}``, or disturbances by any label, as
``{"wind": [Wind(0.1), Wind(0.2)], "both": [[], [Delay(2), Wind(0.1)]]}``."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """Every policy on every scenario and team size, with every seed under every condition.

    The attributes are the arguments of the same names of :func:`~d4orm_planners.evaluation.evaluate.evaluate`. Scenario
    files and problems have a team of their own, and are the same for all seeds.
    """

    policies: Policies
    scenarios: Scenarios = ("circle",)
    seeds: Iterable[int] = range(50)
    control_noise_std: float | Iterable[float] = 0.0
    disturbances: DisturbanceLevels | None = None
    num_robots: int | Iterable[int | None] | None = None
    model: str | Iterable[str | None] | None = None
    scenario_settings: Mapping[str, object] = field(default_factory=dict)
    time_limit: float | None = None
    physics: str = "model"
    observation: Mapping[str, object] = field(default_factory=dict)

    def groups(self) -> list[list[Job]]:
        """A list of jobs per scenario, model, team size and policy, in that order, with one for every seed.

        Raises ValueError and ImportError as :func:`~d4orm_planners.evaluation.evaluate.evaluate`.
        """
        under = tuple(
            replace(condition, physics=self.physics)
            for condition in conditions(self.control_noise_std, self.disturbances)
        )
        for option in ("scenario_settings", "observation"):
            if not isinstance(given := getattr(self, option), Mapping):
                raise ValueError(f"{option} is {short_repr(given)}; give arguments by name, in a mapping")
        for name in self.observation:
            if name not in OBSERVATION:
                raise unknown("observation", name, OBSERVATION)
        policies, seeds = self.configurations(), checked_seeds(self.seeds)
        cells = self._problems(seeds)
        for problem in (problems[0] for _, problems in cells):
            for condition in under:
                EnvSetup(EnvOptions.of(problem=problem, disturbances=condition.disturbances, **self.observation))
            find_physics(self.physics, problem)
        texts = (one for one in _several(self.scenarios) if isinstance(one, str) and not is_scenario_file(one))
        imports = tuple(text for text in texts if ":" in text)
        return [
            [Job(policy, problem, scenario, seed, under, imports) for seed, problem in zip(seeds, problems)]
            for scenario, problems in cells
            for policy in policies
        ]

    def configurations(self) -> list[Configuration]:
        """The policies with their settings, checked as those of :meth:`groups`."""
        chosen = [self._configuration(label, *given) for label, given in _labelled(self.policies).items()]
        if not chosen:
            raise ValueError("policies is empty; give at least one")
        if self.time_limit is not None and not any(choice.planned for choice in chosen):
            limit = duration(self.time_limit, "time_limit")
            raise ValueError(f"time_limit {limit:g} is for planners, and none of the policies is one; leave it out")
        _check_distinct(chosen)
        return chosen

    def _configuration(self, label: str, policy: PolicyLike, settings: dict[str, object]) -> Configuration:
        named = isinstance(policy, str)
        own = policy if isinstance(policy, str) else label
        choice = Configuration(label, own, settings, origin(policy), self.observation)
        if self.time_limit is not None and choice.planned:
            settings.setdefault("time_limit", duration(self.time_limit, "time_limit"))
        fresh_policy(policy, **settings)
        if not named and label in list_policies():
            raise ValueError(f"policies[{label!r}] has the name of another policy; give it another label")
        return choice

    def _problems(self, seeds: Sequence[int]) -> list[tuple[str, list[Problem]]]:
        """A name and a list per scenario, model and team size, with a problem for every seed."""
        for name, own in (("num_robots", "num_robots"), ("model", "model"), ("seed", "seeds")):
            if name in self.scenario_settings:
                raise ValueError(f"scenario_settings has {name!r}; give {own!r} itself instead")
        said = ", ".join(f"{name}={value}" for name, value in self.scenario_settings.items())
        sizes = dict.fromkeys(_several(self.num_robots, "num_robots"))
        models: tuple[str | None, ...] = _several(self.model, "model")
        cells = []
        named = False
        scenarios: tuple[Scenario, ...] = _several(self.scenarios, "scenarios")
        # Problems are equal whatever they are called.
        named_apart = {(one.name if isinstance(one, Problem) else None, one): one for one in scenarios}
        for scenario in named_apart.values():
            if isinstance(scenario, Problem):
                cells.append((scenario.name, [scenario] * len(seeds)))
            elif is_scenario_file(scenario):
                problem = load_problem(scenario)
                if problem.name == "custom":  # two files that give no name still differ
                    problem = problem.replace(name=Path(scenario).stem)
                cells.append((problem.name, [problem] * len(seeds)))
            else:
                named = True
                for model, size in product(dict.fromkeys(models), sizes):
                    problems = [
                        make_problem(scenario, size, seed, model=model, **self.scenario_settings) for seed in seeds
                    ]
                    cells.append((f"{problems[0].name} ({said})" if said else problems[0].name, problems))
        _check_named_apart(cells)
        if not cells:
            raise ValueError("scenarios, num_robots or model is empty; give at least one of each")
        if not named and (said or any(given is not None for given in (*models, *sizes))):
            raise ValueError(
                "num_robots, model and scenario_settings do not go with scenario files; change them in the files"
            )
        return cells


def _labelled(policies: Policies) -> dict[str, tuple[PolicyLike, dict[str, object]]]:
    if isinstance(policies, Mapping):
        return {_checked_label(label): _checked(label, given) for label, given in policies.items()}
    labelled: dict[str, tuple[PolicyLike, dict[str, object]]] = {}
    several: tuple[PolicyLike, ...] = _several(policies)
    for policy in several:
        label = called(policy)
        if not (isinstance(policy, str) or is_brought(policy)):
            _checked_label(policy)
        if label in labelled:
            raise ValueError(f"two policies are called {label!r}; leave one out, or give a mapping with labels")
        labelled[label] = (policy, {})
    return labelled


def _checked_label(label: object) -> str:
    if not isinstance(label, str):
        raise ValueError(f"policy {short_repr(label)} is no name; give one of {', '.join(list_policies())}")
    return label


def _checked(label: str, given: Any) -> tuple[PolicyLike, dict[str, object]]:
    if isinstance(given, Mapping):
        settings = dict(given)
        return settings.pop("policy", label), settings
    if is_brought(given) or isinstance(given, str):
        return given, {}
    raise ValueError(
        f"policies[{label!r}] is {short_repr(given)}; give the settings of a policy, as {{}} or "
        "{'policy': 'd4orm', 'num_samples': 128}, its name, or a policy or function of your own"
    )


def _check_distinct(chosen: Sequence[Configuration]) -> None:
    labels: dict[tuple[str, str], str] = {}
    for choice in chosen:
        other = labels.setdefault((choice.policy, choice.config), choice.label)
        if other != choice.label:
            raise ValueError(f"{other!r} and {choice.label!r} are one policy with the same settings; leave one out")


def _check_named_apart(cells: Sequence[tuple[str, list[Problem]]]) -> None:
    """Refuse other problems of one name, team size and model, which tables could not tell apart."""
    known: dict[tuple[str, int, tuple[str, ...]], list[Problem]] = {}
    for name, problems in cells:
        robots, models = problems[0].num_robots, tuple(sorted(set(problems[0].team.models)))
        if known.setdefault((name, robots, models), problems) != problems:
            raise ValueError(
                f"two scenarios are called {name!r} and have {robots} robots, {'+'.join(models)}; give one another "
                "name, as problem.replace(name='circle of 8 m'), or by name: in its file"
            )


def _several(values: T | Iterable[T], name: str = "") -> tuple[T, ...]:
    """One value, or several; with a ``name``, they are refused by it unless they can be told apart."""
    one = (
        isinstance(values, str | bytes | os.PathLike)
        or not isinstance(values, Iterable)
        or getattr(values, "ndim", 1) == 0
    )
    several = (values,) if one else tuple(values)  # type: ignore[arg-type] # iterable
    for value in several if name else ():
        if not isinstance(value, Hashable):
            raise ValueError(f"{name} holds {short_repr(value)}; give one value, or a list of them, not of lists")
    return several  # type: ignore[return-value]


def conditions(
    control_noise_std: float | Iterable[float], disturbances: DisturbanceLevels | None
) -> tuple[Condition, ...]:
    """Every level of noise with every level of every disturbance, one at a time; ValueError for what makes no sense."""
    given: tuple[float, ...] = _several(control_noise_std)
    noise = tuple(dict.fromkeys(positive_number(std, "control_noise_std", zero_allowed=True) for std in given))
    if not noise:
        raise ValueError("control_noise_std is empty; give at least one level")
    if disturbances is None:
        return tuple(Condition(std) for std in noise)
    if not isinstance(disturbances, Mapping) or not all(isinstance(name, str) and name for name in disturbances):
        raise ValueError(f"disturbances is {short_repr(disturbances)}; give levels by name, as {{'delay': [0, 1, 2]}}")
    varied = [one for name, levels in disturbances.items() for one in _varied(name, levels)]
    if not varied:
        raise ValueError("disturbances is empty; give levels by name, as {'delay': [0, 1, 2]}, or leave it out")
    return tuple(
        Condition(std, chosen, name, level) for std, (name, chosen, level) in product(noise, dict.fromkeys(varied))
    )


Varied: TypeAlias = tuple[str, tuple[AnyDisturbance, ...], float]


def _varied(name: str, levels: Levels) -> list[Varied]:
    """A name, disturbances and a level for each of the levels of one thing."""
    if isinstance(levels, str | Disturbance) or not isinstance(levels, Iterable):
        levels = (levels,)
    listed = list(levels)
    if not listed:
        raise ValueError(f"disturbances[{name!r}] is empty; give at least one level")
    if all(isinstance(one, Disturbance | Sequence) and not isinstance(one, str) and _holds(one) for one in listed):
        chosen = [checked_disturbances(one) for one in listed]
        return [(name, one, level) for one, level in zip(chosen, _levels_of(chosen))]
    return [(name, (disturbance_at(name, one),), level) for one, level in zip(listed, _numbers_or_indices(listed))]


def _holds(given: object) -> bool:
    """Check whether something is a disturbance, or a list of disturbances only."""
    return isinstance(given, Disturbance) or all(isinstance(one, Disturbance) for one in given)  # type: ignore[attr-defined] # a sequence


def _levels_of(chosen: Sequence[tuple[AnyDisturbance, ...]]) -> list[float]:
    """The levels of disturbances that were given themselves: the number in which they differ, or their indices."""
    if all(len(one) == 1 and type(one[0]) is type(chosen[0][0]) for one in chosen):
        values = [attributes_of(one[0]) for one in chosen]
        differing = [name for name in values[0] if len({repr(each[name]) for each in values}) > 1]
        if len(differing) == 1:
            return _numbers_or_indices([each[differing[0]] for each in values])
    return _numbers_or_indices(chosen)


def _numbers_or_indices(values: Sequence[Any]) -> list[float]:
    numbers = all(isinstance(value, Real) and not isinstance(value, bool | np.bool_) for value in values)
    return [float(value if numbers else index) for index, value in enumerate(values)]
