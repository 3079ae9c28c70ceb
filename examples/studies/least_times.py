"""Bound on travel times that two studies compare with: a straight drive, alone, in the environment's own steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from d4orm_env import Problem
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED

Floats = NDArray[np.float64]


def least_times(problem: Problem, distance: Floats, speed: Floats, last_speed: Floats) -> Floats:
    """``(K,)`` seconds within which no robot gets so far.

    The speed limit holds after a step: one that begins at the limit still goes ``acceleration * dt**2 / 2`` further.

    Args:
        problem: Gives limits and time step.
        distance: ``(K,)`` [m].
        speed: ``(K,)`` at the beginning, in the right direction [m/s].
        last_speed: ``(K,)`` most at the end [m/s]; infinite for any.
    """
    limits, dt = problem.team.limits.astype(float), problem.dt
    top, gain = limits[:, SPEED], limits[:, ACCELERATION] * dt
    times = np.where(distance > 0, np.inf, 0.0)
    steps = 0
    while np.isinf(times).any():
        steps += 1
        done = np.arange(steps + 1)[:, None]
        fastest = np.minimum(np.minimum(speed + gain * done, top), last_speed + gain * done[::-1])
        change = np.diff(fastest, axis=0)
        far = ((fastest[:-1] + np.where(change < 0, change, gain) / 2) * dt).sum(axis=0)
        times[np.isinf(times) & (far >= distance)] = steps * dt
    return times
