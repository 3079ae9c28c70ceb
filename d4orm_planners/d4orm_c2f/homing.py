"""The last metres: robots that are nearly there drive straight home."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.robot_model import ACCELERATION, SPEED
from d4orm_env.engine.base import Engine
from d4orm_planners.steering import straight_drives

PASSING = 1e-6
"""Goal radius of robots that drive through a place and do not dock there [m]."""


def docking_radius(problem: Problem, docks: bool) -> float:
    """The goal radius for rollouts of an episode [m]; who does not dock drives on when it arrives, to its next goal."""
    return problem.goal_radius if docks else PASSING


def drive_home(window: Problem, engine: Engine, controls: FloatArray, near: BoolArray) -> tuple[FloatArray, BoolArray]:
    """The controls, but straight drives for robots that dock by these no later.

    Samples head for a goal only roughly, and who misses it at full speed has to turn.

    Args:
        window: The robots from where they are to their goals, over the prediction horizon.
        engine: What rolls out.
        controls: ``(H_predict, K, m)``.
        near: ``(K,)`` whose drives are tried.

    Returns:
        ``(H_predict, K, m)`` controls, and ``(K,)`` who drives straight home.
    """
    offsets = window.goal - window.start[:, : window.dimension]
    away = np.linalg.norm(offsets, axis=1, keepdims=True)
    speed, acceleration = (window.team.limits[:, limit, None] for limit in (SPEED, ACCELERATION))
    near = near & (away <= speed * window.dt * window.horizon)[:, 0]
    home = np.zeros_like(near)
    if not near.any():
        return controls, home
    latest = np.minimum(_docking_times(window, engine, controls), window.horizon)
    # Past the goal at full speed where that meets it; else so that robots could stop there.
    for beyond in (speed**2 / (2 * acceleration), np.zeros_like(speed)):
        aimed = window.goal + beyond * offsets / np.maximum(away, window.goal_radius)
        straight = straight_drives(window.resumed_at(window.start, aimed, goal_radius=PASSING)).controls[:, :, 0]
        sooner = near & ~home & (_docking_times(window, engine, straight) <= latest)
        controls = np.where(sooner[:, None], straight, controls)
        home |= sooner
        if not (near & ~home).any():
            break
    return controls, home


def _docking_times(window: Problem, engine: Engine, controls: FloatArray) -> IntArray:
    """``(K,)`` time steps until everybody docks; one more than there are for who does not."""
    steps: IntArray = (~engine.rollout(window, controls).arrived).sum(axis=0)
    return steps
