"""Range sensors of the robots of a batch of worlds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.engine.types import WorldBatch, WorldEngine
from d4orm_env.envs.world_problems import WorldProblems


def sense_ranges(
    engine: WorldEngine,
    layout: ObservationLayout,
    problems: WorldProblems,
    batch: WorldBatch,
    out: FloatArray,
    worlds: NDArray[np.intp] | None = None,
) -> None:
    """Fill the rays of the observations ``out`` ``(b, K, D)`` of some worlds, or of all, as these truly are."""
    if not layout.num_rays:
        return
    rows = slice(None) if worlds is None else worlds
    state, bodies = batch.state[rows], batch.bodies[rows]
    if problems.alike:
        engine.cast_rays(problems.true[0], layout, state, bodies, out)
        return
    for row, world in enumerate(range(len(out)) if worlds is None else worlds):
        one = slice(row, row + 1)
        engine.cast_rays(problems.true[world], layout, state[one], bodies[one], out[one])
