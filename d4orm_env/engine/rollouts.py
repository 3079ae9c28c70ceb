"""One world through time, compiled with numba: its robots moved one by one, and every moment kept and checked."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import Model
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS, ZERO, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.simd import TILE, use_wide_registers
from d4orm_env.engine.stepping import PICK, dispatch, docking_of, make_stepper, models_key
from d4orm_env.engine.tiles import TeamBoxes, measure_goal_distance
from d4orm_env.engine.world_tiles import WorldArrays, check_contacts, load

RollOut: TypeAlias = Kernel[[ProblemArrays, WorldArrays, FloatArray, NDArray[np.uint64], TeamBoxes], None]
"""A kernel of :func:`roll_out_kernel`."""


def _mover(model: Model) -> Callable[..., None]:
    """The compiled step of one robot of this model from the moment before ``t`` to that one.

    The same operations as of a tile of worlds, which would be idle but for one.
    """
    move, dock = make_stepper(model)
    limit_control, pick_u = inlined(model.functions.limit_control), PICK[model.control_size]
    n, m, d, num_limits = model.state_size, model.control_size, model.dimension, len(model.limit_names)
    no_control = (ZERO,) * m

    @compiled
    def run(arrays: ProblemArrays, moments: WorldArrays, t: Whole, k: Whole) -> None:
        dt, docking = arrays.time_step, docking_of(arrays, k)
        h = transition.TimeStep(dt[0], dt[1], dt[2], dt[3])
        limits, goal = to_fixed_tuple(arrays.limits[k], num_limits), to_fixed_tuple(moments.goal[0, k], d)
        at_rest = transition.absorbed(moments.arrived[t - 1, k], arrays.docks)
        u = limit_control(to_fixed_tuple(moments.control[t, k], m), limits, OPS)
        u = pick_u(at_rest, no_control, u)
        x = move(at_rest, to_fixed_tuple(moments.state[t - 1, k], n), u, limits, h)
        x, _, moments.arrived[t, k] = dock(at_rest, x, u, limits, goal, docking)
        for i in range(m):
            moments.control[t, k, i] = u[i]
        for i in range(n):
            moments.state[t, k, i] = x[i]

    return run


@cache
def roll_out_kernel(names: tuple[str, ...]) -> RollOut:
    """A kernel that steps one world through the rows of ``moments.control``, keeping every moment.

    ``moments`` is a :class:`WorldArrays` of ``H+1`` rows and the goals of all, of which the first is the start and has
    no control. The motion comes first; then 64 moments at a time are checked, as if they were worlds, as far as there
    are rewards. ``w`` is zero, ``(K STRIDE + P TILE,)`` with ``P`` rows of poses, and ``near`` ``(K, 3)``: see
    :mod:`~d4orm_env.engine.tiles`; ``boxes`` are of :func:`~d4orm_env.engine.tiles.allocate_boxes`.
    """
    move_robot = dispatch({name: _mover(MODELS[name]) for name in names})

    @cached_kernel(variant="_".join(names), key=models_key(names), **WITHOUT_ARRAYS)
    def roll_out(
        arrays: ProblemArrays, moments: WorldArrays, w: FloatArray, near: NDArray[np.uint64], boxes: TeamBoxes
    ) -> None:
        use_wide_registers()
        arrays, moments = borrow(arrays), borrow(moments)
        num_robots, dimension = arrays.goal.shape
        state, arrived = moments.state, moments.arrived
        for t in range(1, state.shape[0]):
            # Loops, because numba takes seconds to compile assignments of slices.
            idle = arrays.docks
            for k in range(num_robots):
                for i in range(state.shape[2]):
                    state[t, k, i] = state[t - 1, k, i]
                arrived[t, k] = arrived[t - 1, k]
                idle &= arrived[t, k]
                for i in range(moments.control.shape[2]):
                    idle &= moments.control[t, k, i] == 0
            if idle:
                continue
            for k in range(num_robots):
                move_robot(arrays.model_codes[k], arrays, moments, t, k)
        for first in range(0, moments.rewards.shape[0], TILE):
            load(moments, first, w)
            measure_goal_distance(num_robots, dimension, w)
            check_contacts(arrays, moments, first, w, boxes, near)

    return roll_out
