"""What users bring: objects by import path, and those that installed packages offer as entry points."""

from __future__ import annotations

import os
import sys
from functools import reduce
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from d4orm_env.core.arrays import shown


def import_object(path: str, what: str) -> Any:
    """The object that ``"package.module:Name"`` names; modules are looked for in the current folder too.

    Args:
        path: Module and name.
        what: What to call it in an error.

    Raises:
        ValueError: If there is no such object, or importing its module fails.
    """
    module, _, name = path.partition(":")
    if not module or not name:
        raise ValueError(f"{what} {shown(path)} is not of the form package.module:Name")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        return reduce(getattr, name.split("."), import_module(module))
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise ValueError(
            f"{what} {shown(path)} cannot be imported ({reason}); check the module and the name"
        ) from error


def entry_point_names(group: str) -> tuple[str, ...]:
    """Names that installed packages offer in a group, each once."""
    return tuple(dict.fromkeys(point.name for point in entry_points(group=group)))


def load_entry_point(group: str, name: str, what: str) -> Any:
    """The object that an installed package offers under a name; ``None`` if none does.

    Raises:
        ValueError: If loading it fails, or two packages offer the name.
    """
    found = tuple(entry_points(group=group, name=name))
    if len(found) > 1:
        owners = " and ".join(_owner(point) for point in found)
        raise ValueError(f"{what} {name!r} is offered by {owners}; uninstall one of them, or import the one you mean")
    if not found:
        return None
    try:
        return found[0].load()
    except Exception as error:
        raise ValueError(
            f"{what} {name!r} of {_owner(found[0])} cannot be loaded ({type(error).__name__}: {error}); "
            f"mend or uninstall it"
        ) from error


def _owner(point: EntryPoint) -> str:
    return f"{point.dist.name} ({point.value})" if point.dist is not None else point.value
