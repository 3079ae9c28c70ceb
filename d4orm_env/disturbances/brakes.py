"""Controls that bring robots to rest."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.disturbances.disturbance import Scene
from d4orm_env.dynamics.robot_model import TimeStep


def brake(scene: Scene, states: FloatArray, robots: BoolArray) -> FloatArray:
    """``(B, K, m)`` controls that stop robots as fast as their limits allow, zero for the others.

    Args:
        scene: The worlds.
        states: ``(B, K, n)``.
        robots: ``(B, K)`` bool: which are to brake.
    """
    problem = scene.problem
    controls: FloatArray = np.zeros((*states.shape[:2], problem.control_size), np.float32)
    step = TimeStep(*problem.arrays.time_step)
    still = (np.float32(0),) * problem.dimension
    for robot, model in enumerate(problem.team.robot_models):
        worlds = np.flatnonzero(robots[:, robot])
        if len(worlds):
            x = tuple(states[worlds, robot, : model.state_size].T)
            wanted = model.functions.track(x, still, tuple(problem.arrays.limits[robot]), step, NUMPY_OPS)
            for component, value in enumerate(wanted):
                controls[worlds, robot, component] = value
    return controls
