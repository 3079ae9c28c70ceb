"""Kernels that observe many worlds of one problem at once, and communication links between robots."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from d4orm_env.core import observation
from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray, Whole
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.engine.borrowing import borrow, by_reference
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import ONE, OPTIONS, WITHOUT_ARRAYS, ZERO, aligned_zeros, compiled, inlined, register
from d4orm_env.engine.ray_shapes import is_blocked
from d4orm_env.engine.simd import TILE
from d4orm_env.engine.tiles import STATE, STRIDE, TeamBoxes, allocate_boxes, call_robot, pose_rows
from d4orm_env.engine.types import ObservationInputs
from d4orm_env.engine.units import OBSERVATION, ROBOTS, SEEN_OBSTACLES, UNIT, caller
from d4orm_env.engine.world_tiles import load

register(observation)


class ObservationSpec(NamedTuple):
    """Contents of an observation, see :class:`~d4orm_env.core.observation_layout.ObservationLayout`."""

    bounds: FloatArray  #: ``(2, D)`` lowest and highest observation
    num_neighbors: int  #: Robots in it
    num_obstacles: int  #: Obstacles in it
    num_headings: int  #: Bodies of a robot whose headings are needed for it, one at least
    squared_range: np.float32  #: Square of the distance beyond which robots are not observed [m²]
    #: True if those behind obstacles are not observed either, else ``None``, which leaves rays out of a kernel
    line_of_sight: bool | None


_ROW, _ROWS = numba.float32[::1], numba.float32[:, ::1]
SENSED_TYPES = by_reference(
    numba.types.NamedTuple(
        (_ROWS, _ROWS, _ROW, _ROWS, _ROW, numba.boolean[::1], _ROWS, _ROWS, _ROWS), observation.Sensed
    )
)
"""As numba knows what is sensed."""


class WorldScratch(NamedTuple):
    """Room for kernels that observe worlds."""

    w: FloatArray  #: Workspace, see :mod:`~d4orm_env.engine.tiles`
    near: NDArray[np.uint64]  #: ``(K, 3)``
    boxes: TeamBoxes
    #: ``(K, TILE, d + 2 B)`` see :func:`~d4orm_env.engine.tiles.robot_unit`
    motion: FloatArray
    sensed: observation.Sensed


def allocate_scratch(arrays: ProblemArrays, view: ObservationSpec, num_bodies: int) -> WorldScratch:
    """Make room for the worlds of a problem, among so many bodies that are no robots."""
    (num_robots, d), count = arrays.goal.shape, len(arrays.goal) + num_bodies
    headings = 2 * view.num_headings
    shapes = (count, d), (count, d), (count,), (num_robots, headings), (num_robots,), (count,), (5, 1)
    kinds = [np.bool_ if name == "hidden" else np.float32 for name in observation.Sensed._fields]
    tables = (view.num_neighbors, 2), (view.num_obstacles, 2)
    return WorldScratch(
        aligned_zeros(num_robots * STRIDE + pose_rows(arrays.footprints) * TILE),
        np.empty((num_robots, 3), np.uint64),
        allocate_boxes(arrays),
        np.empty((num_robots, TILE, d + headings), np.float32),
        observation.Sensed(*(np.zeros(shape, kind) for shape, kind in zip((*shapes, *tables), kinds, strict=True))),
    )


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


@cached_kernel(**UNIT)
def see_obstacles(arrays: ProblemArrays, sensed: observation.Sensed, first: Whole, out: FloatArray) -> None:
    """Fill ``out`` ``(K, D)`` from column ``first`` on with the obstacles that the robots of a world see.

    A unit of its own, which is not compiled until a problem has obstacles or bounds.
    """
    for k in range(out.shape[0]):
        observation.observe_obstacles(k, arrays, sensed, first, out[k])


_call_see_obstacles = caller(4)


@cached_kernel(**UNIT)
def observe_world(
    arrays: ProblemArrays, goal: FloatArray, time_left: np.float32, view: ObservationSpec,
    sensed: observation.Sensed, out: FloatArray, units: IntArray,
) -> None:  # fmt: skip
    """Fill ``out`` ``(K, D)`` with what the robots of a world see, inside the view's bounds.

    It calls one of ``units``, their addresses, if it is there.
    """
    bounds, closed = view.bounds, units[SEEN_OBSTACLES, 0] != 0
    first: Whole = np.int64(0)
    for k in range(goal.shape[0]):
        if view.line_of_sight is not None or view.squared_range < np.inf:
            _hide(
                sensed.position[k], sensed.position, arrays.boxes, arrays.triangles, view.squared_range,
                view.line_of_sight, sensed.ray, sensed.hidden,
            )  # fmt: skip
        first = observation.observe_robot(k, arrays, goal, sensed, time_left, out[k])
    if closed:
        _call_see_obstacles(units[SEEN_OBSTACLES], arrays, sensed, first, out)
    for k in range(out.shape[0]):
        for i in range(out.shape[1]):
            value = out[k, i] if closed or i < first else ZERO
            value = value if value > bounds[0, i] else bounds[0, i]
            out[k, i] = value if value < bounds[1, i] else bounds[1, i]


call_observe_world = caller(7)
"""``(address, *arguments)``: call :func:`observe_world` as a unit."""


@inlined
def read_motion(arrays: ProblemArrays, units: IntArray, count: int, w: FloatArray, motion: FloatArray) -> None:
    """Fill ``motion`` in the first worlds of a tile, see :func:`~d4orm_env.engine.tiles.robot_unit`."""
    for k in range(motion.shape[0]):
        call_robot(units[ROBOTS + k], arrays, k, count, w, motion)


@inlined
def sense_robots(
    arrays: ProblemArrays,
    arrived: BoolArray,
    s: int,
    w: FloatArray,
    motion: FloatArray,
    sensed: observation.Sensed,
) -> None:
    """Note where the robots of a world are, and how they move."""
    num_robots, dimension = arrays.goal.shape
    for k in range(num_robots):
        at_rest = transition.absorbed(arrived[k], arrays.docks)
        for axis in range(dimension):
            sensed.position[k, axis] = w[k * STRIDE + (STATE + axis) * TILE + s]
            sensed.velocity[k, axis] = ZERO if at_rest else motion[k, s, axis]
        for column in range(sensed.heading.shape[1]):
            sensed.heading[k, column] = motion[k, s, dimension + column]
        sensed.arrived[k] = ONE if arrived[k] else ZERO
        sensed.radius[k] = arrays.radius[k]


@cached_kernel(**WITHOUT_ARRAYS)
def observe_worlds(
    arrays: ProblemArrays,
    sight: ObservationInputs,
    view: ObservationSpec,
    tile_range: IntArray,
    out: FloatArray,
    scratch: WorldScratch,
    units: IntArray,
) -> None:
    """Fill ``out`` ``(B, K, D)`` with what every robot of every world sees.

    ``arrays`` is the problem that the worlds share; its starts and goals are not looked at. ``tile_range`` is the first
    tile of worlds and the one after the last. ``units`` are as in :func:`~d4orm_env.engine.episodes.advance_worlds`.
    """
    num_robots = arrays.goal.shape[0]
    arrays, view, sensed = borrow(arrays), borrow(view), scratch.sensed
    w, motion = scratch.w, scratch.motion
    for index in range(tile_range[0], tile_range[1]):
        first, count = index * TILE, min(TILE, sight.state.shape[0] - index * TILE)
        load(sight, first, w)
        read_motion(arrays, units, count, w, motion)
        for b in range(first, first + count):
            _sense_bodies(sight.bodies[b], num_robots, sensed)
            sense_robots(arrays, sight.arrived[b], b - first, w, motion, sensed)
            call_observe_world(
                units[OBSERVATION], arrays, sight.goal[b], sight.time_left[b], view, sensed, out[b], units
            )
