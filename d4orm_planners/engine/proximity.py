"""Contacts that a tile has to check, so that the checks do not stay quadratic where nothing is near.

A tile moves its robots a block of steps at a time and checks the block's positions afterwards. Sixteen boxes hold
those of a robot, each of four of the tile's samples, one box a lane of a vector: four comparisons tell that two robots
keep apart in all of them. Every robot lists those before it for which they do not tell. Then 64 boxes, one a sample,
tell which samples to look at. Moving bodies, obstacles and the bounds have boxes too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, Ints, Whole
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine import simd
from d4orm_env.engine.compiling import ZERO, aligned_zeros, compiled, inlined
from d4orm_env.engine.footprint_contacts import POSE, meets_body, refine_chunk
from d4orm_env.engine.obstacles import may_touch
from d4orm_env.engine.simd import (
    BLOCK,
    BOX,
    CHUNK,
    NOWHERE,
    TILE,
    chunk_within_2,
    chunk_within_3,
    lanes_meet_2,
    lanes_meet_3,
    lanes_overlap_2,
    lanes_overlap_3,
    use_wide_registers,
    worlds_overlap_2,
    worlds_overlap_3,
)
from d4orm_env.engine.tiles import near_round

DIGITS = 7  #: Binary digits that robots near each other are counted in; one tells only whether there are any
WIDER = np.float32(1 + 2.0**-6)  #: Stretches boxes for rounding, of coordinates many thousand times as large too
_CHUNK_BITS = np.uint64((1 << CHUNK) - 1)


class Scratch(NamedTuple):
    """Scratch of a tile of ``K`` robots."""

    #: ``(K d BOX,)`` where the robots are within a block, see :func:`~d4orm_env.engine.simd.enclose`, widened so that
    #: what is within the margin of each other touches
    boxes: FloatArray
    num_robots: Ints  #: ``(K,)`` how many robots before it each may touch,
    robots: Ints  #: ``(K, K)`` and which
    #: ``(DIGITS, K, BLOCK)`` how many robots and bodies are near at a step of the block: a bit for every sample of each
    #: binary digit, the lowest first. The last digit in use is set for all that does not fit.
    near: NDArray[np.uint64]
    buffer: FloatArray  #: ``(2 TILE,)`` two rows to overwrite


class Bodies(NamedTuple):
    """Bodies that move among the robots."""

    positions: FloatArray  #: ``(H, O, d)`` after every step
    radius: FloatArray  #: ``(O,)``
    #: ``(B, O, d, 2)`` ends of the boxes round them in each of the blocks of a horizon, widened by half of the margin
    boxes: FloatArray
    footprints: FootprintArrays | None  #: Theirs, or ``None`` where all bodies and robots are discs
    headings: FloatArray  #: ``(H, F)`` of their bodies and trailers, or ``(H, 0)`` where all are discs


def make_scratch(num_robots: int, dimension: int) -> Scratch:
    return Scratch(
        aligned_zeros(num_robots * dimension * BOX), np.empty(num_robots, np.int32),
        np.empty((num_robots, num_robots), np.int32), np.empty((DIGITS, num_robots, BLOCK), np.uint64),
        aligned_zeros(2 * TILE),
    )  # fmt: skip


@inlined
def position_of(k: Whole, step: int, dimension: int) -> Whole:
    """First element of robot ``k``'s positions after a step of the block, which have a row per axis."""
    return (k * BLOCK + step) * dimension * TILE


POSES = BLOCK * POSE * TILE  #: Numbers of a body's poses in a block


@inlined
def pose_of(step: int) -> Whole:
    """First element of a body's pose after a step of the block, among its :data:`POSES`."""
    return step * POSE * TILE


@inlined
def box_of(thing: Whole, dimension: int) -> Whole:
    """First element of the boxes of a robot or body."""
    return thing * dimension * BOX


@inlined
def enclose(k: int, half_width: np.float32, dimension: int, positions: FloatArray, boxes: FloatArray) -> None:
    """Make the boxes round robot ``k`` in this block, wider to every side by its radius and half of the margin."""
    for axis in range(dimension):
        first, begin = position_of(k, 0, dimension) + axis * TILE, box_of(k, dimension) + axis * BOX
        simd.enclose(positions, first, dimension * TILE, WIDER * half_width, boxes, begin)


