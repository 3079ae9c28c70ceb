"""Problems from scenarios: by name, by file, by import path, and of the user's own."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypeGuard

from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.yaml_text import is_yaml_path
from d4orm_env.scenarios.scenario import Scenario, complain
from d4orm_env.scenarios.scenario_registry import SCENARIOS

if TYPE_CHECKING:
    from d4orm_env.scenarios import problem_files
else:
    problem_files = LazyModule("d4orm_env.scenarios.problem_files")

ScenarioLike: TypeAlias = str | os.PathLike[str] | Callable[..., Problem] | Scenario
"""A name, a YAML file, a callable, or where one is, ``"package.module:function"`` or ``"folder/file.py:function"``."""


class _File:
    """A scenario file as a generator: the same problem for every seed."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = path

    def __call__(self, seed: int = 0, num_robots: int | None = None) -> Problem:
        return problem_files.load_problem(self._path)


def is_scenario_file(scenario: object) -> TypeGuard[str | os.PathLike[str]]:
    """Check whether a scenario is given as the path of a file."""
    if isinstance(scenario, str):
        return is_yaml_path(scenario)
    return isinstance(scenario, os.PathLike)


def find_scenario(scenario: ScenarioLike) -> Scenario:
    """The scenario that a name, a YAML file, a ``"package.module:function"`` or a callable stands for.

    Raises:
        ValueError: If it is none of these.
    """
    if isinstance(scenario, Scenario):
        return scenario
    if is_scenario_file(scenario):
        return Scenario(Path(scenario).stem, _File(scenario))
    if callable(scenario):
        return Scenario(getattr(scenario, "__name__", type(scenario).__name__), scenario)
    return SCENARIOS.find(scenario)


def unknown_argument(scenario: ScenarioLike | None, names: Iterable[str], others: Iterable[str] = ()) -> str:
    """Describe the first of ``names`` that is no argument of that scenario; the empty string if there is none.

    Args:
        scenario: As for :func:`make_problem`; ``None`` is any of the registered ones.
        names: The arguments given.
        others: Further arguments that the caller takes.

    Raises:
        ValueError: If there is no such scenario.
    """
    if scenario is not None:
        return find_scenario(scenario).complaint(names, others)
    known = (name for own in SCENARIOS.own() for name in SCENARIOS[own].arguments)
    return complain("this", {*others, *known}, names)


def make_problem(
    scenario: ScenarioLike, num_robots: int | None = None, seed: int | None = None, **arguments: object
) -> Problem:
    """A problem of a scenario. The same arguments give the same problem, to the bit.

    Every scenario of this package takes ``num_robots`` (default 8; AMSwarm has 10), ``seed`` (0), ``model``
    (``"holonomic2d"``, or ``"holonomic3d"`` where the scenario is three-dimensional; one name or one per robot),
    ``num_obstacles`` (0), ``obstacle_radius``, ``bounds`` (if it is open), ``radius``, ``margin``, ``dt``, ``horizon``,
    ``goal_radius``, ``goal_speed``, ``arrival``, ``max_speed``, ``max_acceleration`` and ``max_turn_rate``; see
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
    return find_scenario(scenario).problem(num_robots, seed, **arguments)
