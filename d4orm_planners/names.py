"""The tables of planners and policies by name, which users and other packages extend."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from d4orm_env.core.arrays import shown
from d4orm_planners.planner import Planner
from d4orm_planners.references import load_reference

_NAME = re.compile(r"[\w][\w.-]*")


class Registry(Mapping[str, Any]):
    """Things by name: registered in this process, or entry points of installed packages; loaded when looked up.

    Args:
        what: Kind of thing, for messages.
        group: Group of the entry points.
    """

    def __init__(self, what: str, group: str) -> None:
        self.what, self.group = what, group
        self._registered: dict[str, Any] = {}

    def add(self, name: str, thing: Any) -> None:
        """Register a thing, or the text ``"package.module:Name"`` of one; again if defined anew, as in a notebook.

        Raises:
            ValueError: If the name is none, or taken by another.
        """
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise ValueError(
                f"{self.what} name {shown(name)} is none; give one of letters, digits, hyphens, dots and underscores"
            )
        known = self._registered.get(name, thing)
        if known is not thing and _place(known) != _place(thing):
            raise ValueError(f"{self.what} name {name!r} is taken; register yours under another")
        self._registered[name] = thing

    def own(self) -> tuple[str, ...]:
        """Names registered in this process, in order."""
        return tuple(self._registered)

    def origin(self, name: str) -> Any:
        """What was registered under a name, or its import path.

        Raises:
            KeyError: If there is no such name.
            ValueError: If several lay claim to it.
        """
        claims = [self._registered[name]] if name in self._registered else []
        claims += [f"{entry.module}:{entry.attr}" for entry in self._entry_points.get(name, ())]
        if not claims:
            raise KeyError(name)
        if len(claims) > 1:
            raise ValueError(
                f"{self.what} name {name!r} is claimed by {' and '.join(map(str, claims))}; uninstall one of them"
            )
        return claims[0]

    def __getitem__(self, name: str) -> Any:
        origin = self.origin(name)
        if not isinstance(origin, str):
            return origin
        try:
            return load_reference(origin)
        except ValueError as error:
            raise ValueError(f"{self.what} {name!r}: {error}") from error

    def __contains__(self, name: object) -> bool:
        return name in self._registered or name in self._entry_points

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._registered, *self._entry_points)))

    def __len__(self) -> int:
        return len(list(iter(self)))

    @cached_property
    def _entry_points(self) -> dict[str, list[EntryPoint]]:
        found: dict[str, list[EntryPoint]] = {}
        for entry in entry_points(group=self.group):
            found.setdefault(entry.name, []).append(entry)
        return found


PLANNERS = Registry("planner", "d4orm.planners")
"""Every planner class by its name."""

POLICIES = Registry("policy", "d4orm.policies")
"""The policies that are no planners; every planner is an open-loop policy too."""


def register_planner(name: str, planner_class: type[Planner] | str) -> None:
    """Let :func:`~d4orm_planners.make_planner` and whatever takes a policy's name know a planner of your own.

    Args:
        name: Its name.
        planner_class: A subclass of :class:`~d4orm_planners.Planner`, or the text ``"package.module:Name"`` of one.

    Raises:
        ValueError: If the name is taken or no name, or the class is no planner.
    """
    if not isinstance(planner_class, str) and not is_planner_class(planner_class):
        raise ValueError(f"planner {name!r} is {shown(planner_class)}; give a subclass of d4orm_planners.Planner")
    _refuse_name_of(POLICIES, name)
    PLANNERS.add(name, planner_class)


def register_policy(name: str, factory: Any) -> None:
    """Let :func:`~d4orm_planners.make_policy` and whatever takes a policy's name know a policy of your own.

    Args:
        name: Its name.
        factory: A subclass of :class:`~d4orm_planners.Policy`, a function that makes a policy from its settings,
            anything else that :func:`~d4orm_planners.make_policy` takes, or the text ``"package.module:Name"`` of one.

    Raises:
        ValueError: If the name is taken or no name, or nothing that acts was given.
    """
    if not isinstance(factory, str) and not (callable(factory) or hasattr(factory, "act")):
        raise ValueError(f"policy {name!r} is {shown(factory)}; give a Policy, or a function that is or makes one")
    _refuse_name_of(PLANNERS, name)
    POLICIES.add(name, factory)


def is_planner_class(thing: Any) -> bool:
    """Whether a thing is a subclass of Planner."""
    return isinstance(thing, type) and issubclass(thing, Planner)


def _place(thing: Any) -> Any:
    """Where a class or function is defined; anything else is told from others by what it is."""
    name = getattr(thing, "__qualname__", "<")
    return thing if "<" in name else (thing.__module__, name)


def _refuse_name_of(other: Registry, name: Any) -> None:
    if name in other.own():
        raise ValueError(f"{other.what} {name!r} has that name already; register yours under another")


for _name, _path in {
    "d4orm": "d4orm:D4orm",
    "d4orm-d": "d4orm_d.planner:D4ormD",
    "d-d4orm": "d_d4orm.planner:DD4orm",
    "mppi": "mppi:MPPI",
    "cem": "cem:CEM",
    "mbd": "mbd:MBD",
    "i-mbd": "mbd:IterativeMBD",
    "ipopt": "ipopt:Ipopt",
}.items():
    register_planner(_name, f"d4orm_planners.{_path}")

for _name, _path in {
    "d4orm-c2f": "d4orm_c2f.policy:D4ormC2F",
    "goal": "policy:DriveToGoal",
    "random": "policy:RandomControls",
    "orca": "orca:Orca",
    "ppo": "rl.learned:PPO",
    "sac": "rl.learned:SAC",
}.items():
    register_policy(_name, f"d4orm_planners.{_path}")
