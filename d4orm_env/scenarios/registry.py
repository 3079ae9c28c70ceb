"""Scenarios by name."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

import numpy as np

from d4orm_env.core.errors import UnknownKeywordError
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios import generators
from d4orm_env.scenarios.settings import Settings


@dataclass(frozen=True)
class Scenario:
    """A generator and where its defaults differ from those of :class:`Settings`."""

    generator: Callable[..., Problem]
    defaults: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def description(self) -> str:
        """The first line of the generator's docstring."""
        return (inspect.getdoc(self.generator) or "").partition("\n")[0]

    @property
    def own_arguments(self) -> tuple[str, ...]:
        """Arguments that only this scenario has."""
        return tuple(inspect.signature(self.generator).parameters)[1:]

    @property
    def arguments(self) -> tuple[str, ...]:
        """All arguments of :func:`make_problem` for this scenario."""
        return self.own_arguments + COMMON_ARGUMENTS


COMMON_ARGUMENTS = tuple(attribute.name for attribute in fields(Settings) if attribute.name != "scenario")

_IN_SPACE = MappingProxyType({"model": "holonomic3d"})
_MIXED = MappingProxyType({"model": None, "max_acceleration": None})
_AMSWARM = MappingProxyType({"num_robots": 10, "model": "holonomic3d", "radius": 0.29, "margin": 0.05})

SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        "circle": Scenario(generators.circle),
        "sphere": Scenario(generators.sphere, _IN_SPACE),
        "random": Scenario(generators.random),
        "four_obstacles": Scenario(generators.four_obstacles),
        "heterogeneous": Scenario(generators.heterogeneous, _MIXED),
        "swap": Scenario(generators.swap),
        "amswarm_1": Scenario(generators.amswarm_1, _AMSWARM),
        "amswarm_2": Scenario(generators.amswarm_2, _AMSWARM),
        "amswarm_3": Scenario(generators.amswarm_3, _AMSWARM),
        "amswarm_4": Scenario(generators.amswarm_4, _AMSWARM),
        "amswarm_5": Scenario(generators.amswarm_5, _AMSWARM),
    }
)
"""All scenarios by name."""


def get_scenario(name: str) -> Scenario:
    """Look a scenario up by name.

    Raises:
        ValueError: If there is no such scenario; the message lists those there are.
    """
    if not isinstance(name, str) or name not in SCENARIOS:
        raise ValueError(f"scenario {name!r} is unknown; choose one of {', '.join(SCENARIOS)}")
    return SCENARIOS[name]


def list_scenarios() -> tuple[str, ...]:
    """The names :func:`make_problem` knows."""
    return tuple(SCENARIOS)


def describe_scenario(name: str) -> str:
    """One line on a scenario.

    Raises:
        ValueError: If there is no such scenario.
    """
    return get_scenario(name).description


def unknown_argument(scenario: str | None, names: Iterable[str], others: Iterable[str] = ()) -> str:
    """What is wrong with the first of ``names`` that is no argument of that scenario; the empty string if none is.

    Args:
        scenario: Name of the scenario; ``None`` is any of them.
        names: The arguments given.
        others: Further arguments that the caller takes.

    Raises:
        ValueError: If there is no such scenario.
    """
    entries = SCENARIOS.values() if scenario is None else [get_scenario(scenario)]
    known = sorted({*others, *(name for entry in entries for name in entry.arguments)})
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            owner = "this" if scenario is None else f"scenario {scenario!r}"
            return f"{owner} takes no argument {name!r}; it takes {', '.join(known)}{hint}"
    return ""


def make_problem(scenario: str, num_robots: int | None = None, seed: int | None = None, **arguments: Any) -> Problem:
    """A problem of a named scenario. The same arguments give the same problem, to the bit.

    Every scenario takes ``num_robots`` (default 8; AMSwarm has 10), ``seed`` (0), ``model`` (``"holonomic2d"``, or
    ``"holonomic3d"`` where the scenario is three-dimensional; one name or one per robot), ``num_obstacles`` (0),
    ``obstacle_radius``, ``radius``, ``margin``, ``dt``, ``horizon``, ``goal_radius``, ``goal_speed``, ``max_speed``,
    ``max_acceleration`` and ``max_turn_rate``; see :class:`~d4orm_env.scenarios.settings.Settings` for units and
    defaults, which are the paper's, and :mod:`~d4orm_env.scenarios.generators` for each scenario's own arguments. An
    argument that is ``None`` takes its default. Robots start at rest; those with a heading face their goals.

    Without ``horizon`` the problem has 100 steps (the paper's), and more where robots have further to go than those
    allow for: see :func:`~d4orm_env.scenarios.layout.default_horizon`.

    Raises:
        TypeError: For an argument that the scenario does not have; the message lists those it has.
        ValueError: For an unknown scenario, a value that makes no sense, a model that does not fit, or more robots or
            obstacles than fit; the message says what would do.
    """
    complaint = unknown_argument(scenario, arguments)
    if complaint:
        raise UnknownKeywordError(complaint)
    entry = get_scenario(scenario)
    arguments = {"num_robots": num_robots, "seed": seed, **arguments}
    given = {name: value for name, value in arguments.items() if value is not None}
    own = {name: given.pop(name) for name in entry.own_arguments if name in given}
    # A value too large for float32 becomes infinite, and is then refused by name.
    with np.errstate(over="ignore"):
        return entry.generator(Settings(scenario=scenario, **{**entry.defaults, **given}), **own)
