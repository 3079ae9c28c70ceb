"""Kernels that step and observe many worlds of one problem at once, compiled with numba.

The worlds share the team, the obstacles and the bounds; each has its own goals, state and clock. A single environment
is a batch of one.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import COMMON, names_of_codes
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS
from d4orm_env.engine.episodes import advance_worlds_kernel
from d4orm_env.engine.observing import ObservationSpec, observe_worlds_kernel
from d4orm_env.engine.simd import TILE, use_wide_registers
from d4orm_env.engine.stepping import models_key, models_of_kernel
from d4orm_env.engine.tiles import measure_goal_distance, robot_mover
from d4orm_env.engine.types import ObservationInputs, WorldBatch
from d4orm_env.engine.world_tiles import WorldArrays, check_contacts, load, load_world, store_world

RollOut: TypeAlias = Kernel[[ProblemArrays, WorldArrays, FloatArray, NDArray[np.uint64], FloatArray], None]
"""A kernel of :func:`roll_out_kernel`."""


@cache
def roll_out_kernel(names: tuple[str, ...]) -> RollOut:
    """A kernel that steps one world through the rows of ``moments.control``, keeping every moment.

    ``moments`` is a :class:`WorldArrays` of ``H+1`` rows, of which the first is the start and has no control. The
    motion comes first; then 64 moments at a time are checked, as if they were worlds, as far as there are rewards.
    ``w`` is zero, ``(K STRIDE + P TILE,)`` with ``P`` rows of poses, and ``near`` ``(K, 3)``: see
    :mod:`~d4orm_env.engine.tiles`; ``boxes`` are of :func:`~d4orm_env.engine.world_tiles.allocate_boxes`.
    """
    move_robot = robot_mover(names)

    @cached_kernel(variant="_".join(names), key=models_key(names), **WITHOUT_ARRAYS)
    def roll_out(
        arrays: ProblemArrays, moments: WorldArrays, w: FloatArray, near: NDArray[np.uint64], boxes: FloatArray
    ) -> None:
        use_wide_registers()
        arrays, moments = borrow(arrays), borrow(moments)
        num_robots, dimension = arrays.goal.shape
        lane = np.int64(0)  # a literal zero would compile what it is passed to once more
        state, docked = moments.state, moments.docked
        for t in range(1, state.shape[0]):
            # Loops, because numba takes seconds to compile assignments of slices.
            idle = arrays.docks
            for k in range(num_robots):
                for i in range(state.shape[2]):
                    state[t, k, i] = state[t - 1, k, i]
                docked[t, k] = docked[t - 1, k]
                idle &= docked[t, k]
                for i in range(moments.control.shape[2]):
                    idle &= moments.control[t, k, i] == 0
            if idle:
                continue
            load_world(moments, t, lane, w)
            for k in range(num_robots):
                move_robot(arrays, k, w)
            store_world(moments, t, lane, w)
        for first in range(0, moments.rewards.shape[0], TILE):
            load(moments, first, w)
            measure_goal_distance(num_robots, dimension, w)
            check_contacts(arrays, moments, first, w, boxes, near)

    return roll_out


class WorldKernels(NamedTuple):
    """The kernels that step and observe teams of some models."""

    roll_out: RollOut
    observe_worlds: Kernel[[ProblemArrays, ObservationInputs, ObservationSpec, IntArray, FloatArray], None]
    advance_worlds: Kernel[
        [ProblemArrays, ObservationSpec, int, NDArray[np.uint8], WorldBatch, IntArray, FloatArray], None
    ]


def world_kernels(models: tuple[str, ...]) -> WorldKernels:
    """Kernels for a team of these models. Rolling out, which a first plan waits for, has them by models as sampling;
    the others are the same for all mixtures of common models.
    """
    own = models_of_kernel(models)
    names = COMMON if set(own) <= set(COMMON) else own
    return WorldKernels(roll_out_kernel(own), observe_worlds_kernel(names), advance_worlds_kernel(names))


@lru_cache(maxsize=256)
def kernels_of_codes(codes: bytes) -> WorldKernels:
    """:func:`world_kernels` by the bytes of ``model_codes``.

    Raises:
        ValueError: If a code is no model's.
    """
    return world_kernels(names_of_codes(np.frombuffer(codes, np.int32)))
