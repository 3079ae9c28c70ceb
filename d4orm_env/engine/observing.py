"""Kernels that observe many worlds of one problem at once, and communication links between robots."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numba
import numpy as np
from numba.extending import register_jitable

from d4orm_env.core import observation
from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import INLINED, ONE, OPTIONS, ZERO, aligned_zeros, compiled, inlined
from d4orm_env.engine.ray_shapes import is_blocked
from d4orm_env.engine.simd import TILE
from d4orm_env.engine.stepping import models_key
from d4orm_env.engine.tiles import STATE, STRIDE, MotionReader, motion_reader
from d4orm_env.engine.types import ObservationInputs, WorldBatch
from d4orm_env.engine.world_tiles import WorldArrays, load

for _function in (
    observation.observe_robot,
    observation._see_itself,
    observation._see_goal_heading,
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


class ObservationSpec(NamedTuple):
    """Contents of an observation, see :class:`~d4orm_env.core.observation_layout.ObservationLayout`."""

    bounds: FloatArray  #: ``(2, D)`` lowest and highest observation
    num_neighbors: int  #: Robots in it
    num_obstacles: int  #: Obstacles in it
    num_headings: int  #: Bodies of a robot whose headings are needed for it, one at least
    squared_range: np.float32  #: Square of the distance beyond which robots are not observed [m²]
    #: True if those behind obstacles are not observed either, else ``None``, which leaves rays out of a kernel
    line_of_sight: bool | None


@numba.njit(nogil=True, **OPTIONS)
def allocate_sensed(num_robots: int, num_bodies: int, dimension: int, view: ObservationSpec) -> observation.Sensed:
    count = num_robots + num_bodies
    return observation.Sensed(
        np.empty((count, dimension), np.float32), np.empty((count, dimension), np.float32),
        np.empty(count, np.float32), np.empty((num_robots, 2 * view.num_headings), np.float32),
        np.empty(num_robots, np.float32),
        np.zeros(count, np.bool_), np.empty((5, 1), np.float32),
        np.empty((view.num_neighbors, 2), np.float32), np.empty((view.num_obstacles, 2), np.float32),
    )  # fmt: skip


@compiled
def _hide(
    position: FloatArray, positions: FloatArray, boxes: FloatArray, triangles: FloatArray, squared_range: np.float32,
    line_of_sight: bool | None, ray: FloatArray, hidden: BoolArray,
) -> None:  # fmt: skip
    """Mark robots that are not observed from a position: beyond a range, and behind obstacles unless it is ``None``."""
    for other in range(hidden.shape[0]):
        gap2 = ZERO
        for axis in range(position.shape[0]):
            gap = positions[other, axis] - position[axis]
            gap2 += gap * gap
        hidden[other] = gap2 > squared_range
        if line_of_sight is not None:
            hidden[other] = hidden[other] or is_blocked(position, positions[other], boxes, triangles, ray)


@cached_kernel(**OPTIONS)
def _hide_each(
    positions: FloatArray, boxes: FloatArray, triangles: FloatArray, squared_range: np.float32, sight: bool | None,
    ray: FloatArray, hidden: BoolArray,
) -> None:  # fmt: skip
    for k in range(len(positions)):
        _hide(positions[k], positions, boxes, triangles, squared_range, sight, ray, hidden[k])


def communication_links(
    problem: Problem, positions: FloatArray, communication_range: float | None, line_of_sight: bool
) -> BoolArray:
    """``(K, K)`` bool: robot ``k`` at ``positions`` ``(K, d)`` knows of another one, as observations have it.

    It knows none beyond ``communication_range`` [m], ``None`` for no limit, and with ``line_of_sight`` none behind the
    problem's obstacles either.
    """
    hidden = np.empty((len(positions), len(positions)), np.bool_)
    square = np.float32(np.inf if communication_range is None else communication_range**2)
    rows, ray = np.ascontiguousarray(positions, np.float32), np.empty((5, 1), np.float32)
    _hide_each(rows, problem.arrays.boxes, problem.arrays.triangles, square, line_of_sight or None, ray, hidden)
    return ~hidden & ~np.eye(len(hidden), dtype=np.bool_)


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
def observe(
    read_motion: MotionReader,
    arrays: ProblemArrays,
    worlds: WorldArrays | ObservationInputs | WorldBatch,
    b: int,
    time_left: np.float32,
    w: FloatArray,
    view: ObservationSpec,
    sensed: observation.Sensed,
    out: FloatArray,
) -> None:
    """Fill ``out`` ``(K, D)`` with what the robots of world ``b`` of a loaded tile see, inside the view's bounds."""
    (num_robots, dimension), s, bounds = arrays.goal.shape, b % TILE, view.bounds
    for k in range(num_robots):
        for axis in range(dimension):
            sensed.position[k, axis] = w[k * STRIDE + (STATE + axis) * TILE + s]
        read_motion(arrays, k, s, w, sensed.velocity[k], sensed.heading[k])
        sensed.arrived[k] = ONE if worlds.arrived[b, k] else ZERO
        for axis in range(dimension):
            if transition.absorbed(worlds.arrived[b, k], arrays.docks):
                sensed.velocity[k, axis] = ZERO
        sensed.radius[k] = arrays.radius[k]
    for k in range(num_robots):
        row = out[k]
        if view.line_of_sight is not None or view.squared_range < np.inf:
            _hide(
                sensed.position[k], sensed.position, arrays.boxes, arrays.triangles, view.squared_range,
                view.line_of_sight, sensed.ray, sensed.hidden,
            )  # fmt: skip
        observation.observe_robot(k, arrays, worlds.goal[b], sensed, time_left, row)
        for i in range(row.shape[0]):
            value = row[i]
            value = value if value > bounds[0, i] else bounds[0, i]
            row[i] = value if value < bounds[1, i] else bounds[1, i]


@cache
def observe_worlds_kernel(
    names: tuple[str, ...],
) -> Kernel[[ProblemArrays, ObservationInputs, ObservationSpec, IntArray, FloatArray], None]:
    """A kernel that fills ``out`` ``(B, K, D)`` with what every robot of every world sees, for teams of these models.

    ``arrays`` is the problem that the worlds share; its starts and goals are not looked at. ``tile_range`` is the first
    tile of worlds and the one after the last.
    """
    read_motion = motion_reader(names)

    @cached_kernel(variant="_".join(names), key=models_key(names), **OPTIONS)
    def observe_worlds(
        arrays: ProblemArrays, sight: ObservationInputs, view: ObservationSpec, tile_range: IntArray, out: FloatArray
    ) -> None:
        num_robots, dimension = arrays.goal.shape
        w = aligned_zeros(num_robots * STRIDE)
        sensed = allocate_sensed(num_robots, sight.bodies.shape[1], dimension, view)
        arrays = borrow(arrays)
        for index in range(tile_range[0], tile_range[1]):
            first = index * TILE
            load(sight, first, w)
            for b in range(first, min(first + TILE, sight.state.shape[0])):
                _sense_bodies(sight.bodies[b], num_robots, sensed)
                observe(read_motion, arrays, sight, b, sight.time_left[b], w, view, sensed, out[b])

    return observe_worlds
