"""The plain JAX formulation as the tests use it: what an engine should say, computed the way anyone would write it."""

from __future__ import annotations

from typing import Any

import numpy as np
from engine_support import engine_noise

from d4orm_env.core.problem import Problem
from d4orm_planners import reference as plain
from d4orm_planners.engine.sampling_types import SamplingTask

TEMPERATURE = 0.3


def sample_controls(task: SamplingTask, mean: Any, sigma: float, num_samples: int, seed: int, step: int) -> np.ndarray:
    """``(M, H, K, m)`` deformations of one step, from the engines' own noise."""
    normals = engine_noise(task.problem, seed, step, num_samples)
    return (mean + np.float32(sigma) * normals).astype(np.float32)


def score(problem: Problem, controls: Any) -> np.ndarray:
    """``(M, K)`` mean rewards of ``controls`` ``(M, H, K, m)``."""
    model, team = plain.plain_team(problem)
    return np.asarray(plain.score(model, team, np.asarray(controls, np.float32)))
