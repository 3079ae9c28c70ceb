"""Scenario: a function that makes problems, the package's own or a user's."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import Any

import numpy as np

from d4orm_env.core.arrays import short_repr, whole_number
from d4orm_env.core.errors import UnknownKeywordError, did_you_mean
from d4orm_env.core.problem import Problem
from d4orm_env.core.robot_types import find_robot
from d4orm_env.scenarios.settings import Settings

DEFAULT_ROBOTS = 8
COMMON_ARGUMENTS = tuple(attribute.name for attribute in fields(Settings) if attribute.name != "scenario")
_KEYWORDS = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


def built_in(
    function: Callable[..., Problem], name: str = "", about: str = "", *, draws: bool = False, **defaults: object
) -> Scenario:
    """One of :mod:`~d4orm_env.scenarios.generators`, ``(Settings, **own arguments) -> Problem``, as a scenario.

    Name and description are the function's by default, and ``defaults`` where its own differ from those of
    :class:`~d4orm_env.scenarios.settings.Settings`.
    """
    own = tuple(inspect.signature(function).parameters)[1:]
    name = name or function.__name__
    generator = partial(_generate, function, name, own, defaults)
    return Scenario(name, generator, about or function.__doc__ or "", draws, (*own, *COMMON_ARGUMENTS, "robot"))


def _generate(
    function: Callable[..., Problem], name: str, own: tuple[str, ...], defaults: Mapping[str, object],
    seed: int = 0, num_robots: int | None = None, **settings: Any,
) -> Problem:  # fmt: skip
    arguments = {name: settings.pop(name) for name in own if name in settings}
    size = {} if num_robots is None else {"num_robots": num_robots}
    robot = settings.pop("robot", None)
    team = {} if robot is None else find_robot(robot).settings
    common = {**defaults, **team, **size, **settings}
    if "footprint" in settings:  # the radius follows
        common["radius"] = settings.get("radius")
    # A value too large for float32 becomes infinite, and is then refused by name.
    with np.errstate(over="ignore"):
        return function(Settings(scenario=name, seed=seed, **common), **arguments)


@dataclass(frozen=True)
class Scenario:
    """Something that makes problems."""

    name: str  #: Its name in tables and messages
    generator: Callable[..., Problem]  #: ``(seed, num_robots, **settings) -> Problem``
    about: str = ""  #: What describes it; the generator's docstring by default
    draws: bool = False  #: Every seed is known to give other positions, and never another team
    known: tuple[str, ...] = ()  #: All arguments of a generator that does not name them itself

    def __post_init__(self) -> None:
        try:
            self._signature.bind_partial(0, DEFAULT_ROBOTS)
        except (TypeError, ValueError):
            raise ValueError(
                f"scenario {self.name!r} is {short_repr(self.generator)}; it must be a callable "
                "(seed, num_robots, **settings) that returns a Problem"
            ) from None

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
        if self.known:
            return self.known
        settings = [parameter.name for parameter in self._parameters[2:] if parameter.kind in _KEYWORDS]
        return (*settings, "num_robots", "seed")

    def complaint(self, names: Iterable[str], others: Iterable[str] = ()) -> str:
        """Describe the first of ``names`` that neither this nor the caller, ``others``, takes; ``""`` for none."""
        if not self.known and any(parameter.kind is parameter.VAR_KEYWORD for parameter in self._parameters):
            return ""  # the generator checks its settings itself
        return complain(f"scenario {self.name!r}", {*others, *self.arguments}, names)

    def problem(self, num_robots: int | None = None, seed: int | None = None, **arguments: object) -> Problem:
        """See :func:`~d4orm_env.scenarios.problems.make_problem`."""
        given = {name: value for name, value in arguments.items() if value is not None}
        # Whatever the scenario, leaving a common argument out is no mistake.
        complaint = self.complaint(name for name in arguments if name in given or name not in COMMON_ARGUMENTS)
        if complaint:
            raise UnknownKeywordError(complaint)
        return self._make(num_robots, seed, given)

    def _make(self, num_robots: int | None, seed: int | None, settings: Mapping[str, object]) -> Problem:
        """The problem for that seed, checked to be one and to have that many robots."""
        seed = 0 if seed is None else whole_number(seed, "seed", 0)
        if num_robots is None and all(parameter.default is parameter.empty for parameter in self._parameters[1:2]):
            num_robots = DEFAULT_ROBOTS  # for the generator has no default of its own
        size = () if num_robots is None else (whole_number(num_robots, "num_robots", 1),)
        try:
            self._signature.bind(seed, *size, **settings)
        except TypeError as error:
            raise UnknownKeywordError(f"scenario {self.name!r}: {error}; give it by name") from None
        problem = self.generator(seed, *size, **settings)
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


def complain(owner: str, known: Iterable[str], names: Iterable[str]) -> str:
    """Describe the first of ``names`` that is not ``known``; the empty string if there is none."""
    known = sorted(known)
    for name in names:
        if name not in known:
            return f"{owner} takes no argument {name!r}; it takes {', '.join(known)}{did_you_mean(name, known)}"
    return ""
