"""The step of a tile of worlds, compiled with numba from the scalar functions of :mod:`d4orm_env.dynamics`.

A tile is a block of :data:`~d4orm_env.engine.simd.TILE` worlds (samples of a plan, or environments) that differ in
their numbers only. All a tile needs lies in one flat float32 array, the workspace: for every robot :data:`ROWS` rows,
every row one number per world. So every inner loop runs over worlds with distances between its operands that the
compiler knows, which is what lets it vectorise without checking for overlap, and the tile stays in cache while all
robots and pairs are visited. Who is near what is kept apart, in ``near`` ``(K, 3)``: a bit for every world.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numba import float32, int64, types
from numba.extending import register_jitable
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, IntArray, Whole
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.goal_poses import MOST_TRAILERS
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import Model, TimeStep
from d4orm_env.engine.borrowing import by_reference
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import ONE, OPTIONS, ZERO, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS, cosine, sine
from d4orm_env.engine.footprint_contacts import POSE, place_bodies, refine_pair
from d4orm_env.engine.simd import TILE, at_most, use_wide_registers, within_2, within_3
from d4orm_env.engine.stepping import (
    PICK,
    READ,
    WRITE,
    Docking,
    docking_of,
    make_stepper,
    models_key,
    read2,
    read3,
    squared_gap2,
    squared_gap3,
)
from d4orm_env.engine.units import UNIT, caller

# First rows of a robot in the workspace. A power of two in all would map the same row of every robot to the same cache
# set.
STATE, CONTROL, GOAL, ARRIVED, DISTANCE2, BUFFER, ROWS = 0, 6, 10, 13, 14, 15, 17
STRIDE = ROWS * TILE

BIG_TEAM = 128
"""Robots from which on boxes are compared before pairs: where worlds differ that takes a tenth longer at most."""
WIDER = np.float32(1 + 2.0**-6)
"""Factor by which the distance of boxes that are apart is stretched for rounding."""

# Columns of ``near``.
ROBOT, OBSTACLE, DYNAMIC = 0, 1, 2


def _mover(model: Model) -> Callable[..., None]:
    """The compiled step of one robot of this model in every world of a tile.

    It is one long chain of dependent operations. Cut into loops, a core works on more worlds at the same time.
    """
    move, dock = make_stepper(model)
    limit_control = inlined(model.functions.limit_control)
    read_x, write_x = READ[model.state_size], WRITE[model.state_size]
    read_u, write_u, pick_u = READ[model.control_size], WRITE[model.control_size], PICK[model.control_size]
    read_goal = READ[model.dimension]
    no_control, num_limits = (ZERO,) * model.control_size, len(model.limit_names)

    @compiled
    def run(all_limits: FloatArray, h: TimeStep, docking: Docking, w: FloatArray) -> None:
        use_wide_registers()
        limits = to_fixed_tuple(all_limits, num_limits)
        for s in range(TILE):
            at_rest = transition.absorbed(w[ARRIVED * TILE + s] > ZERO, docking[2])
            u = limit_control(read_u(w, CONTROL * TILE, s), limits, OPS)
            write_u(w, CONTROL * TILE, s, pick_u(at_rest, no_control, u))
        for s in range(TILE):
            at_rest = transition.absorbed(w[ARRIVED * TILE + s] > ZERO, docking[2])
            u = read_u(w, CONTROL * TILE, s)
            write_x(w, STATE * TILE, s, move(at_rest, read_x(w, STATE * TILE, s), u, limits, h))
        for s in range(TILE):
            at_rest = transition.absorbed(w[ARRIVED * TILE + s] > ZERO, docking[2])
            x, u = read_x(w, STATE * TILE, s), read_u(w, CONTROL * TILE, s)
            x, gap2, arrived = dock(at_rest, x, u, limits, read_goal(w, GOAL * TILE, s), docking)
            write_x(w, STATE * TILE, s, x)
            w[ARRIVED * TILE + s] = ONE if arrived else ZERO
            w[DISTANCE2 * TILE + s] = gap2

    return run


@inlined
def measure_goal_distance(num_robots: int, dimension: int, w: FloatArray) -> None:
    """Fill the squared distances from the positions to the goals."""
    for k in range(num_robots):
        robot = w[k * STRIDE : (k + 1) * STRIDE]
        for s in range(TILE):
            total = ZERO
            for axis in range(dimension):
                gap = robot[(STATE + axis) * TILE + s] - robot[(GOAL + axis) * TILE + s]
                total += gap * gap
            robot[DISTANCE2 * TILE + s] = total


@register_jitable(nogil=True, **OPTIONS)
def pose_rows(f: FootprintArrays | None) -> int:
    """Number of rows that the poses of a team's bodies take; they are the last of the workspace."""
    return 0 if f is None else POSE * f.heading.shape[0]


