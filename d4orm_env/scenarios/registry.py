"""Scenarios by name, by file, and of the user's own."""

from __future__ import annotations

import difflib
import inspect
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from d4orm_env.core.arrays import shown, whole_number
from d4orm_env.core.errors import UnknownKeywordError
from d4orm_env.core.plugins import entry_point_names, import_object, load_entry_point
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios import corridors, forest, generators, maps, maze, rooms, warehouse
from d4orm_env.scenarios.settings import Settings

ENTRY_POINTS = "d4orm.scenarios"
"""The group of entry points in which installed packages offer scenarios."""

DEFAULT_ROBOTS = 8
COMMON_ARGUMENTS = tuple(attribute.name for attribute in fields(Settings) if attribute.name != "scenario")


class BuiltIn:
    """One of :mod:`~d4orm_env.scenarios.generators` as ``(seed, num_robots, **settings) -> Problem``.

    Args:
        function: The generator, ``(Settings, **own arguments) -> Problem``.
        **defaults: Where its defaults differ from those of :class:`~d4orm_env.scenarios.settings.Settings`.
    """

    def __init__(self, function: Callable[..., Problem], **defaults: Any) -> None:
        self.__name__, self.__doc__ = function.__name__, function.__doc__
        self._function, self._defaults = function, defaults
        self._own = tuple(inspect.signature(function).parameters)[1:]
        self.arguments = self._own + COMMON_ARGUMENTS

    def __call__(self, seed: int = 0, num_robots: int | None = None, **settings: Any) -> Problem:
        own = {name: settings.pop(name) for name in self._own if name in settings}
        size = {} if num_robots is None else {"num_robots": num_robots}
        common = {**self._defaults, **size, **settings}
        # A value too large for float32 becomes infinite, and is then refused by name.
        with np.errstate(over="ignore"):
            return self._function(Settings(scenario=self.__name__, seed=seed, **common), **own)


class _File:
    """A scenario file as a scenario: the same problem for every seed."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = path

    def __call__(self, seed: int = 0, num_robots: int | None = None) -> Problem:
        from d4orm_env.scenarios.files import load_problem

        return load_problem(self._path)


@dataclass(frozen=True)
class Scenario:
    """Something that makes problems.

    Attributes:
        name: What it is called in tables and messages.
        generator: ``(seed, num_robots, **settings) -> Problem``.

    Raises:
        ValueError: If the generator cannot be called like that.
    """

    name: str
    generator: Callable[..., Problem]

    def __post_init__(self) -> None:
        try:
            self._signature.bind_partial(0, DEFAULT_ROBOTS)
        except (TypeError, ValueError):
            raise ValueError(
                f"scenario {self.name!r} is {shown(self.generator)}; it must be a callable "
                "(seed, num_robots, **settings) that returns a Problem"
            ) from None

    @property
    def description(self) -> str:
        """The first line of the generator's docstring."""
        return (inspect.getdoc(self.generator) or "").partition("\n")[0]

    @cached_property
    def _signature(self) -> inspect.Signature:
        return inspect.signature(self.generator)

    @property
    def _parameters(self) -> list[inspect.Parameter]:
        return list(self._signature.parameters.values())

    @property
    def arguments(self) -> tuple[str, ...]:
        """All arguments of :func:`make_problem` for this scenario."""
        if isinstance(self.generator, BuiltIn):
            return self.generator.arguments
        settings = [parameter.name for parameter in self._parameters[2:] if parameter.kind in _KEYWORDS]
        return (*settings, "num_robots", "seed")

    @property
    def takes_any(self) -> bool:
        """Whether the generator looks at its settings itself."""
        several = any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in self._parameters)
        return several and not isinstance(self.generator, BuiltIn)

    @property
    def has_own_size(self) -> bool:
        """Whether the generator has a team size of its own, for when none is asked for."""
        second = self._parameters[1:2]
        return bool(second) and second[0].default is not inspect.Parameter.empty

    def make(self, num_robots: int | None, seed: int | None, settings: Mapping[str, Any]) -> Problem:
        """The problem for that seed, checked to be one and to have that many robots.

        Raises:
            TypeError: If a setting is missing that the generator needs.
            ValueError: For a bad argument, or if the generator returns something else.
        """
        seed = 0 if seed is None else whole_number(seed, "seed", 0)
        if num_robots is None and not self.has_own_size:
            num_robots = DEFAULT_ROBOTS
        size = () if num_robots is None else (whole_number(num_robots, "num_robots", 1),)
        try:
            self._signature.bind(seed, *size, **settings)
        except TypeError as error:
            raise UnknownKeywordError(f"scenario {self.name!r}: {error}; give it by name") from None
        problem = self.generator(seed, *size, **settings)
        if not isinstance(problem, Problem):
            raise ValueError(f"scenario {self.name!r} returned {shown(problem)}; it must return a d4orm_env.Problem")
        if num_robots is not None and problem.num_robots != num_robots:
            raise ValueError(
                f"scenario {self.name!r} returned a problem of {problem.num_robots} robots where num_robots is "
                f"{num_robots}; it must return as many as it is asked for"
            )
        return problem.replace(name=self.name) if problem.name == "custom" else problem


_KEYWORDS = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
_REGISTERED: dict[str, Scenario] = {}

SCENARIOS: Mapping[str, Scenario] = MappingProxyType(_REGISTERED)
"""All registered scenarios by name; :func:`register_scenario` adds to them."""