@inlined
def _overlap(a: Whole, b: Whole, dimension: int, boxes: FloatArray) -> bool:
    """Check whether two things may touch in any lane."""
    if dimension == 2:
        return lanes_overlap_2(boxes, box_of(a, dimension), box_of(b, dimension)) != NOWHERE
    return lanes_overlap_3(boxes, box_of(a, dimension), box_of(b, dimension)) != NOWHERE


@inlined
def _samples_overlap(a: Whole, b: Whole, dimension: int, boxes: FloatArray) -> np.uint64:
    """The samples in which two robots may touch."""
    if dimension == 2:
        return worlds_overlap_2(boxes, box_of(a, dimension), box_of(b, dimension))
    return worlds_overlap_3(boxes, box_of(a, dimension), box_of(b, dimension))


@inlined
def _near_pair(safety_distance: np.float32, a: Whole, b: Whole, dimension: int, positions: FloatArray) -> np.uint64:
    """The samples, of the first ``CHUNK`` in the rows from ``a`` and ``b`` on, in which two centres are too near."""
    if dimension == 2:
        return chunk_within_2(positions, a, b, safety_distance * safety_distance)
    return chunk_within_3(positions, a, b, safety_distance * safety_distance)


@inlined
def _meets(k: int, thing: int, dimension: int, boxes: FloatArray, limits: FloatArray) -> bool:
    """Check whether robot ``k`` may touch, in any lane, the thing of this number in ``limits`` ``(. d 2,)``."""
    if dimension == 2:
        return lanes_meet_2(boxes, box_of(k, dimension), limits, thing * 4)
    return lanes_meet_3(boxes, box_of(k, dimension), limits, thing * 6)


@compiled
def _list_near(dimension: int, s: Scratch) -> None:
    """List for every robot those before it that it may touch in this block."""
    use_wide_registers()
    for k in range(s.num_robots.shape[0]):
        listed, count = s.robots[k], np.int32(0)
        for other in range(k):
            listed[count] = other
            count += np.int32(_overlap(k, other, dimension, s.boxes))
        s.num_robots[k] = count


@inlined
def _count(digits: int, k: Whole, step: int, touch: np.uint64, near: NDArray[np.uint64]) -> None:
    """Add one in these samples to what is near robot ``k``."""
    for digit in range(digits - 1):
        carried = near[digit, k, step] & touch
        near[digit, k, step] ^= touch
        touch = carried
    near[digits - 1, k, step] |= touch


@inlined
def _undecided(f: FootprintArrays | None, digits: int, both: np.uint64, chunk: int, touch: np.uint64) -> np.uint64:
    """Leave out of ``touch`` where both robots are known to be near something, if one thing counts as much as two."""
    return touch if f is None or digits > 1 else touch & ~(both >> np.uint64(chunk))


@compiled
def _mark_listed(arrays: ProblemArrays, digits: int, positions: FloatArray, poses: FloatArray, s: Scratch) -> None:
    """Count robots within the margin of those on their lists."""
    radius, margin, dimension = arrays.radius, arrays.margin, arrays.goal.shape[1]
    use_wide_registers()
    for k in range(radius.shape[0]):
        for i in range(s.num_robots[k]):
            other = np.int64(np.uint32(s.robots[k, i]))
            safety_distance = radius[k] + radius[other] + margin
            samples = _samples_overlap(k, other, dimension, s.boxes)
            for chunk in range(0, TILE, CHUNK):
                if (samples >> np.uint64(chunk)) & _CHUNK_BITS == NOWHERE:
                    continue
                for step in range(BLOCK):
                    a, b = position_of(k, step, dimension) + chunk, position_of(other, step, dimension) + chunk
                    touch = _near_pair(safety_distance, a, b, dimension, positions)
                    f, begin = arrays.footprints, pose_of(step) + chunk
                    touch = _undecided(f, digits, s.near[0, k, step] & s.near[0, other, step], chunk, touch)
                    touch = refine_chunk(
                        f, k, other, touch, margin, dimension, positions, a, b, poses, POSES, begin, s.buffer
                    )
                    touch <<= np.uint64(chunk)
                    _count(digits, k, step, touch, s.near)
                    _count(digits, other, step, touch, s.near)


