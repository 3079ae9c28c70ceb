"""Robots driving to points on their own, compiled with numba: whole paths, many at a time."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import TimeStep
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import OPTIONS, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.stepping import make_stepper, models_key
from d4orm_env.engine.tile_layout import SQUARED_GAP, Row
from d4orm_planners.tracking.tracker import tracker


class DriveInputs(NamedTuple):
    """``V`` paths of each of ``R`` robots: as given at first, then straight by points to the goal.

    Attributes:
        states: ``(R, H+1, n)`` as given.
        controls: ``(R, H, m)`` as given, inside the limits, zero for docked robots.
        switch: ``(R, V)`` time step from which on a path is driven.
        vias: ``(R, V, P, d)`` points to come near to one after the other, before the goal.
        near2: Square of how near to a point is near [m^2].
    """

    states: FloatArray
    controls: FloatArray
    switch: NDArray[np.int64]
    vias: FloatArray
    near2: np.float32


Drives = Kernel[[ProblemArrays, DriveInputs, IntArray, FloatArray, FloatArray, BoolArray], None]
"""A kernel of :func:`straight_kernel`."""


@cache
def straight_kernel(name: str) -> Drives:
    """The compiled drives of robots of the model with this name, each as if alone.

    The kernel fills, for robots of these numbers, controls ``u`` ``(R, V, H, m)``, states ``x`` ``(R, V, H+1, n)`` and
    ``arrived`` ``(R, V)``.
    """
    model = MODELS[name]
    _, dock = make_stepper(model)
    approach, squared_gap = inlined(model.functions.approach), SQUARED_GAP[model.dimension]
    n, m, d, num_limits = model.state_size, model.control_size, model.dimension, len(model.limit_names)

    @inlined
    def by_points(
        reference: tuple[FloatArray, np.float32], passed: int, step: int, x: Row, goal: Row, limits: Row, h: TimeStep
    ) -> tuple[Row, int, bool]:
        (vias, near2), aim = reference, goal
        while passed < vias.shape[0]:
            aim = to_fixed_tuple(vias[passed], d)
            if not squared_gap(x, aim) < near2:
                break
            passed, aim = passed + 1, goal
        return approach(x, aim, limits, h, OPS), passed, True

    drive = tracker(model, by_points)

    @cached_kernel(variant=name, key=models_key((name,)), **OPTIONS)
    def drive_straight(
        arrays: ProblemArrays, given: DriveInputs, robots: IntArray, u: FloatArray, x: FloatArray, arrived: BoolArray
    ) -> None:
        docking = (arrays.squared_goal_radius, arrays.squared_goal_speed, arrays.docks)
        for r in robots:
            limits, goal = to_fixed_tuple(arrays.limits[r], num_limits), to_fixed_tuple(arrays.goal[r], d)
            for v in range(given.switch.shape[1]):
                first, at_goal = given.switch[r, v], False
                x[r, v, : first + 1, :n] = given.states[r, : first + 1, :n]
                u[r, v, :first, :m] = given.controls[r, :first, :m]
                state = to_fixed_tuple(given.states[r, first], n)
                if first > 0:
                    control = to_fixed_tuple(given.controls[r, first - 1], m)
                    state, _, at_goal = dock(False, state, control, limits, goal, docking)
                reference = (given.vias[r, v], given.near2)
                arrival = drive(arrays, r, reference, 0, first, state, at_goal, u[r, v], x[r, v])
                arrived[r, v] = arrival < x.shape[2]

    return drive_straight
