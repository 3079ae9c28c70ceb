"""Sampling engines by name."""

from __future__ import annotations

from d4orm_env.engine.choice import resolve_engine
from d4orm_planners.engine.sampling_types import SamplingEngine


def get_sampling_engine(name: str = "auto", num_threads: int | None = None) -> SamplingEngine:
    """Return the sampling engine of that name; arguments and errors as :func:`d4orm_env.engine.choice.get_engine`."""
    if resolve_engine(name) == "jax":
        from d4orm_planners.engine.jax_sampling import JaxSamplingEngine

        return JaxSamplingEngine()
    from d4orm_planners.engine.cpu_sampling import CpuSamplingEngine

    return CpuSamplingEngine(num_threads)
