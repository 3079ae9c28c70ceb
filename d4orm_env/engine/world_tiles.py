"""Many worlds of one problem in tiles: loaded, stored and checked for contacts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float32, types
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray, Whole
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.engine import obstacles
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import ONE, ZERO, compiled, inlined
from d4orm_env.engine.footprint_contacts import POSE, meets_body, refine_static
from d4orm_env.engine.simd import NOWHERE, TILE, use_wide_registers
from d4orm_env.engine.tiles import (
    ARRIVED,
    BUFFER,
    CONTROL,
    DISTANCE2,
    DYNAMIC,
    GOAL,
    OBSTACLE,
    ROBOT,
    ROWS,
    STATE,
    STRIDE,
    TeamBoxes,
    enclose_team,
    mark_pairs,
    place_team,
)
from d4orm_env.engine.types import ObservationInputs, WorldBatch
from d4orm_env.engine.units import OBSTACLES, UNIT, caller


class WorldArrays(NamedTuple):
    """``B`` worlds, or ``B`` moments of one; kernels change them in place."""

    goal: FloatArray  #: ``(B, K, d)``, or ``(1, K, d)`` for all
    inverse: FloatArray  #: ``(B, K)`` one over the start distances, or ``(1, K)``
    state: FloatArray  #: ``(B, K, n)``
    control: FloatArray  #: ``(B, K, m)``; what to do goes in, what was executed comes out
    arrived: BoolArray  #: ``(B, K)`` bool
    #: ``(B, N, 2 d + 1)`` position, velocity and radius of dynamic obstacles, or ``(0, 0, 2 d + 1)``
    bodies: FloatArray
    collided: BoolArray  #: ``(B, K)`` bool, hard contact; those known already go in, all come out
    violated: BoolArray  #: ``(B, K)`` bool, within the margin
    rewards: FloatArray  #: ``(B, K)`` of each robot where it is


class Contacts(NamedTuple):
    """Contacts of ``B`` worlds: numbers that they are looked for with, and results, as in :class:`WorldArrays`."""

    inverse: FloatArray
    bodies: FloatArray
    collided: BoolArray
    violated: BoolArray
    rewards: FloatArray


CONTACT_TYPES = types.NamedTuple(
    (float32[:, ::1], float32[:, :, ::1], boolean[:, ::1], boolean[:, ::1], float32[:, ::1]), Contacts
)
"""As numba knows them."""


@inlined
def load_world(worlds: WorldArrays | ObservationInputs | WorldBatch, b: int, s: Whole, w: FloatArray) -> None:
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
        w[o + ARRIVED * TILE] = ONE if worlds.arrived[b, k] else ZERO


@compiled
def load(worlds: WorldArrays | ObservationInputs | WorldBatch, first: int, w: FloatArray) -> None:
    """Put worlds from number ``first`` on into the lanes of a tile."""
    for s in range(min(TILE, worlds.state.shape[0] - first)):
        load_world(worlds, first + s, s, w)


@compiled
def store_world(worlds: WorldArrays | WorldBatch, b: int, s: Whole, w: FloatArray) -> None:
    """The reverse of :func:`load_world`, for what a step changes."""
    for k in range(worlds.state.shape[1]):
        o = k * STRIDE + s
        for i in range(worlds.state.shape[2]):
            worlds.state[b, k, i] = w[o + (STATE + i) * TILE]
        for i in range(worlds.control.shape[2]):
            worlds.control[b, k, i] = w[o + (CONTROL + i) * TILE]
        worlds.arrived[b, k] = w[o + ARRIVED * TILE] > ZERO


@compiled
def _meets_body(
    f: FootprintArrays | None, arrays: ProblemArrays, body: FloatArray, k: int, s: int, extra: np.float32, w: FloatArray
) -> bool:
    """Check whether robot ``k`` in lane ``s``, which the disc round it is, is within ``extra`` of a round body
    ``(2 d + 1,)``.
    """
    if f is None:
        return True
    dimension, position = arrays.goal.shape[1], k * STRIDE + STATE * TILE + s
    x, y = body[0] - w[position], body[1] - w[position + TILE]
    z = body[2] - w[position + 2 * TILE] if dimension == 3 else ZERO
    buffer, poses = w[k * STRIDE + BUFFER * TILE : k * STRIDE + ROWS * TILE], arrays.radius.shape[0] * STRIDE + s
    return meets_body(
        f, k, arrays.wall_radius[k], w, POSE * TILE, poses, f, -1, body[2 * dimension], w, x, y, z, dimension == 2,
        extra, buffer,
    )  # fmt: skip


@cached_kernel(**UNIT)
def mark_static(
    arrays: ProblemArrays, lanes: np.uint64, extra: np.float32, w: FloatArray, near: NDArray[np.uint64]
) -> None:
    """Flag every robot closer to an obstacle or the bounds than its radius plus ``extra``, in some lanes.

    A unit of its own, which is not compiled until a problem has obstacles or bounds.
    """
    use_wide_registers()
    num_robots, f = arrays.radius.shape[0], arrays.footprints
    for k in range(num_robots):
        robot = w[k * STRIDE : (k + 1) * STRIDE]
        positions, buffer = robot[STATE * TILE : CONTROL * TILE], robot[BUFFER * TILE : ROWS * TILE]
        touch = lanes & obstacles.near_obstacles(arrays, arrays.wall_radius[k] + extra, positions, buffer)
        touch = refine_static(f, arrays, k, touch, extra, positions, w, POSE * TILE, num_robots * STRIDE, buffer)
        near[k, OBSTACLE] |= touch


_call_mark_static = caller(5)


@inlined
def _mark_bodies(
    arrays: ProblemArrays, bodies: FloatArray, first: int, extra: np.float32, w: FloatArray, near: NDArray[np.uint64]
) -> None:
    """Flag every robot closer to a dynamic obstacle of its world than their radii plus ``extra``."""
    num_robots, dimension = arrays.goal.shape
    for s in range(min(TILE, bodies.shape[0] - first)):
        for k in range(num_robots):
            for i in range(bodies.shape[1]):
                if bodies[first + s, i, 2 * dimension] <= ZERO:  # absent
                    continue
                gap2 = ZERO
                for axis in range(dimension):
                    gap = bodies[first + s, i, axis] - w[k * STRIDE + (STATE + axis) * TILE + s]
                    gap2 += gap * gap
                distance = arrays.wall_radius[k] + bodies[first + s, i, 2 * dimension] + extra
                if gap2 <= distance * distance and _meets_body(
                    arrays.footprints, arrays, bodies[first + s, i], k, s, extra, w
                ):
                    near[k, DYNAMIC] |= np.uint64(1) << np.uint64(s)


@inlined
def _bit(mask: np.uint64, s: int) -> np.uint64:
    return (mask >> np.uint64(s)) & np.uint64(1)


@cached_kernel(**UNIT)
def check_contacts(
    arrays: ProblemArrays,
    units: IntArray,
    worlds: Contacts,
    first: int,
    w: FloatArray,
    boxes: TeamBoxes,
    near: NDArray[np.uint64],
) -> None:
    """Complete the flags of contacts and margin violations of the worlds of a tile, then compute the rewards.

    It calls one of ``units``, their addresses. ``boxes`` of :func:`~d4orm_env.engine.tiles.allocate_boxes` are
    overwritten, and so is ``near`` ``(K, 3)``.
    """
    use_wide_registers()
    num_robots, count = arrays.radius.shape[0], min(TILE, worlds.rewards.shape[0] - first)
    closed = obstacles.is_closed(arrays)
    place_team(arrays.footprints, num_robots, w)
    enclose_team(count, w, boxes)
    for k in range(num_robots):
        near[k, ROBOT] = near[k, OBSTACLE] = near[k, DYNAMIC] = NOWHERE
    lanes = np.uint64(0xFFFFFFFFFFFFFFFF) >> np.uint64(TILE - count)  # there are no worlds in others, only numbers
    # Whatever is in contact is within the margin too, so the second level adds to the flags of the first.
    for level in range(2):
        extra = ZERO if level == 0 else arrays.margin
        mark_pairs(arrays, lanes, extra, w, w[BUFFER * TILE : ROWS * TILE], boxes, near)
        if closed:
            _call_mark_static(units[OBSTACLES], arrays, lanes, extra, w, near)
        _mark_bodies(arrays, worlds.bodies, first, extra, w, near)
        flags = worlds.collided if level == 0 else worlds.violated
        for s in range(count):
            for k in range(num_robots):
                here = _bit(near[k, ROBOT] | near[k, OBSTACLE] | near[k, DYNAMIC], s) != NOWHERE
                flags[first + s, k] = here or worlds.collided[first + s, k]
    for s in range(count):
        own = min(first + s, worlds.inverse.shape[0] - 1)
        for k in range(num_robots):
            robots, bounds, dynamic = _bit(near[k, ROBOT], s), _bit(near[k, OBSTACLE], s), _bit(near[k, DYNAMIC], s)
            # A body that was touched within the step and is gone counts as a dynamic obstacle.
            dynamic |= np.uint64(worlds.violated[first + s, k]) ^ (robots | bounds | dynamic)
            worlds.rewards[first + s, k] = transition.step_reward(
                np.sqrt(w[k * STRIDE + DISTANCE2 * TILE + s]), worlds.inverse[own, k],
                (np.float32(robots), np.float32(bounds), np.float32(dynamic)), arrays.collision_penalty, ONE,
            )  # fmt: skip


call_check_contacts = caller(7)
"""``(address, *arguments)``: call :func:`check_contacts` as a unit."""
