"""The machine and the versions of libraries, for records of measurements and the provenance of plans."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from d4orm_env import __version__
from d4orm_env.core.lazy import LazyModule
from d4orm_env.engine.threads import available_cores

llvm: Any = LazyModule("llvmlite.binding")
numba_config: Any = LazyModule("numba.core")


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
        return cls(preset=preset, settings=plain, version=__version__, machine=_machine())


@cache
def _machine() -> dict[str, object]:
    return describe_machine()