@compiled
def _mark_bodies(
    arrays: ProblemArrays, bodies: Bodies, digits: int, first: int, count: int, positions: FloatArray,
    poses: FloatArray, s: Scratch,
) -> None:  # fmt: skip
    """Count moving bodies within the margin of robots."""
    radius, margin = arrays.radius, arrays.margin
    _, num_bodies, dimension = bodies.positions.shape
    limits, before = bodies.boxes.reshape(-1), first // BLOCK * num_bodies
    for k in range(radius.shape[0]):
        for body in range(num_bodies):
            if _meets(k, before + body, dimension, s.boxes, limits):
                safety_distance = radius[k] + bodies.radius[body] + margin
                for step in range(count):
                    begin = position_of(k, step, dimension)
                    rows = positions[begin : position_of(k, step + 1, dimension)]
                    centre = bodies.positions[first + step, body]
                    touch = near_round(safety_distance, centre, dimension, rows, s.buffer)
                    f, begin = arrays.footprints, pose_of(step)
                    touch = _refine_body(
                        f, bodies.footprints, arrays, bodies, body, first + step, k, touch, rows, poses, begin, s
                    )
                    _count(digits, k, step, touch, s.near)


@compiled
def _refine_body(
    f: FootprintArrays | None, others: Any, arrays: ProblemArrays, bodies: Bodies, body: int, t: int,
    k: int, near: np.uint64, rows: FloatArray, poses: FloatArray, begin: Whole, s: Scratch,
) -> np.uint64:  # fmt: skip
    """The samples, of those ``near``, in which robot ``k`` is within the margin of a body at time ``t``."""
    if f is None:
        return near
    sure, dimension = near, arrays.goal.shape[1]
    turns = bodies.headings[t]
    for sample in range(TILE):
        bit = np.uint64(1) << np.uint64(sample)
        if near & bit == NOWHERE:
            continue
        x, y = bodies.positions[t, body, 0] - rows[sample], bodies.positions[t, body, 1] - rows[TILE + sample]
        z = bodies.positions[t, body, 2] - rows[2 * TILE + sample] if dimension == 3 else ZERO
        if not meets_body(
            f, k, arrays.radius[k], poses, POSES, begin + sample, others, body, bodies.radius[body], turns,
            x, y, z, dimension == 2, arrays.margin, s.buffer,
        ):  # fmt: skip
            sure &= ~bit
    return sure


@inlined
def mark_robots(
    arrays: ProblemArrays, bodies: Bodies, digits: int, first: int, count: int, positions: FloatArray,
    poses: FloatArray, s: Scratch,
) -> None:  # fmt: skip
    """Count in ``s.near`` robots and bodies within the margin of each robot in a block.

    Args:
        arrays: The problem.
        bodies: The :class:`Bodies`.
        digits: Binary digits to count in.
        first: Time of the block's first step.
        count: Steps in the block; of later ones the flags mean nothing.
        positions: Rows of positions, see :func:`position_of`.
        poses: Rows of poses, see :func:`pose_of`; of size zero where all bodies are discs.
        s: Scratch with the boxes of the robots in this block.
    """
    s.near[:digits] = NOWHERE
    dimension = bodies.positions.shape[2]
    _list_near(dimension, s)
    _mark_listed(arrays, digits, positions, poses, s)
    if bodies.positions.shape[1] > 0:
        _mark_bodies(arrays, bodies, digits, first, count, positions, poses, s)


@inlined
def near_static(arrays: ProblemArrays, k: int, bounds: FloatArray, boxes: FloatArray, buffer: FloatArray) -> bool:
    """Check whether in this block any sample of robot ``k`` may be within the margin of an obstacle, or of ``bounds``,
    see :func:`bound_boxes`. ``buffer`` is two rows to overwrite.
    """
    dimension, limits, touch = arrays.goal.shape[1], bounds.reshape(-1), False
    if arrays.grid.clearance.shape[0] > 0:
        # The boxes are wider than the positions by the radius and half of the margin.
        safety_distance = arrays.radius[k] + arrays.margin
        half_width = WIDER * (arrays.radius[k] + np.float32(0.5) * arrays.margin)
        touch = may_touch(arrays.grid, safety_distance, half_width, boxes, box_of(k, dimension) + 2 * TILE, BOX, buffer)
    for bound in range(bounds.shape[0]):
        touch |= _meets(k, bound, dimension, boxes, limits)
    return touch
