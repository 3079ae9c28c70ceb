"""Robots driving to points on their own, compiled with numba: whole paths, many at a time."""

from __future__ import annotations

from functools import cache

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import TimeStep
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.stepping import docking_of, make_stepper, models_key
from d4orm_env.engine.tile_layout import SQUARED_GAP, Row
from d4orm_planners.tracking.tracker import tracker

Drives = Kernel[[ProblemArrays, IntArray, IntArray, FloatArray, np.float32, FloatArray, FloatArray, BoolArray], None]
"""A kernel of :func:`straight_kernel`."""


@cache
def straight_kernel(name: str) -> Drives:
    """The compiled drives of robots of the model with this name, each as if alone.

    Args of the kernel: the team, the numbers of these robots, and of all: ``switch`` ``(R, V)``, the time step from
    which on a path is driven, ``vias`` ``(R, V, P, d)``, points to come near to one after the other before the goal,
    the square of how near, controls ``u`` ``(R, V, H, m)`` and states ``x`` ``(R, V, H+1, n)``, changed from that step
    on, and ``arrived`` ``(R, V)``, output.
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

    @cached_kernel(variant=name, key=models_key((name,)), **WITHOUT_ARRAYS)
    def drive_straight(
        arrays: ProblemArrays, robots: IntArray, switch: IntArray, vias: FloatArray, near2: np.float32,
        u: FloatArray, x: FloatArray, arrived: BoolArray,
    ) -> None:  # fmt: skip
        arrays = borrow(arrays)
        passed = np.int64(0)  # a literal would compile what it is passed to once more
        for r in robots:
            docking = docking_of(arrays, r)
            limits, goal = to_fixed_tuple(arrays.limits[r], num_limits), to_fixed_tuple(arrays.goal[r], d)
            for v in range(switch.shape[1]):
                first, at_goal = switch[r, v], False
                state = to_fixed_tuple(x[r, v, first], n)
                if first > 0:
                    control = to_fixed_tuple(u[r, v, first - 1], m)
                    state, _, at_goal = dock(False, state, control, limits, goal, docking)
                arrival = drive(arrays, r, (vias[r, v], near2), passed, first, state, at_goal, u[r, v], x[r, v])
                arrived[r, v] = arrival < x.shape[2]

    return drive_straight
