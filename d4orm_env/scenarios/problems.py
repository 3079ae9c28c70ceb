"""Problems from scenarios: by name, by file, by import path, and of the user's own; the table of names."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard

import numpy as np

from d4orm_env.core.arrays import short_repr
from d4orm_env.core.files import is_yaml_path
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.registry import Registry
from d4orm_env.scenarios import generators, maps, paper, wall_grid, walled
from d4orm_env.scenarios.scenario import Scenario, built_in, complain

if TYPE_CHECKING:
    from d4orm_env.scenarios import problem_files
else:
    problem_files = LazyModule("d4orm_env.scenarios.problem_files")

ScenarioLike: TypeAlias = str | os.PathLike[str] | Callable[..., Problem] | Scenario
"""A name, a YAML file, a callable, or where one is, ``"package.module:function"`` or ``"folder/file.py:function"``."""


def _admit(name: str, generator: Any) -> Scenario:
    return generator if isinstance(generator, Scenario) else Scenario(name.rpartition(":")[2], generator)


SCENARIOS = Registry("scenario", "d4orm.scenarios", _admit)
"""All scenarios by name; :func:`register_scenario` adds to them."""


def register_scenario(name: str, generator: Callable[..., Problem] | Scenario) -> None:
    """Make a scenario known by name, wherever one is asked for.

    Args:
        name: Its name.
        generator: ``(seed, num_robots, **settings) -> Problem``, called with the first two by position. The same
            arguments must give the same problem. A problem called ``"custom"`` gets the scenario's name. The first line
            of the docstring describes the scenario.

    Raises:
        ValueError: If the name is taken or no name, or the generator cannot be called like that.
    """
    if isinstance(name, str) and is_yaml_path(name):
        raise ValueError(f"scenario name {short_repr(name)} is that of a file; give one that does not end in .yaml")
    SCENARIOS.add(name, generator)


_in_space = partial(built_in, model="holonomic3d")
# Instances of other publications, in which robots stop dead at their goals.
_paper = partial(built_in, horizon=100, goal_speed=np.inf)
_amswarm = partial(_in_space, num_robots=10, radius=0.29, margin=0.05, goal_speed=np.inf)
_drawn = partial(built_in, draws=True)

for _scenario in (
    built_in(generators.circle),
    _in_space(generators.sphere),
    _drawn(generators.random),
    built_in(generators.four_obstacles),
    built_in(generators.heterogeneous, model=None, max_acceleration=None),
    built_in(generators.swap),
    *(
        _amswarm(partial(generators.amswarm, _centres), _name, f"AMSwarm environment {_name[-1]}: {_about}.")
        for _name, (_about, _centres) in generators.AMSWARM.items()
    ),
    _paper(
        generators.circle, "paper_circle",
        "The paper's circle of 5 m with antipodal goals: scenario ``circle`` with 100 steps, however slow the robots.",
    ),
    _paper(paper.paper_sphere, model="holonomic3d", radius=0.3),
    _paper(paper.paper_random, draws=True),
    _paper(paper.paper_heterogeneous, model=None, max_acceleration=None),
    _paper(paper.paper_obstacles, num_obstacles=4),
    *map(_drawn, (wall_grid.rooms, wall_grid.maze, walled.warehouse, walled.forest, walled.corridor, walled.doorway)),
    *(
        _drawn(partial(walled.mmd_map, _boxes), _name, _about, goal_speed=np.inf)
        for _name, (_about, _boxes) in walled.MMD_MAPS.items()
    ),
    built_in(maps.map),
):  # fmt: skip
    register_scenario(_scenario.name, _scenario)


def list_scenarios() -> tuple[str, ...]:
    """The names :func:`~d4orm_env.scenarios.make_problem` knows."""
    return tuple(SCENARIOS)


def describe_scenario(name: str) -> str:
    """One line on a scenario.

    Raises:
        ValueError: If there is no such scenario.
    """
    return SCENARIOS.look_up(name).description


def _file(path: str | os.PathLike[str], seed: int = 0, num_robots: int | None = None) -> Problem:
    """A scenario file as a generator: the same problem for every seed."""
    return problem_files.load_problem(path)


def is_scenario_file(scenario: object) -> TypeGuard[str | os.PathLike[str]]:
    """Check whether a scenario is given as the path of a file."""
    if isinstance(scenario, str):
        return is_yaml_path(scenario)
    return isinstance(scenario, os.PathLike)


def find_scenario(scenario: ScenarioLike) -> Scenario:
    """The scenario that a name, a YAML file, a ``"package.module:function"`` or a callable stands for."""
    if isinstance(scenario, Scenario):
        return scenario
    if is_scenario_file(scenario):
        return Scenario(Path(scenario).stem, partial(_file, scenario))
    if callable(scenario):
        return Scenario(getattr(scenario, "__name__", type(scenario).__name__), scenario)
    return SCENARIOS.find(scenario)


def unknown_argument(scenario: ScenarioLike | None, names: Iterable[str], others: Iterable[str] = ()) -> str:
    """Describe the first of ``names`` that neither the scenario nor the caller, ``others``, takes; ``""`` for none.

    ``None`` is any of the registered scenarios.
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
    :mod:`~d4orm_env.scenarios.generators` and the modules next to it for each scenario's own arguments. An argument
    that is ``None`` takes its default. Robots start at rest; those with a heading face their goals.

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
