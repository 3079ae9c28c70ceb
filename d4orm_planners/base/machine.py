"""The machine and the versions of libraries, for the record of what was measured."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

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
    package = Path(__file__).parent
    if not (package.parent / ".git").exists():
        return ""
    try:
        number, changes = (
            subprocess.run(
                ["git", "-C", str(package), *words], capture_output=True, text=True, check=True, timeout=10
            ).stdout.strip()
            for words in (("rev-parse", "--short=12", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return number + ("+" if changes else "")


def _processor() -> str:
    """The model name, which :func:`platform.processor` does not tell on Linux."""
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        for line in listing.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
