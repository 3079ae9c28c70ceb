"""Which contacts a tile has to check at a step, so that the checks do not stay quadratic where nothing is near.

A robot's places in all samples of a tile fit a box. Two boxes with a gap between them cannot touch before the robots
have had time to cross it, so the pair need not be looked at until then; the same holds for moving bodies, obstacles and
the bounds. Boxes are made only for robots that some pair has to look at.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from d4orm_env.core.dynamics import ACCELERATION, SPEED
from d4orm_env.engine import tiles
from d4orm_env.engine.tiles import NEAR_ROBOT, ROWS, TILE, ZERO, compiled, inlined

SLACK = np.float32(1e-4)
"""Allowance for rounding [m]."""

_SIGN = np.int32(31)
_MAGNITUDE = np.int32(0x7FFFFFFF)
_LOWEST = np.int32(-0x80000000)
_INFINITY = np.float32(np.inf)

NEAR = np.int32(4)
"""Steps for which two boxes that touch are taken to go on touching: looking costs as much as checking some samples."""


# Columns of ``due`` ``(K, FIRST + K + O)`` int32, in time steps: when the robot's box was made, when the earliest thing
# in its row is due, when obstacles and bounds are, and whether its flags of this step have been written to; then when
# to look again at the robots before it, and at the bodies: negative for those to check at every step until then.
SEEN, EARLIEST, STATIC, TOUCHED, FIRST = range(5)


@inlined
def measure_strides(limits: Any, dt: Any, moving: Any, stride: Any) -> None:
    """Fill ``stride`` ``(K + O,)`` with how far a robot and a body get in one step at most [m].

    Args:
        limits: ``(K, 3)``.
        dt: Time step [s].
        moving: ``(H, O, d)`` places of the bodies.
        stride: Output.
    """
    num_robots = limits.shape[0]
    stride[num_robots:] = ZERO
    for k in range(num_robots):
        stride[k] = (limits[k, SPEED] + limits[k, ACCELERATION] * dt) * dt + SLACK
    for body in range(moving.shape[1]):
        for t in range(1, moving.shape[0]):
            gap2 = ZERO
            for axis in range(moving.shape[2]):
                gap = moving[t, body, axis] - moving[t - 1, body, axis]
                gap2 += gap * gap
            stride[num_robots + body] = max(stride[num_robots + body], np.sqrt(gap2) + SLACK)


@inlined
def begin(due: Any) -> None:
    """Everything is due at the first step."""
    due[:] = np.int32(0)
    due[:, SEEN] = np.int32(-1)


@inlined
def _ordered(bits: Any) -> Any:
    """Numbers' bits in an order that integers compare in, and back; a number that is none comes before or after all
    others, so that it cannot hide them.
    """
    return np.int32(bits ^ np.int32(np.int32(bits >> _SIGN) & _MAGNITUDE))


@compiled
def _extent(row: Any, w: Any) -> Any:
    """Smallest and largest number of a row of the workspace."""
    # Through uint32 the index is plainly not negative, which the vectoriser needs to know.
    first = np.int64(np.uint32(row * TILE))
    lower, upper = _MAGNITUDE, _LOWEST
    for s in range(TILE):
        value = _ordered(np.float32(w[first + s]).view(np.int32))
        lower = min(lower, value)
        upper = max(upper, value)
    low, high = np.int32(_ordered(lower)).view(np.float32), np.int32(_ordered(upper)).view(np.float32)
    # A sample that blew up may be anywhere.
    return low if low == low else -_INFINITY, high if high == high else _INFINITY


@inlined
def _look(t: Any, k: Any, w: Any, due: Any, box: Any) -> None:
    """Make the box of robot ``k`` at time ``t`` if that has not been done."""
    if due[k, SEEN] != t:
        due[k, SEEN] = t
        for axis in range(box.shape[2]):
            box[k, 0, axis], box[k, 1, axis] = _extent(k * ROWS + axis, w)


@inlined
def _gap(low_a: Any, high_a: Any, low_b: Any, high_b: Any) -> Any:
    return max(max(low_a - high_b, low_b - high_a), ZERO)


@inlined
def _pair_gap(box: Any, k: Any, other: Any) -> Any:
    gap2 = ZERO
    for axis in range(box.shape[2]):
        gap = _gap(box[k, 0, axis], box[k, 1, axis], box[other, 0, axis], box[other, 1, axis])
        gap2 += gap * gap
    return np.sqrt(gap2)


@inlined
def _point_gap(box: Any, k: Any, point: Any, axes: Any) -> Any:
    gap2 = ZERO
    for axis in range(axes):
        gap = _gap(box[k, 0, axis], box[k, 1, axis], point[axis], point[axis])
        gap2 += gap * gap
    return np.sqrt(gap2)


@inlined
def _box_gap(box: Any, k: Any, obstacle: Any) -> Any:
    gap2 = ZERO
    dimension = box.shape[2]
    for axis in range(dimension):
        gap = _gap(box[k, 0, axis], box[k, 1, axis], obstacle[axis], obstacle[dimension + axis])
        gap2 += gap * gap
    return np.sqrt(gap2)


@inlined
def _static_gap(arrays: Any, k: Any, box: Any) -> Any:
    """Smallest distance from the box of robot ``k`` to any obstacle or out of the bounds."""
    dimension = box.shape[2]
    nearest = _INFINITY
    for axis in range(dimension):
        nearest = min(nearest, box[k, 0, axis] - arrays.bounds[0, axis])
        nearest = min(nearest, arrays.bounds[1, axis] - box[k, 1, axis])
    for i in range(arrays.balls.shape[0]):
        nearest = min(nearest, _point_gap(box, k, arrays.balls[i], dimension) - arrays.balls[i, dimension])
    for i in range(arrays.cylinders.shape[0]):
        nearest = min(nearest, _point_gap(box, k, arrays.cylinders[i], 2) - arrays.cylinders[i, 2])
    for i in range(arrays.boxes.shape[0]):
        nearest = min(nearest, _box_gap(box, k, arrays.boxes[i]))
    return nearest


@inlined
def _next_look(t: Any, distance: Any, stride: Any, num_steps: Any) -> Any:
    """When a ``distance`` > 0 that shrinks by ``stride`` a step at most may be gone."""
    return np.int32(t + 1) + np.int32(min(distance / stride, np.float32(num_steps)))


@inlined
def _touch(k: Any, w: Any, due: Any) -> None:
    if due[k, TOUCHED] == 0:
        due[k, TOUCHED] = np.int32(1)
        tiles.clear_row(NEAR_ROBOT, k, w)


@inlined
def mark_robots(
    radius: Any, margin: Any, moving: Any, moving_radius: Any, t: Any, num_steps: Any, stride: Any, w: Any, due: Any,
    box: Any,
) -> None:  # fmt: skip
    """Flag robots within the margin of each other or of a body at time ``t``; ``moving`` ``(O, d)`` are the bodies.

    Flags are valid only where the column ``TOUCHED`` of ``due`` says so; nothing is near the others.
    """
    num_robots, dimension = radius.shape[0], box.shape[2]
    due[:, TOUCHED] = np.int32(0)
    for k in range(num_robots):
        if due[k, EARLIEST] > t:
            continue
        earliest = np.int32(num_steps)
        for other in range(k):
            when = due[k, FIRST + other]
            if when <= t:
                reach = radius[k] + radius[other] + margin
                if when >= -t:
                    _look(t, k, w, due, box)
                    _look(t, other, w, due, box)
                    gap = _pair_gap(box, k, other) - reach - SLACK
                    if gap > ZERO:
                        when = _next_look(t, gap, stride[k] + stride[other], num_steps)
                    else:
                        when = np.int32(-t - NEAR)
                    due[k, FIRST + other] = when
                if when < 0:
                    _touch(k, w, due)
                    _touch(other, w, due)
                    tiles.mark_pair(reach, k, other, dimension, w)
            earliest = min(earliest, when)
        for body in range(moving.shape[0]):
            when = due[k, FIRST + num_robots + body]
            if when <= t:
                reach = radius[k] + moving_radius[body] + margin
                if when >= -t:
                    _look(t, k, w, due, box)
                    gap = _point_gap(box, k, moving[body], dimension) - reach - SLACK
                    if gap > ZERO:
                        when = _next_look(t, gap, stride[k] + stride[num_robots + body], num_steps)
                    else:
                        when = np.int32(-t - NEAR)
                    due[k, FIRST + num_robots + body] = when
                if when < 0:
                    _touch(k, w, due)
                    tiles.mark_round(reach, k, moving[body], dimension, NEAR_ROBOT, w)
            earliest = min(earliest, when)
        due[k, EARLIEST] = earliest


@inlined
def near_static(arrays: Any, k: Any, t: Any, num_steps: Any, stride: Any, w: Any, due: Any, box: Any) -> Any:
    """Whether any sample of robot ``k`` may be within the margin of an obstacle or the bounds at time ``t``."""
    _look(t, k, w, due, box)
    gap = _static_gap(arrays, k, box) - arrays.radius[k] - arrays.margin - SLACK
    if not gap > ZERO:
        return True
    due[k, STATIC] = _next_look(t, gap, stride[k], num_steps)
    return False
