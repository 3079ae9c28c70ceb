"""Engines by name."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from d4orm_env.core.errors import unknown
from d4orm_env.core.lazy import LazyModule
from d4orm_env.engine.types import Engine

if TYPE_CHECKING:
    from d4orm_env.engine import cpu
    from d4orm_env.jax import jax_engine
else:
    cpu = LazyModule("d4orm_env.engine.cpu")
    jax_engine = LazyModule("d4orm_env.jax.jax_engine")

jax: Any = LazyModule("jax")

ENGINES = ("auto", "cpu", "jax")


def get_engine(name: str = "auto", num_threads: int | None = None) -> Engine:
    """The engine of that name.

    Args:
        name: ``"auto"`` is JAX where JAX sees an accelerator, and the CPU engine elsewhere.
        num_threads: Of the CPU engine; as many as there are cores by default.

    Raises:
        ValueError: If there is no such engine.
    """
    if resolve_engine(name) == "jax":
        return jax_engine.JaxEngine()
    return cpu.CpuEngine(num_threads)


def resolve_engine(name: str) -> str:
    """Return ``"cpu"`` or ``"jax"``, whichever a name means here.

    Raises:
        ValueError: If there is no such engine.
    """
    if name not in ENGINES:
        raise unknown("engine", name, ENGINES)
    if name == "auto":
        name = "jax" if _accelerator_visible() else "cpu"
    return name


def _accelerator_visible() -> bool:
    # JAX sees accelerators through plugin packages. Where none is installed there is no need to import JAX to ask it,
    # which would take longer than planning.
    if "jax" not in sys.modules and not any(find_spec(plugin) for plugin in ("jax_plugins", "libtpu")):
        return False
    return jax.default_backend() != "cpu"
