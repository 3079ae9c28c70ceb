"""Problems from scenarios, the package's own or a user's: by name, by file, by import path; the table of names."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard

import numpy as np

from d4orm_env.core.arrays import short_repr, whole_number
from d4orm_env.core.errors import UnknownKeywordError, did_you_mean
from d4orm_env.core.files import is_yaml_path
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.registry import Registry
from d4orm_env.core.robot_types import find_robot
from d4orm_env.scenarios import generators, maps, wall_grid, walled
from d4orm_env.scenarios.settings import Settings

if TYPE_CHECKING:
    from d4orm_env.scenarios import problem_files
else:
    problem_files = LazyModule("d4orm_env.scenarios.problem_files")

DEFAULT_ROBOTS = 8
COMMON_ARGUMENTS = tuple(attribute.name for attribute in fields(Settings) if attribute.name != "scenario")
_KEYWORDS = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


@dataclass(frozen=True)
class Scenario:
    """Something that makes problems."""

    name: str  #: Its name in tables and messages
    generator: Callable[..., Problem]  #: ``(seed, num_robots, **settings) -> Problem``
    about: str = ""  #: What describes it; the generator's docstring by default
    draws: bool = False  #: Every seed is known to give other positions, and never another team
    known: tuple[str, ...] = ()  #: All arguments of a generator that does not name them itself

    def __post_init__(self) -> None:
        wanted = "a callable (seed, num_robots, **settings) that returns a Problem"
        try:
            self._signature.bind_partial(0, DEFAULT_ROBOTS)
        except (TypeError, ValueError):
            raise ValueError(
                f"scenario {self.name!r} is {short_repr(self.generator)}; it must be {wanted}, "
                "the first two by position"
            ) from None
        names = [parameter.name for parameter in self._parameters[:2]]
        if names[0] == "num_robots" or "seed" in names[1:]:
            raise ValueError(f"scenario {self.name!r} takes ({', '.join(names)}); it must be {wanted}, in that order")

    @property
    def description(self) -> str:
        """The first line of the generator's docstring."""
        return inspect.cleandoc(self.about or inspect.getdoc(self.generator) or "").partition("\n")[0]

    @cached_property
    def _signature(self) -> inspect.Signature:
        return inspect.signature(self.generator)

    @property
    def _parameters(self) -> list[inspect.Parameter]:
        return list(self._signature.parameters.values())

    @property
    def arguments(self) -> tuple[str, ...]:
        """All arguments of :meth:`problem`."""
        own = (parameter.name for parameter in self._parameters[2:] if parameter.kind in _KEYWORDS)
        return self.known or (*own, "num_robots", "seed")

    def complaint(self, names: Iterable[str], others: Iterable[str] = ()) -> str:
        """Describe the first of ``names`` that neither this nor the caller, ``others``, takes; ``""`` for none."""
        if not self.known and any(parameter.kind is parameter.VAR_KEYWORD for parameter in self._parameters):
            return ""  # the generator checks its settings itself
        return _complain(f"scenario {self.name!r}", {*others, *self.arguments}, names)

    def problem(self, num_robots: int | None = None, seed: int | None = None, **arguments: object) -> Problem:
        """See :func:`make_problem`; it is checked to be one and to have that many robots."""
        given = {name: value for name, value in arguments.items() if value is not None}
        # Whatever the scenario, leaving a common argument out is no mistake.
        named = (name for name in arguments if name in given or name not in COMMON_ARGUMENTS)
        if complaint := self.complaint(named):
            raise UnknownKeywordError(complaint)
        seed = 0 if seed is None else whole_number(seed, "seed", 0)
        if num_robots is None and all(parameter.default is parameter.empty for parameter in self._parameters[1:2]):
            num_robots = DEFAULT_ROBOTS  # for the generator has no default of its own
        size = () if num_robots is None else (whole_number(num_robots, "num_robots", 1),)
        try:
            self._signature.bind(seed, *size, **given)
        except TypeError as error:
            raise UnknownKeywordError(f"scenario {self.name!r}: {error}; give it by name") from None
        problem = self.generator(seed, *size, **given)
        if not isinstance(problem, Problem):
            raise ValueError(
                f"scenario {self.name!r} returned {short_repr(problem)}; it must return a d4orm_env.Problem"
            )
        if num_robots is not None and problem.num_robots != num_robots:
            raise ValueError(
                f"scenario {self.name!r} returned a problem of {problem.num_robots} robots where num_robots is "
                f"{num_robots}; it must return as many as it is asked for"
            )
        return problem.replace(name=self.name) if problem.name == "custom" else problem


def _complain(owner: str, known: Iterable[str], names: Iterable[str]) -> str:
    """Describe the first of ``names`` that is not ``known``; the empty string if there is none."""
    known = sorted(known)
    for name in names:
        if name not in known:
            return f"{owner} takes no argument {name!r}; it takes {', '.join(known)}{did_you_mean(name, known)}"
    return ""


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


def _built_in(
    function: Callable[..., Problem], name: str = "", about: str = "", *, draws: bool = False, **defaults: object
) -> Scenario:
    """One of :mod:`~d4orm_env.scenarios.generators`, ``(Settings, **own arguments) -> Problem``, as a scenario.

    Name and description are the function's by default, and ``defaults`` where its own differ from those of
    :class:`~d4orm_env.scenarios.settings.Settings`.
    """
    own = tuple(inspect.signature(function).parameters)[1:]
    name = name or function.__name__
    generator = partial(_generate, function, name, own, defaults)
    return Scenario(
        name, generator, about or function.__doc__ or "", draws, (*own, *COMMON_ARGUMENTS, "robot", "downwash")
    )


