"""Kernels that step and observe many worlds of one problem at once, compiled with numba.

The worlds share the team, the obstacles and the bounds; each has its own goals, state and clock. A single environment
is a batch of one.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import NamedTuple

import numba
import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from d4orm_env.core import collision, observation, reward, robot_model, transition
from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray, Whole
from d4orm_env.core.dynamics import COMMON, names_of_codes
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine import lanes, obstacles, tiles
from d4orm_env.engine.base import Sight
from d4orm_env.engine.caching import Kernel, cached_kernel, fingerprint
from d4orm_env.engine.lanes import TILE, use_wide_registers
from d4orm_env.engine.tiles import (
    CONTROL,
    DISTANCE2,
    DOCKED,
    GOAL,
    INLINED,
    NOWHERE,
    OBSTACLE,
    ONE,
    OPTIONS,
    ROBOT,
    ROWS,
    SPARE,
    STATE,
    STRIDE,
    ZERO,
    MotionReader,
    RobotMover,
    compiled,
    inlined,
    models_key,
    models_of_kernel,
    motion_reader,
    robot_mover,
)

SOURCES = fingerprint((robot_model, transition, collision, reward, observation, lanes, obstacles, tiles))

for _function in (
    observation.observe_robot,
    observation._see_itself,
    observation._see_robots,
    observation._see_obstacles,
    observation.insert_nearest,
    observation._comes_before,
    observation._find_nearest_robots,
    observation._find_nearest_obstacles,
    observation._list_of,
    observation._point_to,
    observation._distance_to_box,
    observation._gap_to_triangle,
):
    register_jitable(**INLINED)(_function)


class Worlds(NamedTuple):
    """``B`` worlds, or ``B`` moments of one; kernels change them in place.

    Attributes:
        goal: ``(B, K, d)``, or ``(1, K, d)`` for all.
        inverse: ``(B, K)`` one over the start distances, or ``(1, K)``.
        state: ``(B, K, n)``.
        control: ``(B, K, m)``; what to do goes in, what was executed comes out.
        docked: ``(B, K)`` bool.
        collided: ``(B, K)`` bool, hard contact.
        violated: ``(B, K)`` bool, within the margin.
        rewards: ``(B, K)`` of each robot where it stands.
    """

    goal: FloatArray
    inverse: FloatArray
    state: FloatArray
    control: FloatArray
    docked: BoolArray
    collided: BoolArray
    violated: BoolArray
    rewards: FloatArray


# ``worlds`` is a Worlds or has its attributes among others, as a WorldBatch does.


@inlined
def _load_world(worlds: Worlds | Sight | WorldBatch, b: int, s: Whole, w: FloatArray) -> None:
    """Put world ``b`` into lane ``s`` of a tile."""
    own = min(b, worlds.goal.shape[0] - 1)
    for k in range(worlds.state.shape[1]):
        o = k * STRIDE + s
        for i in range(worlds.state.shape[2]):
            w[o + (STATE + i) * TILE] = worlds.state[b, k, i]
        for i in range(worlds.control.shape[2]):
            w[o + (CONTROL + i) * TILE] = worlds.control[b, k, i]
        for axis in range(worlds.goal.shape[2]):
            w[o + (GOAL + axis) * TILE] = worlds.goal[own, k, axis]
        w[o + DOCKED * TILE] = ONE if worlds.docked[b, k] else ZERO


@compiled
def _load(worlds: Worlds | Sight | WorldBatch, first: int, w: FloatArray) -> None:
    """Put worlds from number ``first`` on into the lanes of a tile."""
    for s in range(min(TILE, worlds.state.shape[0] - first)):
        _load_world(worlds, first + s, s, w)


@compiled
def _store_world(worlds: Worlds | WorldBatch, b: int, s: Whole, w: FloatArray) -> None:
    """The reverse of :func:`_load_world`, for what a step changes."""
    for k in range(worlds.state.shape[1]):
        o = k * STRIDE + s
        for i in range(worlds.state.shape[2]):
            worlds.state[b, k, i] = w[o + (STATE + i) * TILE]
        for i in range(worlds.control.shape[2]):
            worlds.control[b, k, i] = w[o + (CONTROL + i) * TILE]
        worlds.docked[b, k] = w[o + DOCKED * TILE] > ZERO


@inlined
def _bit(mask: np.uint64, s: int) -> np.uint64:
    return (mask >> np.uint64(s)) & np.uint64(1)


@compiled
def _judge(
    arrays: ProblemArrays, worlds: Worlds | WorldBatch, first: int, w: FloatArray, near: NDArray[np.uint64]
) -> None:
    """Flag contacts and margin violations of the worlds of a tile, and compute rewards."""
    num_robots = arrays.radius.shape[0]
    for k in range(num_robots):
        near[k, ROBOT] = near[k, OBSTACLE] = NOWHERE
    # Whatever is in contact is within the margin too, so the second level adds to the flags of the first.
    for level in range(2):
        extra = ZERO if level == 0 else arrays.margin
        flags = worlds.collided if level == 0 else worlds.violated
        tiles.mark_pairs(arrays, extra, w, near)
        for k in range(num_robots):
            robot = w[k * STRIDE : (k + 1) * STRIDE]
            places, spare = robot[STATE * TILE : CONTROL * TILE], robot[SPARE * TILE : ROWS * TILE]
            near[k, OBSTACLE] |= obstacles.near_obstacles(arrays, arrays.radius[k] + extra, places, spare)
        for s in range(min(TILE, flags.shape[0] - first)):
            for k in range(num_robots):
                flags[first + s, k] = _bit(near[k, ROBOT] | near[k, OBSTACLE], s) != NOWHERE
    for s in range(min(TILE, worlds.rewards.shape[0] - first)):
        own = min(first + s, worlds.inverse.shape[0] - 1)
        for k in range(num_robots):
            worlds.rewards[first + s, k] = reward.step_reward(
                np.sqrt(w[k * STRIDE + DISTANCE2 * TILE + s]), worlds.inverse[own, k],
                np.float32(_bit(near[k, ROBOT], s)), np.float32(_bit(near[k, OBSTACLE], s)), ONE,
            )  # fmt: skip


@cache
def roll_out_kernel(names: tuple[str, ...]) -> Kernel[[ProblemArrays, Worlds], None]:
    """A kernel that steps one world through the rows of ``moments.control``, keeping every moment.

    ``moments`` is a :class:`Worlds` of ``H+1`` rows, of which the first is the start and has no control. The motion
    comes first; then 64 moments at a time are judged, as if they were worlds.
    """
    move_robot = robot_mover(names)

    @cached_kernel(models_key(SOURCES, names), variant="_".join(names), **OPTIONS)
    def roll_out(arrays: ProblemArrays, moments: Worlds) -> None:
        use_wide_registers()
        num_robots, dimension = arrays.goal.shape
        w = tiles.aligned_zeros(num_robots * STRIDE)
        near = np.empty((num_robots, 2), np.uint64)
        lane = np.int64(0)  # a literal zero would compile what it is passed to once more
        state, docked = moments.state, moments.docked
        for t in range(1, state.shape[0]):
            # Loops, because numba takes seconds to compile assignments of slices.
            for k in range(num_robots):
                for i in range(state.shape[2]):
                    state[t, k, i] = state[t - 1, k, i]
                docked[t, k] = docked[t - 1, k]
            _load_world(moments, t, lane, w)
            for k in range(num_robots):
                move_robot(arrays, k, w)
            _store_world(moments, t, lane, w)
        for first in range(0, state.shape[0], TILE):
            _load(moments, first, w)
            tiles.measure_goal_distance(num_robots, dimension, w)
            _judge(arrays, moments, first, w, near)

    return roll_out


@numba.njit(nogil=True, **OPTIONS)
def _allocate_sensed(
    num_robots: int, num_bodies: int, dimension: int, num_neighbors: int, num_obstacles: int
) -> observation.Sensed:
    everybody = num_robots + num_bodies
    return observation.Sensed(
        np.empty((everybody, dimension), np.float32), np.empty((everybody, dimension), np.float32),
        np.empty(everybody, np.float32), np.empty((num_robots, 2), np.float32), np.empty(num_robots, np.float32),
        np.empty((num_neighbors, 2), np.float32), np.empty((num_obstacles, 2), np.float32),
    )  # fmt: skip


class View(NamedTuple):
    """What an observation is made of, see :class:`~d4orm_env.core.observation_layout.ObservationLayout`.

    Attributes:
        bounds: ``(2, D)`` lowest and highest observation.
        num_neighbors: Robots in it.
        num_obstacles: Obstacles in it.
    """

    bounds: FloatArray
    num_neighbors: int
    num_obstacles: int


@compiled
def _sense_bodies(bodies: FloatArray, num_robots: int, sensed: observation.Sensed) -> None:
    """Put ``bodies`` ``(N, 2 d + 1)``, position, velocity and radius, behind the robots; no radius is an unseen one."""
    dimension = (bodies.shape[1] - 1) // 2
    for body in range(bodies.shape[0]):
        sensed.radius[num_robots + body] = bodies[body, 2 * dimension]
        for axis in range(dimension):
            unseen = bodies[body, 2 * dimension] <= ZERO
            sensed.position[num_robots + body, axis] = np.float32(np.inf) if unseen else bodies[body, axis]
            sensed.velocity[num_robots + body, axis] = bodies[body, dimension + axis]


@inlined
def _observe(
    read_motion: MotionReader,
    arrays: ProblemArrays,
    worlds: Worlds | Sight | WorldBatch,
    b: int,
    time_left: np.float32,
    w: FloatArray,
    bounds: FloatArray,
    sensed: observation.Sensed,
    out: FloatArray,
) -> None:
    """Fill ``out`` ``(K, D)`` with what the robots of world ``b`` of a loaded tile see, inside ``bounds``."""
    (num_robots, dimension), s = arrays.goal.shape, b % TILE
    for k in range(num_robots):
        for axis in range(dimension):
            sensed.position[k, axis] = w[k * STRIDE + (STATE + axis) * TILE + s]
        read_motion(arrays, k, s, w, sensed.velocity[k], sensed.heading[k])
        sensed.arrived[k] = ONE if worlds.docked[b, k] else ZERO
        for axis in range(dimension):
            if transition.stands(worlds.docked[b, k], arrays.docks):
                sensed.velocity[k, axis] = ZERO
        sensed.radius[k] = arrays.radius[k]
    for k in range(num_robots):
        row = out[k]
        observation.observe_robot(k, arrays, worlds.goal[b], sensed, time_left, row)
        for i in range(row.shape[0]):
            value = row[i]
            value = value if value > bounds[0, i] else bounds[0, i]
            row[i] = value if value < bounds[1, i] else bounds[1, i]


@cache
def observe_worlds_kernel(
    names: tuple[str, ...],
) -> Kernel[[ProblemArrays, Sight, View, IntArray, FloatArray], None]:
    """A kernel that fills ``out`` ``(B, K, D)`` with what every robot of every world sees.

    Args:
        names: Models that the kernel is for.
        arrays: The problem that the worlds share; its starts and goals are not looked at.
        sight: What there is to see, a :class:`~d4orm_env.engine.base.Sight`.
        view: What an observation is made of, a :class:`View`.
        tile_range: First tile of worlds and the one after the last.
    """
    read_motion = motion_reader(names)

    @cached_kernel(models_key(SOURCES, names), variant="_".join(names), **OPTIONS)
    def observe_worlds(arrays: ProblemArrays, sight: Sight, view: View, tile_range: IntArray, out: FloatArray) -> None:
        num_robots, dimension = arrays.goal.shape
        w = tiles.aligned_zeros(num_robots * STRIDE)
        sensed = _allocate_sensed(num_robots, sight.bodies.shape[1], dimension, view.num_neighbors, view.num_obstacles)
        for index in range(tile_range[0], tile_range[1]):
            first = index * TILE
            _load(sight, first, w)
            for b in range(first, min(first + TILE, sight.state.shape[0])):
                _sense_bodies(sight.bodies[b], num_robots, sensed)
                _observe(read_motion, arrays, sight, b, sight.time_left[b], w, view.bounds, sensed, out[b])

    return observe_worlds


STEP, RESET, LOOK, SKIP = (np.uint8(order) for order in range(4))
"""What to do with a world: step it, put it back to its start, only observe it, or leave it alone altogether."""


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
        rewards: ``(B, K)`` of each robot where it stands now.
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
            _store_world(batch, b, s, w)
        else:
            _load_world(batch, b, s, w)


@cache
def advance_worlds_kernel(
    names: tuple[str, ...],
) -> Kernel[[ProblemArrays, View, int, NDArray[np.uint8], WorldBatch, IntArray, FloatArray], None]:
    """A kernel that steps, resets and observes worlds, each as it is ordered to.

    Args:
        names: Models that the kernel is for.
        arrays: The problem that the worlds share; its starts and goals are not looked at.
        view: What an observation is made of, a :class:`View`.
        max_cycles: Steps in an episode.
        orders: ``(B,)`` uint8, one of ``STEP``, ``RESET``, ``LOOK`` and ``SKIP`` for every world.
        batch: The worlds, a :class:`WorldBatch`.
        tile_range: First tile of worlds and the one after the last.
        out: ``(B, K, D)`` observations; those of skipped worlds are not written. ``(0, K, D)`` leaves them to
            :func:`observe_worlds_kernel`.
    """
    move_robot = robot_mover(names)
    read_motion = motion_reader(names)

    @cached_kernel(models_key(SOURCES, names), variant="_".join(names), **OPTIONS)
    def advance_worlds(
        arrays: ProblemArrays,
        view: View,
        max_cycles: int,
        orders: NDArray[np.uint8],
        batch: WorldBatch,
        tile_range: IntArray,
        out: FloatArray,
    ) -> None:
        use_wide_registers()
        num_robots, dimension = arrays.goal.shape
        w = tiles.aligned_zeros(num_robots * STRIDE)
        near = np.empty((num_robots, 2), np.uint64)
        sensed = _allocate_sensed(num_robots, 0, dimension, view.num_neighbors, view.num_obstacles)
        for index in range(tile_range[0], tile_range[1]):
            first = index * TILE
            count = min(TILE, orders.shape[0] - first)
            moving, busy = _restart_tile(batch, orders, first, count)
            if not busy:
                continue
            _load(batch, first, w)
            tiles.measure_goal_distance(num_robots, dimension, w)
            if moving:
                _move_tile(move_robot, arrays, batch, orders, first, count, w)
            _judge(arrays, batch, first, w, near)
            for b in range(first, first + count):
                if orders[b] == SKIP:
                    continue
                if orders[b] == STEP:
                    _tally(batch, max_cycles, b)
                for k in range(num_robots):
                    batch.distance[b, k] = np.sqrt(w[k * STRIDE + DISTANCE2 * TILE + b - first])
                if out.shape[0] > 0:
                    time_left = np.float32(max(0.0, 1.0 - batch.steps[b] / max_cycles))
                    _observe(read_motion, arrays, batch, b, time_left, w, view.bounds, sensed, out[b])

    return advance_worlds


class WorldKernels(NamedTuple):
    """The kernels that step and observe teams of some models."""

    roll_out: Kernel[[ProblemArrays, Worlds], None]
    observe_worlds: Kernel[[ProblemArrays, Sight, View, IntArray, FloatArray], None]
    advance_worlds: Kernel[[ProblemArrays, View, int, NDArray[np.uint8], WorldBatch, IntArray, FloatArray], None]


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
