"""Kernels that step worlds of one problem: many at once, each in the middle of its episode, or one through time."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, IntArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import Model
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import (
    ONE,
    WITHOUT_ARRAYS,
    ZERO,
    compiled,
    inlined,
    to_fixed_tuple,
)
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.observing import (
    ObservationSpec,
    WorldScratch,
    call_observe_world,
    read_motion,
    sense_robots,
)
from d4orm_env.engine.simd import TILE, use_wide_registers
from d4orm_env.engine.stepping import PICK, dispatch, docking_of, make_stepper, models_key
from d4orm_env.engine.tiles import (
    ARRIVED,
    DISTANCE2,
    STRIDE,
    TeamBoxes,
    call_robot,
    measure_goal_distance,
)
from d4orm_env.engine.types import MOVED, RESET, SKIP, STEP, WorldBatch
from d4orm_env.engine.units import CONTACTS, OBSERVATION, ROBOTS
from d4orm_env.engine.world_tiles import Contacts, WorldArrays, call_check_contacts, load, load_world, store_world


@compiled
def _restart(batch: WorldBatch, b: int) -> None:
    for k in range(batch.arrived.shape[1]):
        for i in range(batch.state.shape[2]):
            batch.state[b, k, i] = batch.start[b, k, i]
        for i in range(batch.control.shape[2]):
            batch.control[b, k, i] = ZERO
        batch.arrived[b, k] = False
        batch.arrival[b, k] = batch.contacts[b, k] = batch.violations[b, k] = 0
    batch.steps[b] = 0
    batch.reward[b] = batch.total_reward[b] = 0
    batch.terminated[b] = batch.truncated[b] = False


@compiled
def _prepare_tile(batch: WorldBatch, orders: NDArray[np.uint8], first: int, count: int) -> tuple[bool, bool]:
    """Reset the worlds of a tile that are to be reset, and say whether any is to be stepped, or not to be skipped."""
    moving, busy = False, False
    for b in range(first, first + count):
        moving |= orders[b] == STEP
        busy |= orders[b] != SKIP
        if orders[b] == RESET:
            _restart(batch, b)
        for k in range(batch.collided.shape[1]):
            batch.collided[b, k] &= orders[b] == MOVED or orders[b] == SKIP
    return moving, busy


@compiled
def _tally(batch: WorldBatch, max_cycles: int, b: int) -> None:
    """Count the step that world ``b`` has just taken, and see whether its episode has ended."""
    num_robots = batch.arrived.shape[1]
    batch.steps[b] += 1
    total, all_arrived = 0.0, True
    for k in range(num_robots):
        total += batch.rewards[b, k]
        batch.contacts[b, k] += batch.collided[b, k]
        batch.violations[b, k] += batch.violated[b, k]
        if not batch.arrived[b, k]:
            batch.arrival[b, k] = 0
        elif batch.arrival[b, k] == 0:
            batch.arrival[b, k] = batch.steps[b]
        all_arrived &= batch.arrived[b, k]
    batch.reward[b] = total / num_robots
    batch.total_reward[b] += total
    batch.terminated[b] = all_arrived
    batch.truncated[b] = batch.steps[b] >= max_cycles and not all_arrived


@inlined
def _close_step(batch: WorldBatch, order: np.uint8, max_cycles: int, b: int, s: int, w: FloatArray) -> None:
    """Count a step of world ``b``, if it was moved, and note how far its robots are from their goals."""
    if order <= MOVED:
        _tally(batch, max_cycles, b)
    for k in range(batch.arrived.shape[1]):
        batch.distance[b, k] = np.sqrt(w[k * STRIDE + DISTANCE2 * TILE + s])


@inlined
def _move_tile(
    arrays: ProblemArrays,
    batch: WorldBatch,
    orders: NDArray[np.uint8],
    first: int,
    count: int,
    w: FloatArray,
    motion: FloatArray,
    units: IntArray,
) -> None:
    """Step the worlds of a tile that are to be stepped; the others wait as if all their robots had docked."""
    num_robots = batch.arrived.shape[1]
    for s in range(count):
        if orders[first + s] != STEP:
            for k in range(num_robots):
                w[k * STRIDE + ARRIVED * TILE + s] = ONE
    for k in range(num_robots):
        call_robot(units[ROBOTS + k], arrays, k, 0, w, motion)
    for s in range(count):
        b = first + s
        if orders[b] == STEP:
            store_world(batch, b, s, w)
        else:
            load_world(batch, b, s, w)


@compiled
def _time_left(batch: WorldBatch, max_cycles: int, b: int) -> np.float32:
    return np.float32(max(0.0, 1.0 - batch.steps[b] / max_cycles))


@cached_kernel(**WITHOUT_ARRAYS)
def advance_worlds(
    arrays: ProblemArrays,
    view: ObservationSpec,
    max_cycles: int,
    orders: NDArray[np.uint8],
    batch: WorldBatch,
    tile_range: IntArray,
    out: FloatArray,
    scratch: WorldScratch,
    units: IntArray,
) -> None:
    """Step, reset and observe worlds, each as it is ordered to.

    Arguments are those of :meth:`~d4orm_env.engine.cpu.CpuEngine.advance`; ``tile_range`` is the first tile of worlds
    and the one after the last, ``units`` are the addresses of units. Starts and goals of ``arrays`` are not looked at.
    """
    use_wide_registers()
    num_robots, dimension = arrays.goal.shape
    arrays, view, batch = borrow(arrays), borrow(view), borrow(batch)
    w, motion, sensed = scratch.w, scratch.motion, scratch.sensed
    contacts = Contacts(batch.inverse, batch.bodies, batch.collided, batch.violated, batch.rewards)
    for index in range(tile_range[0], tile_range[1]):
        first, count = index * TILE, min(TILE, orders.shape[0] - index * TILE)
        moving, busy = _prepare_tile(batch, orders, first, count)
        if not busy:
            continue
        load(batch, first, w)
        measure_goal_distance(num_robots, dimension, w)
        if moving:
            _move_tile(arrays, batch, orders, first, count, w, motion, units)
        call_check_contacts(units[CONTACTS], arrays, units, contacts, first, w, scratch.boxes, scratch.near)
        if out.shape[0] > 0:
            read_motion(arrays, units, count, w, motion)
        for b in range(first, first + count):
            if orders[b] == SKIP:
                continue
            _close_step(batch, orders[b], max_cycles, b, b - first, w)
            if out.shape[0] > 0:
                sense_robots(arrays, batch.arrived[b], b - first, w, motion, sensed)
                time_left = _time_left(batch, max_cycles, b)
                call_observe_world(units[OBSERVATION], arrays, batch.goal[b], time_left, view, sensed, out[b], units)


RollOut: TypeAlias = Kernel[
    [ProblemArrays, WorldArrays, bool, IntArray, FloatArray, NDArray[np.uint64], TeamBoxes, IntArray], None
]
"""A kernel of :func:`roll_out_kernel`."""


def _stepper(model: Model) -> Callable[..., None]:
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
    no control. The motion comes first, if it ``moves``; then 64 moments at a time are checked, as if they were worlds:
    ``tiles`` ``(2,)`` are the first 64 and those after the last. ``w`` is zero, ``(K STRIDE + P TILE,)`` with ``P``
    rows of poses, and ``near`` ``(K, 3)``: see :mod:`~d4orm_env.engine.tiles`; ``boxes`` are of
    :func:`~d4orm_env.engine.tiles.allocate_boxes`, and ``units`` the addresses of units.
    """
    move_robot = dispatch({name: _stepper(MODELS[name]) for name in names})

    @cached_kernel(variant="_".join(names), key=models_key(names), **WITHOUT_ARRAYS)
    def roll_out(
        arrays: ProblemArrays, moments: WorldArrays, moves: bool, tiles: IntArray, w: FloatArray,
        near: NDArray[np.uint64], boxes: TeamBoxes, units: IntArray,
    ) -> None:  # fmt: skip
        use_wide_registers()
        arrays, moments = borrow(arrays), borrow(moments)
        num_robots, dimension = arrays.goal.shape
        state, arrived = moments.state, moments.arrived
        for t in range(1, state.shape[0] if moves else 1):
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
        contacts = Contacts(moments.inverse, moments.bodies, moments.collided, moments.violated, moments.rewards)
        for tile in range(tiles[0], tiles[1]):
            load(moments, tile * TILE, w)
            measure_goal_distance(num_robots, dimension, w)
            call_check_contacts(units[CONTACTS], arrays, units, contacts, tile * TILE, w, boxes, near)

    return roll_out
