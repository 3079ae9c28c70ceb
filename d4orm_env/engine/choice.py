"""Engines by name, and the rollout of controls by any of them."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from numpy.typing import ArrayLike

from d4orm_env.core.arrays import is_one_of
from d4orm_env.core.errors import unknown
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import check_is_problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine.types import Engine

ENGINES = ("auto", "cpu", "jax")


def get_engine(name: str = "auto", num_threads: int | None = None) -> Engine:
    """The engine of that name.

    Args:
        name: ``"auto"`` is JAX where JAX sees an accelerator, and the CPU engine elsewhere.
        num_threads: Of the CPU engine; as many as there are cores by default.

    Raises:
        ValueError: If there is no such engine.
    """
    # Here, because importing what computes takes longer than all else.
    if resolve_engine(name) == "jax":
        from d4orm_env.jax.jax_engine import JaxEngine

        return JaxEngine()
    from d4orm_env.engine.cpu import CpuEngine

    return CpuEngine(num_threads)


def rollout(problem: Problem, controls: ArrayLike, engine: str = "auto") -> Trajectory:
    """The motion of the team under ``controls``, clipped to the robots' limits.

    Args:
        problem: Starts, goals, limits and world.
        controls: ``(H, K, m)``.
        engine: ``"auto"``, ``"cpu"`` or ``"jax"``.

    Returns:
        States, executed controls, rewards and flags over time.

    Raises:
        ValueError: If the controls have another shape or are not finite, or the engine is unknown.
    """
    check_is_problem(problem)
    return get_engine(engine).rollout(problem, controls)


def resolve_engine(name: str) -> str:
    """Return ``"cpu"`` or ``"jax"``, whichever a name means here."""
    if not is_one_of(name, ENGINES):
        raise unknown("engine", name, ENGINES)
    if name == "auto":
        name = "jax" if _accelerator_visible() else "cpu"
    return name


def _accelerator_visible() -> bool:
    # JAX sees accelerators through plugin packages. Where none is installed there is no need to import JAX to ask it,
    # which would take longer than planning.
    if "jax" not in sys.modules and not any(find_spec(plugin) for plugin in ("jax_plugins", "libtpu")):
        return False
    import jax

    return jax.default_backend() != "cpu"