@inlined
def place_team(f: FootprintArrays | None, num_robots: int, w: FloatArray) -> None:
    """Fill the poses of all bodies from the robots' states."""
    if f is not None:
        for k in range(num_robots):
            place_bodies(f, k, w[k * STRIDE + STATE * TILE : (k + 1) * STRIDE], w, POSE * TILE, num_robots * STRIDE)


class TeamBoxes(NamedTuple):
    """Boxes round the positions of a team's robots in a tile, by which pairs that are far apart are left out."""

    #: ``(K, 2, d)`` float32 lowest and highest positions [m]; ``(0, 2, d)`` for a team that is not big
    corners: FloatArray
    #: ``(K,)`` int64 numbers of the robots, of a big team by where its boxes begin along the first axis
    order: IntArray


BOX_TYPES = by_reference(types.NamedTuple((float32[:, :, ::1], int64[::1]), TeamBoxes))
"""As numba knows them."""


@register_jitable(nogil=True, **OPTIONS)
def allocate_boxes(arrays: ProblemArrays) -> TeamBoxes:
    """Make room for the boxes of a team; see :func:`enclose_team`."""
    num_robots, dimension = arrays.goal.shape
    corners = np.empty((num_robots if num_robots >= BIG_TEAM else 0, 2, dimension), np.float32)
    return TeamBoxes(corners, np.arange(num_robots))


@compiled
def enclose_team(count: int, w: FloatArray, boxes: TeamBoxes) -> None:
    """Find the lowest and the highest positions of robots in the first worlds of a tile, if it is a big team.

    In moments of one world, which are near to each other, most pairs are so seen to be apart. ``boxes`` are output.
    """
    corners = boxes.corners
    for k in range(corners.shape[0]):
        for axis in range(corners.shape[2]):
            first = k * STRIDE + (STATE + axis) * TILE
            low = high = w[first]
            for s in range(1, count):
                low, high = min(low, w[first + s]), max(high, w[first + s])
            corners[k, 0, axis], corners[k, 1, axis] = low, high
    _sort_boxes(corners, boxes.order)


@compiled
def _sort_boxes(corners: FloatArray, order: IntArray) -> None:
    """Sort the numbers of boxes by where these begin, quickly if they nearly are (Shell, 1959)."""
    stride = corners.shape[0] // 2
    while stride > 0:
        for rank in range(stride, corners.shape[0]):
            k, at = order[rank], rank
            while at >= stride and corners[order[at - stride], 0, 0] > corners[k, 0, 0]:
                order[at], at = order[at - stride], at - stride
            order[at] = k
        stride //= 2


@inlined
def _is_apart(corners: FloatArray, k: Whole, other: Whole, distance: np.float32) -> bool:
    """Check whether two robots' boxes are farther apart than ``distance``."""
    apart = False
    for axis in range(corners.shape[2]):
        gap = max(corners[k, 0, axis] - corners[other, 1, axis], corners[other, 0, axis] - corners[k, 1, axis])
        apart |= gap > WIDER * distance
    return apart


