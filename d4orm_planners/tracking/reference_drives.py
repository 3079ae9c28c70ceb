"""Driving a team along a reference in time, each robot as if alone, compiled with numba."""

from __future__ import annotations

from functools import cache
from typing import TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import TimeStep
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS, inlined, to_fixed_tuple
from d4orm_env.engine.stepping import Row, models_key
from d4orm_planners.tracking.pursuit import vectors
from d4orm_planners.tracking.steering import by_model
from d4orm_planners.tracking.tracker import tracker

Reference: TypeAlias = tuple[FloatArray, FloatArray, np.float32]


@cache
def reference_kernel(
    name: str,
) -> Kernel[[ProblemArrays, IntArray, FloatArray, FloatArray, np.float32, FloatArray, FloatArray], None]:
    """The compiled drives of robots of the model with this name.

    Args of the kernel: the team, the numbers of these robots, and of all: positions and velocities ``(K, T, d)`` of the
    reference, the gain [1/s], ``controls`` ``(K, T, m)``, output, and ``states`` ``(K, T+1, n)`` after the first one.
    """
    model = MODELS[name]
    scaled, _, between = vectors(model.dimension)
    n, d = model.state_size, model.dimension

    @inlined
    def towards(
        reference: Reference, memory: int, step: int, x: Row, goal: Row, limits: Row, h: TimeStep
    ) -> tuple[Row, int, bool]:
        positions, velocities, gain = reference
        error = between(x, to_fixed_tuple(positions[step], d))
        return scaled(to_fixed_tuple(velocities[step], d), error, gain), memory, False

    drive = tracker(model, towards)

    @cached_kernel(variant=name, key=models_key((name,)), **WITHOUT_ARRAYS)
    def drive_reference(
        arrays: ProblemArrays, robots: IntArray, positions: FloatArray, velocities: FloatArray, gain: np.float32,
        controls: FloatArray, states: FloatArray,
    ) -> None:  # fmt: skip
        arrays = borrow(arrays)
        nothing = np.int64(0)
        for k in robots:
            x = to_fixed_tuple(states[k, 0], n)
            drive(arrays, k, (positions[k], velocities[k], gain), nothing, 0, x, False, controls[k], states[k])

    return drive_reference


def follow_reference(
    problem: Problem, states: FloatArray, positions: FloatArray, velocities: FloatArray, gain: float
) -> FloatArray:
    """``(T, K, m)`` controls that drive robots along a reference, as if they had no goals.

    Args:
        problem: The robots.
        states: ``(K, n)`` their present states.
        positions: ``(T, K, d)`` of the reference at the beginning of every time step [m].
        velocities: ``(T, K, d)`` likewise [m/s].
        gain: Share of the position error that is corrected in a second [1/s].
    """
    anywhere = problem.arrays._replace(
        docks=np.bool_(False), turns_at_goals=None, goal_direction=None, squared_goal_chord=None, footprints=None
    )
    due, wanted = (np.ascontiguousarray(np.moveaxis(part, 0, 1), np.float32) for part in (positions, velocities))
    controls = np.zeros((problem.num_robots, len(positions), problem.control_size), np.float32)
    driven = np.empty((problem.num_robots, len(positions) + 1, problem.state_size), np.float32)
    driven[:, 0] = states
    rest = due, wanted, np.float32(gain), controls, driven
    for model, robots in by_model(problem):
        reference_kernel(model.name)(anywhere, np.array(robots), *rest)
    # The norm may come out above the limit by a rounding error.
    return np.clip(np.moveaxis(controls, 1, 0), *problem.team.control_bounds)
