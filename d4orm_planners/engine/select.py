"""Sampling engines by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from d4orm_env.core.lazy import LazyModule
from d4orm_env.engine.choice import resolve_engine
from d4orm_planners.engine.sampling_types import SamplingEngine

if TYPE_CHECKING:
    from d4orm_planners.engine import cpu_sampling, jax_sampling
else:
    cpu_sampling = LazyModule("d4orm_planners.engine.cpu_sampling")
    jax_sampling = LazyModule("d4orm_planners.engine.jax_sampling")


def get_sampling_engine(name: str = "auto", num_threads: int | None = None) -> SamplingEngine:
    """Return the sampling engine of that name; arguments and errors as :func:`d4orm_env.engine.choice.get_engine`."""
    if resolve_engine(name) == "jax":
        return jax_sampling.JaxSamplingEngine()
    return cpu_sampling.CpuSamplingEngine(num_threads)
