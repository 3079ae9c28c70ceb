"""Scenarios by name, by file, and of the user's own."""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeAlias, TypeGuard

from d4orm_env.core.arrays import shown
from d4orm_env.core.errors import UnknownKeywordError
from d4orm_env.core.problem import Problem
from d4orm_env.core.registry import Registry
from d4orm_env.scenarios import generators
from d4orm_env.scenarios.scenario import COMMON_ARGUMENTS, BuiltIn, File, Scenario

ScenarioLike: TypeAlias = str | os.PathLike[str] | Callable[..., Problem] | Scenario
"""A name, a YAML file, a callable, or where one is, ``"package.module:function"`` or ``"folder/file.py:function"``."""

SCENARIOS = Registry(
    "scenario", "d4orm.scenarios", lambda name, generator: Scenario(name.rpartition(":")[2], generator)
)
"""All scenarios by name; :func:`register_scenario` adds to them."""


def is_scenario_file(scenario: object) -> TypeGuard[str | os.PathLike[str]]:
    """Whether what is given as a scenario is the path of a file."""
    if isinstance(scenario, str):
        return Path(scenario).suffix in (".yaml", ".yml")
    return isinstance(scenario, os.PathLike)


def register_scenario(name: str, generator: Callable[..., Problem]) -> None:
    """Make a scenario known by name, wherever one is asked for.

    Args:
        name: Its name.
        generator: ``(seed, num_robots, **settings) -> Problem``, called with the first two by position. The same
            arguments must give the same problem. A problem called ``"custom"`` gets the scenario's name. The first line
            of the docstring describes the scenario.

    Raises:
        ValueError: If the name is taken or no name, or the generator cannot be called like that.
    """
    if is_scenario_file(name):
        raise ValueError(f"scenario name {shown(name)} is that of a file; give one that does not end in .yaml")
    SCENARIOS.add(name, generator)


_IN_SPACE: dict[str, Any] = {"model": "holonomic3d"}
_AMSWARM: dict[str, Any] = {**_IN_SPACE, "num_robots": 10, "radius": 0.29, "margin": 0.05}

for _scenario in (
    BuiltIn(generators.circle),
    BuiltIn(generators.sphere, **_IN_SPACE),
    BuiltIn(generators.random, draws=True),
    BuiltIn(generators.four_obstacles),
    BuiltIn(generators.heterogeneous, model=None, max_acceleration=None),
    BuiltIn(generators.swap),
    BuiltIn(generators.amswarm_1, **_AMSWARM),
    BuiltIn(generators.amswarm_2, **_AMSWARM),
    BuiltIn(generators.amswarm_3, **_AMSWARM),
    BuiltIn(generators.amswarm_4, **_AMSWARM),
    BuiltIn(generators.amswarm_5, **_AMSWARM),
):
    register_scenario(_scenario.__name__, _scenario)


def find_scenario(scenario: ScenarioLike) -> Scenario:
    """The scenario that a name, a YAML file, a ``"package.module:function"`` or a callable stands for.

    Raises:
        ValueError: If it is none of these.
    """
    if isinstance(scenario, Scenario):
        return scenario
    if is_scenario_file(scenario):
        return Scenario(Path(scenario).stem, File(scenario))
    if callable(scenario):
        return Scenario(getattr(scenario, "__name__", type(scenario).__name__), scenario)
    return SCENARIOS.find(scenario)


def list_scenarios() -> tuple[str, ...]:
    """The names :func:`make_problem` knows."""
    return tuple(SCENARIOS)


def describe_scenario(name: str) -> str:
    """One line on a scenario.

    Raises:
        ValueError: If there is no such scenario.
    """
    return SCENARIOS.look_up(name).description


def unknown_argument(scenario: ScenarioLike | None, names: Iterable[str], others: Iterable[str] = ()) -> str:
    """What is wrong with the first of ``names`` that is no argument of that scenario; the empty string if none is.

    Args:
        scenario: As for :func:`make_problem`; ``None`` is any of the registered ones.
        names: The arguments given.
        others: Further arguments that the caller takes.

    Raises:
        ValueError: If there is no such scenario.
    """
    entries = [SCENARIOS[name] for name in SCENARIOS.own()] if scenario is None else [find_scenario(scenario)]
    if scenario is not None and entries[0].takes_any:
        return ""
    known = sorted({*others, *(name for entry in entries for name in entry.arguments)})
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            owner = "this" if scenario is None else f"scenario {entries[0].name!r}"
            return f"{owner} takes no argument {name!r}; it takes {', '.join(known)}{hint}"
    return ""


def make_problem(
    scenario: ScenarioLike, num_robots: int | None = None, seed: int | None = None, **arguments: Any
) -> Problem:
    """A problem of a scenario. The same arguments give the same problem, to the bit.

    Every scenario of this package takes ``num_robots`` (default 8; AMSwarm has 10), ``seed`` (0), ``model``
    (``"holonomic2d"``, or ``"holonomic3d"`` where the scenario is three-dimensional; one name or one per robot),
    ``num_obstacles`` (0), ``obstacle_radius``, ``radius``, ``margin``, ``dt``, ``horizon``, ``goal_radius``,
    ``goal_speed``, ``max_speed``, ``max_acceleration`` and ``max_turn_rate``; see
    :class:`~d4orm_env.scenarios.settings.Settings` for units and defaults, which are the paper's, and
    :mod:`~d4orm_env.scenarios.generators` for each scenario's own arguments. An argument that is ``None`` takes its
    default. Robots start at rest; those with a heading face their goals.

    Without ``horizon`` the problem has 100 steps (the paper's), and more where robots have further to go than those
    allow for: see :func:`~d4orm_env.scenarios.layout.default_horizon`.

    Args:
        scenario: A name, the path of a YAML file, a callable ``(seed, num_robots, **settings) -> Problem``, or where to
            import one, ``"package.module:function"``. A file is the same for every seed.
        num_robots: Size of the team.
        seed: Of whatever the scenario draws.
        **arguments: Further arguments of the scenario.

    Raises:
        TypeError: For an argument that the scenario does not have; the message lists those it has.
        ValueError: For an unknown scenario, a value that makes no sense, a model that does not fit, or more robots or
            obstacles than fit; the message says what would do. Also if a callable returns something else than a problem
            of that many robots.
    """
    entry = find_scenario(scenario)
    given = {name: value for name, value in arguments.items() if value is not None}
    # Whatever the scenario, leaving a common argument out is no mistake.
    complaint = unknown_argument(entry, [name for name in arguments if name in given or name not in COMMON_ARGUMENTS])
    if complaint:
        raise UnknownKeywordError(complaint)
    return entry.make(num_robots, seed, given)