def _generate(
    function: Callable[..., Problem], name: str, own: tuple[str, ...], defaults: Mapping[str, object],
    seed: int = 0, num_robots: int | None = None, **settings: Any,
) -> Problem:  # fmt: skip
    arguments = {name: settings.pop(name) for name in own if name in settings}
    size = {} if num_robots is None else {"num_robots": num_robots}
    robot, downwash = settings.pop("robot", None), settings.pop("downwash", None)
    if robot is None and downwash:
        raise ValueError("downwash is of robots by name; give robot, as 'crazyflie', or a footprint")
    team = {}
    if robot is not None:
        # Another radius is that of its body, and another footprint takes the place of both.
        radius = None if "footprint" in settings else settings.pop("radius", None)
        team = find_robot(robot).settings(downwash, radius)
    common = {**defaults, **team, **size, **settings}
    if "footprint" in common:  # the radius follows
        common["radius"] = settings.get("radius")
    # A value too large for float32 becomes infinite, and is then refused by name.
    with np.errstate(over="ignore"):
        return function(Settings(scenario=name, seed=seed, **common), **arguments)


_in_space = partial(_built_in, model="holonomic3d")
# Instances of other publications, in which robots stop dead at their goals.
_paper = partial(_built_in, horizon=100, goal_speed=np.inf)
_amswarm = partial(_in_space, num_robots=10, radius=0.29, margin=0.05, goal_speed=np.inf)
_drawn = partial(_built_in, draws=True)

for _scenario in (
    _built_in(generators.circle),
    _in_space(generators.sphere),
    _drawn(generators.random),
    _built_in(generators.four_obstacles),
    _built_in(generators.heterogeneous, model=None, max_acceleration=None),
    _built_in(generators.swap),
    *(
        _amswarm(partial(walled.amswarm, _centres), _name, f"AMSwarm environment {_name[-1]}: {_about}.")
        for _name, (_about, _centres) in walled.AMSWARM.items()
    ),
    _paper(
        generators.circle, "paper_circle",
        "The paper's circle of 5 m with antipodal goals: scenario ``circle`` with 100 steps, however slow the robots.",
    ),
    _paper(generators.paper_sphere, model="holonomic3d", radius=0.3),
    _paper(generators.paper_random, draws=True),
    _paper(generators.paper_heterogeneous, model=None, max_acceleration=None),
    _paper(generators.paper_obstacles, num_obstacles=4),
    *map(_drawn, (wall_grid.rooms, wall_grid.maze, walled.warehouse, walled.forest, walled.corridor, walled.doorway)),
    *(
        _drawn(partial(walled.mmd_map, _boxes), _name, _about, goal_speed=np.inf)
        for _name, (_about, _boxes) in walled.MMD_MAPS.items()
    ),
    _built_in(maps.map),
):  # fmt: skip
    register_scenario(_scenario.name, _scenario)


def list_scenarios() -> tuple[str, ...]:
    """The names :func:`~d4orm_env.scenarios.make_problem` knows."""
    return tuple(SCENARIOS)


def describe_scenario(name: str) -> str:
    """One line on a scenario; a name that none has is a ValueError."""
    return SCENARIOS.look_up(name).description


def _file(path: str | os.PathLike[str], seed: int = 0, num_robots: int | None = None) -> Problem:
    """A scenario file as a generator: the same problem for every seed."""
    problem = problem_files.load_problem(path)
    if num_robots not in (None, problem.num_robots):
        raise ValueError(
            f"{path} has {problem.num_robots} robots, and num_robots is {num_robots}; leave num_robots out"
        )
    return problem


def is_scenario_file(scenario: object) -> TypeGuard[str | os.PathLike[str]]:
    """Check whether a scenario is given as the path of a file."""
    return is_yaml_path(scenario) if isinstance(scenario, str) else isinstance(scenario, os.PathLike)


def find_scenario(scenario: ScenarioLike) -> Scenario:
    """The scenario that a name, a YAML file, a ``"package.module:function"`` or a callable stands for."""
    if isinstance(scenario, Scenario):
        return scenario
    if isinstance(scenario, Problem):
        raise ValueError("scenario is a Problem; give environments problem=..., and planners the problem itself")
    if is_scenario_file(scenario):
        return Scenario(Path(scenario).stem, partial(_file, scenario))
    if callable(scenario):
        return Scenario(getattr(scenario, "__name__", type(scenario).__name__), scenario)
    return SCENARIOS.find(scenario, "a .yaml file, ")


def unknown_argument(scenario: ScenarioLike | None, names: Iterable[str], others: Iterable[str] = ()) -> str:
    """Describe the first of ``names`` that neither the scenario nor the caller, ``others``, takes; ``""`` for none.

    ``None`` is any of the registered scenarios.
    """
    if scenario is not None:
        return find_scenario(scenario).complaint(names, others)
    known = (name for own in SCENARIOS.own() for name in SCENARIOS[own].arguments)
    return _complain("this", {*others, *known}, names)


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