def is_scenario_file(scenario: Any) -> bool:
    """Whether what is given as a scenario is the path of a file."""
    if isinstance(scenario, str):
        return Path(scenario).suffix in (".yaml", ".yml")
    return isinstance(scenario, os.PathLike)


def register_scenario(name: str, generator: Callable[..., Problem]) -> None:
    """Make a scenario known by name, wherever one is asked for.

    Args:
        name: The name; neither of a file nor of an import path.
        generator: ``(seed, num_robots, **settings) -> Problem``, called with the first two by position. The same
            arguments must give the same problem. A problem called ``"custom"`` gets the scenario's name. The first line
            of the docstring describes the scenario.

    Raises:
        ValueError: If the name is taken or none, or the generator cannot be called like that.
    """
    if not isinstance(name, str) or not name or ":" in name or is_scenario_file(name):
        raise ValueError(f"scenario name {shown(name)} must be text without a colon that is no .yaml file")
    if name in _REGISTERED:
        raise ValueError(f"scenario {name!r} is registered already; choose another name")
    _REGISTERED[name] = Scenario(name, generator)


_IN_SPACE = {"model": "holonomic3d"}
_AMSWARM = {**_IN_SPACE, "num_robots": 10, "radius": 0.29, "margin": 0.05}

for _scenario in (
    BuiltIn(generators.circle),
    BuiltIn(generators.sphere, **_IN_SPACE),
    BuiltIn(generators.random),
    BuiltIn(generators.four_obstacles),
    BuiltIn(generators.heterogeneous, model=None, max_acceleration=None),
    BuiltIn(generators.swap),
    BuiltIn(generators.amswarm_1, **_AMSWARM),
    BuiltIn(generators.amswarm_2, **_AMSWARM),
    BuiltIn(generators.amswarm_3, **_AMSWARM),
    BuiltIn(generators.amswarm_4, **_AMSWARM),
    BuiltIn(generators.amswarm_5, **_AMSWARM),
    BuiltIn(rooms.rooms),
    BuiltIn(maze.maze),
    BuiltIn(warehouse.warehouse),
    BuiltIn(forest.forest),
    BuiltIn(corridors.corridor),
    BuiltIn(corridors.doorway),
    BuiltIn(maps.map),
):
    register_scenario(_scenario.__name__, _scenario)


def get_scenario(name: str) -> Scenario:
    """Look a scenario up by name: those registered, then those that installed packages offer.

    Raises:
        ValueError: If there is no such scenario, or it cannot be loaded; the message lists those there are.
    """
    if isinstance(name, str) and name not in SCENARIOS:
        offered = load_entry_point(ENTRY_POINTS, name, "scenario")
        if offered is not None:
            register_scenario(name, offered)
    if not isinstance(name, str) or name not in SCENARIOS:
        raise ValueError(f"scenario {shown(name)} is unknown; choose one of {', '.join(list_scenarios())}")
    return SCENARIOS[name]


def find_scenario(scenario: Any) -> Scenario:
    """The scenario that a name, a YAML file, a ``"package.module:function"`` or a callable stands for.

    Raises:
        ValueError: If it is none of these.
    """
    if isinstance(scenario, Scenario):
        return scenario
    if is_scenario_file(scenario):
        return Scenario(Path(scenario).stem, _File(scenario))
    if isinstance(scenario, str) and ":" in scenario:
        return Scenario(scenario.rpartition(":")[2], import_object(scenario, "scenario"))
    if callable(scenario):
        return Scenario(getattr(scenario, "__name__", type(scenario).__name__), scenario)
    return get_scenario(scenario)


def list_scenarios() -> tuple[str, ...]:
    """The names :func:`make_problem` knows."""
    return tuple(dict.fromkeys((*SCENARIOS, *entry_point_names(ENTRY_POINTS))))


def describe_scenario(name: str) -> str:
    """One line on a scenario.

    Raises:
        ValueError: If there is no such scenario.
    """
    return get_scenario(name).description


def unknown_argument(scenario: Any, names: Iterable[str], others: Iterable[str] = ()) -> str:
    """What is wrong with the first of ``names`` that is no argument of that scenario; the empty string if none is.

    Args:
        scenario: As for :func:`make_problem`; ``None`` is any of the registered ones.
        names: The arguments given.
        others: Further arguments that the caller takes.

    Raises:
        ValueError: If there is no such scenario.
    """
    entries = tuple(SCENARIOS.values()) if scenario is None else (find_scenario(scenario),)
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


def make_problem(scenario: Any, num_robots: int | None = None, seed: int | None = None, **arguments: Any) -> Problem:
    """A problem of a scenario. The same arguments give the same problem, to the bit.

    Every scenario of this package takes ``num_robots`` (default 8; AMSwarm has 10), ``seed`` (0), ``model``
    (``"holonomic2d"``, or ``"holonomic3d"`` where the scenario is three-dimensional; one name or one per robot),
    ``num_obstacles`` (0), ``obstacle_radius``, ``radius``, ``margin``, ``dt``, ``horizon``, ``goal_radius``,
    ``goal_speed``, ``max_speed``, ``max_acceleration`` and ``max_turn_rate``; see
    :class:`~d4orm_env.scenarios.settings.Settings` for units and defaults, which are the paper's, and
    :mod:`~d4orm_env.scenarios.generators` and the modules beside it for each scenario's own arguments. An argument that
    is ``None`` takes its default. Robots start at rest; those with a heading face their goals.

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
