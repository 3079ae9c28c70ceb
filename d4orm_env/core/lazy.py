"""Modules that are imported when they are first used: those that take long, and those of optional extras."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import Any


class LazyModule:
    """A module that is imported when an attribute of it is asked for; an ImportError names ``user`` and ``extra``."""

    def __init__(self, name: str, user: str = "", extra: str = "") -> None:
        self._name, self._user, self._extra = name, user, extra

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("__"):  # asked by what looks through the names of a module
            raise AttributeError(attribute)
        return getattr(load(self), attribute)


def load(module: LazyModule) -> ModuleType:
    """Import a module now."""
    try:
        return import_module(module._name)
    except ImportError as error:
        if not module._user:
            raise
        library = error.name or module._name.partition(".")[0]
        remedy = f"install it with: pip install 'd4orm-env[{module._extra}]'"
        raise ImportError(f"{module._user} needs {library}; {remedy}", name=error.name) from error
