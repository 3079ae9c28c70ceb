"""Noise schedules: the standard deviation of the samples at every step of one iteration.

The diffusion schedule is a property of the fraction of steps done: 100 variances ``beta`` rise linearly, and for
another number of steps the cumulative product is interpolated (paper, section III-B and appendix, "Noise Schedule").
"""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray

REFERENCE_STEPS = 100


def alpha_bar(num_steps: int, beta_start: float, beta_end: float) -> np.ndarray:
    """``(num_steps,)`` cumulative products of ``1 - beta``, for steps ``i = 1`` to ``num_steps``."""
    cumulative = np.cumprod(1 - np.linspace(beta_start, beta_end, REFERENCE_STEPS))
    values = np.concatenate([[1.0], cumulative, cumulative[-1:]])
    # Not numpy.interp, in which compilers may fuse a multiplication with an addition.
    whole, rest = np.divmod(np.arange(1, num_steps + 1) * REFERENCE_STEPS, num_steps)
    return values[whole] + (values[whole + 1] - values[whole]) * (rest / num_steps)


def annealed(num_steps: int, beta_start: float, beta_end: float) -> FloatArray:
    """``(num_steps,)`` standard deviations ``sqrt(1 / alpha_bar - 1)``, from the first denoising step to the last.

    Paper, Algorithm 1, line 3.
    """
    return np.sqrt(1 / alpha_bar(num_steps, beta_start, beta_end)[::-1] - 1).astype(np.float32)


def constant(num_steps: int, sigma: float) -> FloatArray:
    """``(num_steps,)`` equal standard deviations, as in MPPI."""
    return np.full(num_steps, sigma, np.float32)