@inlined
def mark_pairs(
    arrays: ProblemArrays,
    lanes: np.uint64,
    extra: np.float32,
    w: FloatArray,
    buffer: FloatArray,
    boxes: TeamBoxes,
    near: NDArray[np.uint64],
) -> None:
    """Flag every two robots closer than their footprints plus ``extra`` in some lanes.

    ``buffer`` is two rows to overwrite, ``boxes`` are those of :func:`enclose_team`.
    """
    f, poses, dimension = arrays.footprints, arrays.radius.shape[0] * STRIDE, arrays.goal.shape[1]
    corners, order, largest = boxes.corners, boxes.order, ZERO
    for k in range(arrays.radius.shape[0]):
        largest = max(largest, arrays.radius[k])
    for rank in range(order.shape[0]):
        for later in range(rank + 1, order.shape[0]):
            k, other = max(order[rank], order[later]), min(order[rank], order[later])
            if corners.shape[0] > 0:
                # Those that begin even later are as far apart.
                end = WIDER * (arrays.radius[order[rank]] + largest + extra)
                if corners[order[later], 0, 0] - corners[order[rank], 1, 0] > end:
                    break
                if _is_apart(corners, k, other, arrays.radius[k] + arrays.radius[other] + extra):
                    continue
            a, b, distance = k * STRIDE, other * STRIDE, arrays.radius[k] + arrays.radius[other] + extra
            square = distance * distance
            touch = lanes & (within_2(w, a, b, square) if dimension == 2 else within_3(w, a, b, square))
            touch = refine_pair(f, k, other, touch, extra, dimension, w, a, b, w, POSE * TILE, poses, buffer)
            near[k, ROBOT] |= touch
            near[other, ROBOT] |= touch


@inlined
def near_round(
    distance: np.float32, centre: FloatArray, axes: int, positions: FloatArray, buffer: FloatArray
) -> np.uint64:
    """Mask of the first rows of ``positions`` within ``distance`` of a centre, over two or three axes.

    ``buffer`` is a row to overwrite.
    """
    if axes == 2:
        point = (centre[0], centre[1])
        for s in range(TILE):
            buffer[s] = squared_gap2(read2(positions, 0, s), point)
    else:
        spot = (centre[0], centre[1], centre[2])
        for s in range(TILE):
            buffer[s] = squared_gap3(read3(positions, 0, s), spot)
    return at_most(buffer, 0, distance * distance)


def _motion_reader(model: Model) -> Callable[..., None]:
    velocity_of = inlined(model.functions.velocity)
    read_x, read_u = READ[model.state_size], READ[model.control_size]
    dimension, num_limits = model.dimension, len(model.limit_names)

    @compiled
    def read(all_limits: FloatArray, s: int, w: FloatArray, velocity: FloatArray) -> None:
        limits = to_fixed_tuple(all_limits, num_limits)
        v = velocity_of(read_x(w, STATE * TILE, s), read_u(w, CONTROL * TILE, s), limits, OPS)
        for axis in range(dimension):
            velocity[axis] = v[axis]

    return read


@cache
def robot_unit(name: str) -> Kernel[[ProblemArrays, int, int, FloatArray, FloatArray], None]:
    """``move_robot(arrays, k, looks, w, motion)`` for robots of a model: move one, or look how it moves.

    With no ``looks`` robot ``k`` moves one step in every world of the tile; its control rows hold the executed control
    afterwards. Else ``motion`` ``(K, TILE, d + 2 B)`` is filled in as many worlds: velocity, cosine and sine of the
    heading, zeros without, and of the hitch angles of trailers, of ``B`` bodies.
    """
    model = MODELS[name]
    move, read = _mover(model), _motion_reader(model)
    headings = np.full(1 + MOST_TRAILERS, -1)
    if model.heading_index is not None:
        headings[: 1 + len(model.trailers)] = model.heading_index, *(hitch for hitch, _ in model.trailers)

    @cached_kernel(variant=name, key=models_key((name,)), **UNIT)
    def move_robot(arrays: ProblemArrays, k: int, looks: int, w: FloatArray, motion: FloatArray) -> None:
        robot, limits, dimension = w[k * STRIDE : (k + 1) * STRIDE], arrays.limits[k], arrays.goal.shape[1]
        if looks == 0:
            h = transition.TimeStep(arrays.time_step[0], arrays.time_step[1], arrays.time_step[2], arrays.time_step[3])
            move(limits, h, docking_of(arrays, k), robot)
        for s in range(looks):
            own = motion[k, s]
            read(limits, s, robot, own)
            for body in range((own.shape[0] - dimension) // 2):
                index, column = headings[body], dimension + 2 * body
                own[column] = cosine(robot[index * TILE + s]) if index >= 0 else ZERO
                own[column + 1] = sine(robot[index * TILE + s]) if index >= 0 else ZERO

    return move_robot


call_robot = caller(5)
"""``(address, arrays, k, looks, w, motion)``: call a unit of :func:`robot_unit`."""
