"""Provenance of results: the machine and versions, provenance of plans, and fingerprints of users' objects, by which
a store of trials distinguishes instances and functions.
"""

from __future__ import annotations

import copyreg
import hashlib
import importlib.metadata
import inspect
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

from d4orm_env import __version__
from d4orm_env.core.errors import describe
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.engine.threads import available_cores

llvm: Any = LazyModule("llvmlite.binding")
numba_config: Any = LazyModule("numba.core")


@cache
def describe_machine() -> dict[str, object]:
    """Processor, its cores and how many of them are used, system, and version of Python.

    A virtual processor may hide its model, so LLVM's name of what kernels are compiled for stands behind it.
    """
    target = getattr(numba_config.config, "CPU_NAME", None) or llvm.get_host_cpu_name()
    return {
        "processor": f"{_processor()} ({target})",
        "cores": os.cpu_count(),
        "cores_used": available_cores(),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def versions(names: Iterable[str]) -> dict[str, str]:
    """Versions of those of these distributions that are installed."""
    installed = {}
    for name in names:
        try:
            installed[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return installed


def commit() -> str:
    """The commit of the checkout that this package is run from, with ``+`` behind it where files differ from it.

    Empty for a package that is installed elsewhere, and without git.
    """
    package = Path(__file__).parents[1]
    if not (package.parent / ".git").exists():
        return ""
    describe = ["git", "-C", str(package), "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty=+"]
    try:
        return subprocess.run(describe, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def _processor() -> str:
    """The model name, which :func:`platform.processor` does not tell on Linux."""
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        for line in listing.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Origin of a plan, in addition to its planner's name and the seed."""

    preset: str | None  #: Of :func:`~d4orm_planners.make_planner`; ``None`` for the defaults
    settings: Mapping[str, object]  #: All settings of the planner, by name; what JSON has no word for as text
    version: str  #: Of this package
    machine: Mapping[str, object]  #: Processor, cores and system, as the benchmark describes them

    def __post_init__(self) -> None:
        kinds = {"preset": (str, type(None)), "settings": Mapping, "version": str, "machine": Mapping}
        for name, kind in kinds.items():
            if not isinstance(getattr(self, name), kind):  # type: ignore[arg-type]
                raise ValueError(f"{name} of the provenance is {getattr(self, name)!r}")

    @classmethod
    def here(cls, preset: str | None, settings: Mapping[str, object]) -> Provenance:
        """Return that of a plan made by a planner with this preset and these settings here and now."""
        plain = json.loads(json.dumps(settings, default=str))
        return cls(preset=preset, settings=plain, version=__version__, machine=describe_machine())


def attributes(thing: object) -> dict[str, object]:
    """All that distinguishes an instance or a function from others of the same source, by name, as JSON has it.

    These are the attributes of an instance, and the default arguments and closure of a function. Numbers, truth values
    and text stay as they are; of all else there is a digest, or a ValueError for what has none, as an open file.
    """
    if isinstance(thing, partial):
        given = {str(number): value for number, value in enumerate(thing.args)} | thing.keywords
        return attributes(thing.func) | _described(given, thing.func)
    if isinstance(thing, MethodType):
        return attributes(thing.__self__) | attributes(thing.__func__)
    if isinstance(thing, FunctionType):
        parameters = inspect.signature(thing).parameters.values()
        defaults = {own.name: own.default for own in parameters if own.default is not own.empty}
        return _described(defaults | dict(inspect.getclosurevars(thing).nonlocals), thing)
    if isinstance(thing, type):
        return {}
    state = object.__getstate__(thing)  # and that of slots, if there are any
    parts = state if isinstance(state, tuple) else (state,)
    return _described({name: value for part in parts if part for name, value in part.items()}, thing)


def _described(values: Mapping[str, object], owner: object) -> dict[str, object]:
    digests, found = _Digests(), {}
    for name, value in values.items():
        try:
            found[name] = digests.of(value)
        except Exception as error:  # objects reduce themselves by methods of their own
            called = getattr(owner, "__name__", type(owner).__name__)
            raise ValueError(
                f"{name!r} of {called} cannot be told from others of its kind "
                f"({describe(error)}), so that stored trials could be another policy's; give a class whose method "
                "identity() returns what tells it, as {'gain': 1}"
            ) from error
    return found


class _Digests:
    """Digests of objects by what pickling keeps of them, each object looked at once."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[object, str]] = {}  # the objects too, for others may get their ids

    def of(self, value: object) -> object:
        """A number, truth value or text itself; of all else the SHA-256 of its parts."""
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if id(value) not in self._known:
            self._known[id(value)] = value, "itself"
            text = json.dumps([type(value).__qualname__, *map(self.of, self._parts(value))])
            self._known[id(value)] = value, hashlib.sha256(text.encode()).hexdigest()
        return self._known[id(value)][1]

    def _parts(self, value: object) -> list[object]:
        """The parts that distinguish an object from others of its type."""
        if isinstance(value, list | tuple) and type(value) in (list, tuple):
            return list(value)
        if type(value) is dict:
            return [part for item in value.items() for part in item]
        if isinstance(value, set | frozenset):
            return sorted(map(self.of, value), key=repr)
        if isinstance(value, bytes | bytearray):
            return [value.hex()]
        if isinstance(value, Problem):
            return [value.digest]
        if isinstance(value, FunctionType):
            return [value.__code__, attributes(value)]
        if isinstance(value, CodeType):
            return [value.co_code, value.co_names, value.co_consts]
        if isinstance(value, type | ModuleType):
            return [getattr(value, "__module__", ""), getattr(value, "__qualname__", value.__name__)]
        if hasattr(value, "act") and hasattr(value, "identity"):
            return [type(value), value.identity()]
        if hasattr(value, "__wrapped__"):  # compiled or cached
            return [value.__wrapped__]
        reduce = copyreg.dispatch_table.get(type(value))
        reduced = reduce(value) if reduce else value.__reduce_ex__(4)
        if isinstance(reduced, str):
            return [reduced]
        made, given, state, items, pairs, *_ = (*reduced, None, None, None)
        return [made, given, state, list(items or ()), list(pairs or ())]
