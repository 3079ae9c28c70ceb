"""Kernels that step, reset and observe many worlds of one problem at once, each in the middle of its episode."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import ONE, OPTIONS, ZERO, aligned_zeros, compiled, inlined
from d4orm_env.engine.observing import ObservationSpec, allocate_sensed, observe
from d4orm_env.engine.simd import TILE, use_wide_registers
from d4orm_env.engine.stepping import models_key
from d4orm_env.engine.tiles import (
    DISTANCE2,
    DOCKED,
    STRIDE,
    RobotMover,
    measure_goal_distance,
    motion_reader,
    robot_mover,
)
from d4orm_env.engine.world_tiles import check_contacts, load, load_world, store_world

STEP, RESET, LOOK, SKIP = (np.uint8(order) for order in range(4))
"""Orders for a world: step it, put it back to its start, only observe it, or leave it alone altogether."""


class WorldBatch(NamedTuple):
    """``B`` worlds in the middle of their episodes; kernels change them in place.

    Attributes:
        start: ``(B, K, n)`` where an episode begins.
        goal: ``(B, K, d)``.
        inverse: ``(B, K)`` one over the start distances.
        state: ``(B, K, n)``.
        control: ``(B, K, m)``; what to do goes in, what was executed comes out.
        docked: ``(B, K)`` bool.
        steps: ``(B,)`` int64 steps since the reset.
        distance: ``(B, K)`` to the goals.
        collided: ``(B, K)`` bool, hard contact.
        violated: ``(B, K)`` bool, within the margin.
        rewards: ``(B, K)`` of each robot where it is now.
        reward: ``(B,)`` float64 mean of the team in the last step; zero at a reset.
        terminated: ``(B,)`` bool: all have docked.
        truncated: ``(B,)`` bool: out of time before that.
        total_reward: ``(B,)`` float64 sum over robots and steps of the episode.
        arrival: ``(B, K)`` int64 step since which a robot is at its goal, 0 for not there.
        contacts: ``(B, K)`` int64 steps in contact.
        violations: ``(B, K)`` int64 steps within the margin.
    """

    start: FloatArray
    goal: FloatArray
    inverse: FloatArray
    state: FloatArray
    control: FloatArray
    docked: BoolArray
    steps: IntArray
    distance: FloatArray
    collided: BoolArray
    violated: BoolArray
    rewards: FloatArray
    reward: Floats
    terminated: BoolArray
    truncated: BoolArray
    total_reward: Floats
    arrival: IntArray
    contacts: IntArray
    violations: IntArray

    @classmethod
    def of(cls, start: FloatArray, goal: FloatArray, inverse: FloatArray, control_size: int) -> WorldBatch:
        """Worlds with these starts and goals, all values but those still to be set by a reset."""
        worlds, robots = inverse.shape
        flags, counts = np.zeros((worlds, robots), np.bool_), np.zeros((worlds, robots), np.int64)
        return cls(
            start=np.array(start, np.float32),
            goal=np.array(goal, np.float32),
            inverse=np.array(inverse, np.float32),
            state=np.array(start, np.float32),
            control=np.zeros((worlds, robots, control_size), np.float32),
            docked=flags.copy(),
            steps=np.zeros(worlds, np.int64),
            distance=np.zeros((worlds, robots), np.float32),
            collided=flags.copy(),
            violated=flags.copy(),
            rewards=np.zeros((worlds, robots), np.float32),
            reward=np.zeros(worlds),
            terminated=np.zeros(worlds, np.bool_),
            truncated=np.zeros(worlds, np.bool_),
            total_reward=np.zeros(worlds),
            arrival=counts.copy(),
            contacts=counts.copy(),
            violations=counts.copy(),
        )


@compiled
def _restart(batch: WorldBatch, b: int) -> None:
    for k in range(batch.docked.shape[1]):
        for i in range(batch.state.shape[2]):
            batch.state[b, k, i] = batch.start[b, k, i]
        for i in range(batch.control.shape[2]):
            batch.control[b, k, i] = ZERO
        batch.docked[b, k] = False
        batch.arrival[b, k] = batch.contacts[b, k] = batch.violations[b, k] = 0
    batch.steps[b] = 0
    batch.reward[b] = batch.total_reward[b] = 0
    batch.terminated[b] = batch.truncated[b] = False


@compiled
def _restart_tile(batch: WorldBatch, orders: NDArray[np.uint8], first: int, count: int) -> tuple[bool, bool]:
    """Reset the worlds of a tile that are to be reset, and say whether any is to be stepped, or not to be skipped."""
    moving, busy = False, False
    for b in range(first, first + count):
        moving |= orders[b] == STEP
        busy |= orders[b] != SKIP
        if orders[b] == RESET:
            _restart(batch, b)
    return moving, busy


@compiled
def _tally(batch: WorldBatch, max_cycles: int, b: int) -> None:
    """Count the step that world ``b`` has just taken, and see whether its episode has ended."""
    num_robots = batch.docked.shape[1]
    batch.steps[b] += 1
    total, everybody = 0.0, True
    for k in range(num_robots):
        total += batch.rewards[b, k]
        batch.contacts[b, k] += batch.collided[b, k]
        batch.violations[b, k] += batch.violated[b, k]
        if not batch.docked[b, k]:
            batch.arrival[b, k] = 0
        elif batch.arrival[b, k] == 0:
            batch.arrival[b, k] = batch.steps[b]
        everybody &= batch.docked[b, k]
    batch.reward[b] = total / num_robots
    batch.total_reward[b] += total
    batch.terminated[b] = everybody
    batch.truncated[b] = batch.steps[b] >= max_cycles and not everybody


@inlined
def _move_tile(
    move_robot: RobotMover,
    arrays: ProblemArrays,
    batch: WorldBatch,
    orders: NDArray[np.uint8],
    first: int,
    count: int,
    w: FloatArray,
) -> None:
    """Step the worlds of a tile that are to be stepped; the others wait as if all their robots had docked."""
    num_robots = batch.docked.shape[1]
    for s in range(count):
        if orders[first + s] != STEP:
            for k in range(num_robots):
                w[k * STRIDE + DOCKED * TILE + s] = ONE
    for k in range(num_robots):
        move_robot(arrays, k, w)
    for s in range(count):
        b = first + s
        if orders[b] == STEP:
            store_world(batch, b, s, w)
        else:
            load_world(batch, b, s, w)


@cache
def advance_worlds_kernel(
    names: tuple[str, ...],
) -> Kernel[[ProblemArrays, ObservationSpec, int, NDArray[np.uint8], WorldBatch, IntArray, FloatArray], None]:
    """A kernel that steps, resets and observes worlds, each as it is ordered to.

    Args:
        names: Models that the kernel is for.
        arrays: The problem that the worlds share; its starts and goals are not looked at.
        view: Contents of an observation, a :class:`ObservationSpec`.
        max_cycles: Steps in an episode.
        orders: ``(B,)`` uint8, one of ``STEP``, ``RESET``, ``LOOK`` and ``SKIP`` for every world.
        batch: The worlds, a :class:`WorldBatch`.
        tile_range: First tile of worlds and the one after the last.
        out: ``(B, K, D)`` observations; those of skipped worlds are not written. ``(0, K, D)`` leaves them to
            :func:`observe_worlds_kernel`.
    """
    move_robot = robot_mover(names)
    read_motion = motion_reader(names)

    @cached_kernel(variant="_".join(names), key=models_key(names), **OPTIONS)
    def advance_worlds(
        arrays: ProblemArrays,
        view: ObservationSpec,
        max_cycles: int,
        orders: NDArray[np.uint8],
        batch: WorldBatch,
        tile_range: IntArray,
        out: FloatArray,
    ) -> None:
        use_wide_registers()
        num_robots, dimension = arrays.goal.shape
        w = aligned_zeros(num_robots * STRIDE)
        near = np.empty((num_robots, 2), np.uint64)
        sensed = allocate_sensed(num_robots, 0, dimension, view.num_neighbors, view.num_obstacles)
        for index in range(tile_range[0], tile_range[1]):
            first = index * TILE
            count = min(TILE, orders.shape[0] - first)
            moving, busy = _restart_tile(batch, orders, first, count)
            if not busy:
                continue
            load(batch, first, w)
            measure_goal_distance(num_robots, dimension, w)
            if moving:
                _move_tile(move_robot, arrays, batch, orders, first, count, w)
            check_contacts(arrays, batch, first, w, near)
            for b in range(first, first + count):
                if orders[b] == SKIP:
                    continue
                if orders[b] == STEP:
                    _tally(batch, max_cycles, b)
                for k in range(num_robots):
                    batch.distance[b, k] = np.sqrt(w[k * STRIDE + DISTANCE2 * TILE + b - first])
                if out.shape[0] > 0:
                    time_left = np.float32(max(0.0, 1.0 - batch.steps[b] / max_cycles))
                    observe(read_motion, arrays, batch, b, time_left, w, view.bounds, sensed, out[b])

    return advance_worlds
