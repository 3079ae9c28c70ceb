"""Which contacts a tile has to check at a step, so that the checks do not stay quadratic where nothing is near.

A robot's places in all samples of a tile fit a box. Two boxes with a gap between them cannot touch before the robots
have had time to cross it. So every few steps each robot gets a list of those, robots before it and moving bodies, that
it may touch until the next time, and only they are checked; the same holds for obstacles and the bounds. Boxes are made
only where the gaps measured earlier do not rule everything out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from d4orm_env.core.dynamics import ACCELERATION, SPEED
from d4orm_env.engine import tiles
from d4orm_env.engine.lanes import TILE, use_wide_registers
from d4orm_env.engine.tiles import NOWHERE, OPTIONS, ROBOT, ROWS, ZERO, compiled, inlined

SLACK = np.float32(1e-4)
"""Allowance for rounding [m]."""

_SIGN = np.int32(31)
_MAGNITUDE = np.int32(0x7FFFFFFF)
_LOWEST = np.int32(-0x80000000)
_INFINITY = np.float32(np.inf)

INTERVAL = np.int32(4)
"""Steps from one list to the next: making one costs as much as checking some pairs."""

# Columns of ``due`` ``(K, 3)`` int32, in time steps: when the robot's box was made, when it may touch a robot before it
# or a body at the earliest, and when to look at obstacles and bounds again.
SEEN, EARLIEST, STATIC = range(3)


class Scratch(NamedTuple):
    """What a tile remembers of ``K`` robots and ``O`` moving bodies, numbered after the robots.

    Attributes:
        stride: ``(K + O,)`` how far each gets in one step at most [m].
        due: ``(K, 3)`` see above.
        low: ``(d, K + O)`` boxes, the lower corners.
        high: ``(d, K + O)`` the upper corners.
        wait: ``(K + O,)`` steps until one robot may touch another thing.
        num_robots: ``(K,)`` how many robots before it each may touch,
        robots: ``(K, K)`` and which.
        num_bodies: ``(K,)`` how many bodies each may touch,
        bodies: ``(K, O)`` and which.
        near: ``(K, 2)`` who is near something in which samples, see :mod:`~d4orm_env.engine.tiles`.
    """

    stride: Any
    due: Any
    low: Any
    high: Any
    wait: Any
    num_robots: Any
    robots: Any
    num_bodies: Any
    bodies: Any
    near: Any


@numba.njit(nogil=True, **OPTIONS)
def make_scratch(num_robots: Any, num_bodies: Any, dimension: Any) -> Any:
    """Unfilled scratch."""
    things = num_robots + num_bodies
    return Scratch(
        np.empty(things, np.float32), np.empty((num_robots, 3), np.int32), np.empty((dimension, things), np.float32),
        np.empty((dimension, things), np.float32), np.empty(things, np.float32), np.empty(num_robots, np.int32),
        np.empty((num_robots, num_robots), np.int32), np.empty(num_robots, np.int32),
        np.empty((num_robots, num_bodies), np.int32), np.empty((num_robots, 2), np.uint64),
    )  # fmt: skip


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
    use_wide_registers()
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
def _look(t: Any, k: Any, w: Any, due: Any, low: Any, high: Any) -> None:
    """Make the box of robot ``k`` at time ``t`` if that has not been done."""
    if due[k, SEEN] != t:
        due[k, SEEN] = t
        for axis in range(low.shape[0]):
            low[axis, k], high[axis, k] = _extent(k * ROWS + axis, w)


@compiled
def _add_gaps(low_k: Any, high_k: Any, low: Any, high: Any, gap2: Any) -> None:
    """Add the squared gaps along one axis from one box to others."""
    use_wide_registers()
    for i in range(gap2.shape[0]):
        above, below = low_k - high[i], low[i] - high_k
        gap = above if above > below else below
        gap = gap if gap > ZERO else ZERO
        gap2[i] += gap * gap


@compiled
def _gaps_to_waits(reach: Any, radius: Any, stride_k: Any, stride: Any, wait: Any) -> None:
    """Replace squared gaps by the steps it takes to cross them."""
    use_wide_registers()
    for i in range(wait.shape[0]):
        wait[i] = (np.sqrt(wait[i]) - (reach + radius[i])) / (stride_k + stride[i])


@compiled
def _list_due(wait: Any, listed: Any) -> Any:
    """List those that may be touched before the next list is made.

    Returns:
        The length of the list, and the least number of steps until any thing may be touched.
    """
    count, least = np.int32(0), _INFINITY
    for i in range(wait.shape[0]):
        listed[count] = i
        count += np.int32(1) if wait[i] <= np.float32(INTERVAL - 1) else np.int32(0)
        least = wait[i] if wait[i] < least else least
    return count, least


@inlined
def _make_list(first: Any, last: Any, reach: Any, k: Any, radius: Any, s: Any, listed: Any) -> Any:
    """Measure the gaps from robot ``k`` to things from number ``first`` to ``last``; see :func:`_list_due`."""
    waits = s.wait[first:last]
    waits[:] = ZERO
    for axis in range(s.low.shape[0]):
        _add_gaps(s.low[axis, k], s.high[axis, k], s.low[axis, first:last], s.high[axis, first:last], waits)
    _gaps_to_waits(reach + SLACK, radius, s.stride[k], s.stride[first:last], waits)
    return _list_due(waits, listed)


@inlined
def _list_near(
    radius: Any, margin: Any, moving: Any, moving_radius: Any, t: Any, num_steps: Any, w: Any, s: Any
) -> None:
    """Make the lists for time ``t`` and the steps until the next ones."""
    num_robots, num_bodies = radius.shape[0], moving.shape[0]
    for body in range(num_bodies):
        for axis in range(s.low.shape[0]):
            s.low[axis, num_robots + body] = s.high[axis, num_robots + body] = moving[body, axis]
    for k in range(num_robots):
        s.num_robots[k] = s.num_bodies[k] = np.int32(0)
        if s.due[k, EARLIEST] < t + INTERVAL:
            for other in range(k + 1):
                _look(t, other, w, s.due, s.low, s.high)
            reach = radius[k] + margin
            s.num_robots[k], soon = _make_list(0, k, reach, k, radius, s, s.robots[k])
            if num_bodies > 0:
                s.num_bodies[k], sooner = _make_list(
                    num_robots, num_robots + num_bodies, reach, k, moving_radius, s, s.bodies[k]
                )  # fmt: skip
                soon = min(soon, sooner)
            s.due[k, EARLIEST] = t + np.int32(min(max(soon, ZERO), np.float32(num_steps)))


@inlined
def _gap(low_a: Any, high_a: Any, low_b: Any, high_b: Any) -> Any:
    return max(max(low_a - high_b, low_b - high_a), ZERO)


@inlined
def _point_gap(low: Any, high: Any, k: Any, point: Any, axes: Any) -> Any:
    gap2 = ZERO
    for axis in range(axes):
        gap = _gap(low[axis, k], high[axis, k], point[axis], point[axis])
        gap2 += gap * gap
    return np.sqrt(gap2)


@inlined
def _box_gap(low: Any, high: Any, k: Any, obstacle: Any) -> Any:
    gap2 = ZERO
    dimension = low.shape[0]
    for axis in range(dimension):
        gap = _gap(low[axis, k], high[axis, k], obstacle[axis], obstacle[dimension + axis])
        gap2 += gap * gap
    return np.sqrt(gap2)


@inlined
def _static_gap(arrays: Any, k: Any, low: Any, high: Any) -> Any:
    """Smallest distance from the box of robot ``k`` to any obstacle or out of the bounds."""
    dimension = low.shape[0]
    nearest = _INFINITY
    for axis in range(dimension):
        nearest = min(nearest, low[axis, k] - arrays.bounds[0, axis])
        nearest = min(nearest, arrays.bounds[1, axis] - high[axis, k])
    for i in range(arrays.balls.shape[0]):
        nearest = min(nearest, _point_gap(low, high, k, arrays.balls[i], dimension) - arrays.balls[i, dimension])
    for i in range(arrays.cylinders.shape[0]):
        nearest = min(nearest, _point_gap(low, high, k, arrays.cylinders[i], 2) - arrays.cylinders[i, 2])
    for i in range(arrays.boxes.shape[0]):
        nearest = min(nearest, _box_gap(low, high, k, arrays.boxes[i]))
    return nearest


@compiled
def _mark_listed(radius: Any, margin: Any, count: Any, listed: Any, dimension: Any, w: Any, near: Any) -> None:
    """Flag robots within the margin of those on their lists."""
    use_wide_registers()
    num_robots = radius.shape[0]
    for k in range(num_robots):
        for i in range(count[k]):
            other = np.int64(np.uint32(listed[k, i]))
            tiles.mark_pair(radius[k] + radius[other] + margin, k, other, dimension, w, near)


@inlined
def mark_robots(
    radius: Any, margin: Any, moving: Any, moving_radius: Any, t: Any, num_steps: Any, w: Any, s: Any
) -> None:
    """Flag robots within the margin of each other or of a body at time ``t``; ``moving`` ``(O, d)`` are the bodies."""
    num_robots, dimension = radius.shape[0], s.low.shape[0]
    s.near[:, ROBOT] = NOWHERE
    if t % INTERVAL == 0:
        _list_near(radius, margin, moving, moving_radius, t, num_steps, w, s)
    _mark_listed(radius, margin, s.num_robots, s.robots, dimension, w, s.near)
    for k in range(num_robots):
        for i in range(s.num_bodies[k]):
            body = s.bodies[k, i]
            tiles.mark_round(radius[k] + moving_radius[body] + margin, k, moving[body], dimension, ROBOT, w, s.near)


@inlined
def near_static(arrays: Any, k: Any, t: Any, num_steps: Any, w: Any, s: Any) -> Any:
    """Whether any sample of robot ``k`` may be within the margin of an obstacle or the bounds at time ``t``."""
    _look(t, k, w, s.due, s.low, s.high)
    gap = _static_gap(arrays, k, s.low, s.high) - arrays.radius[k] - arrays.margin - SLACK
    if not gap > ZERO:
        return True
    s.due[k, STATIC] = np.int32(t + 1) + np.int32(min(gap / s.stride[k], np.float32(num_steps)))
    return False
