"""The last stretch of a first-order car: a curve, a straight and another curve, exactly to its goal.

As L. E. Dubins' paths (1957), but with trailers a circle begins and ends with a swing, worked out beforehand. Since a
swing leads as far wherever it begins, the centres of both circles are known, and with them the straight between. Where
there is no room for trailers in line at the goal, the last swing is left out: they stay in a bend; or the last swing
leads to hitch angles that are asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Whole
from d4orm_env.engine.compiling import compiled
from d4orm_env.engine.elementary import arctan2, cosine, sine
from d4orm_planners.manoeuvres.first_order_car_moves import circle, steering, swing, tightest_curvature
from d4orm_planners.manoeuvres.kinds import Kind, Mode, held
from d4orm_planners.manoeuvres.lattice import TURN, moved, turned_by, write_pose
from d4orm_planners.manoeuvres.primitives import POSE_SIZE, drive
from d4orm_planners.manoeuvres.snapping import Goal

LEVELS = (1.0, 0.5, 0.25, 0.125)  #: Curvatures, in that of the tightest circle
SIDES = (1, -1)
CIRCLES = len(LEVELS) * len(SIDES)  #: Circles in each direction


class Curves(NamedTuple):
    """Circles of a car with its trailers: forwards to the left and to the right by levels, then in reverse; and once
    more, if curves end in a bend, with other swings out of them or none. ``W`` in all.
    """

    last: int  #: Number of the first one that may be a curve's last
    begin: IntArray  #: ``(2 W + 1,)`` where the steps of the swing into each begin, and of that out of it
    poses: Floats  #: ``(S, 6)`` after each of these steps, from where the swing began
    controls: FloatArray  #: ``(S, 2)``
    ahead: Floats  #: ``(W, 2)`` centre of the circle, from where the swing into it begins
    behind: Floats  #: ``(W, 2)`` the same from where the swing out of it ends
    #: ``(W,)`` by which both swings together turn the heading [rad]; NaN where there is no swing out of it
    swung: Floats
    curvature: Floats  #: ``(W,)`` [1/m], to the left positive
    steering: Floats  #: ``(W,)`` [rad]
    stride: Floats  #: ``(W,)`` distance in a step, in reverse negative [m]


Curve: TypeAlias = tuple[int, int, float, float, int, float]
"""Steps in all, zero for none; the first circle, -1 for straight on; lengths of its arc and of the straight; the second
circle and the length of its arc."""
NO_CURVE = (0, -1, 0.0, 0.0, -1, 0.0)
NO_CURVES = Curves(
    0,
    np.zeros(1, np.int64),
    np.zeros((0, POSE_SIZE)),
    np.zeros((0, 2), np.float32),
    np.zeros((0, 2)),
    np.zeros((0, 2)),
    *np.zeros((4, 0)),
)
"""Of all other robots."""


@cache
def curves_of(kind: Kind, bent: bool, hitches: Mode | None = None) -> Curves:
    """Circles of a first-order car, and the swings between them and straight on.

    Curves end in a bend if they are ``bent``: in the circles' own, or at these hitch angles [rad].
    """
    swings, rows, straight, tightest = [], [], (0.0,) * len(kind.model.trailers), tightest_curvature(kind)
    if tightest is None:
        return NO_CURVES
    after = _ends(kind, bent, hitches)
    for end, way, level, side in product((_in_line, *after), (1, -1), LEVELS, SIDES):
        curvature = side * level * tightest
        angles = circle(kind, curvature)
        assert angles is not None
        mode = tuple(angles.tolist())
        into, out = swing(kind, straight, mode, way), end(kind, mode, way)
        if into is None or _in_line(kind, mode, way) is None:
            return NO_CURVES
        found = out is not None
        out = held(0, 0.0, 0.0) if out is None else out
        first, last = _driven(kind, straight, into), _driven(kind, mode, out)
        swings += [(into, first[1:]), (out, last[1:])]
        (x, y, turn), (its_x, its_y, its_turn) = first[-1, :3].tolist(), last[-1, :3].tolist()
        sine, cosine = portable.sin_cos_of(turn)
        ahead = (x - sine / curvature, y + cosine / curvature)
        sine, cosine = portable.sin_cos_of(its_turn)
        dx, dy = -its_x, 1 / curvature - its_y
        behind, swung = (cosine * dx + sine * dy, cosine * dy - sine * dx), turn + its_turn if found else np.nan
        rows.append((ahead, behind, swung, curvature, steering(kind, curvature), way * kind.pace(way) * kind.dt))
    controls, poses = zip(*swings, strict=True)
    begin = np.cumsum([0, *map(len, controls)])
    columns = (np.array(column) for column in zip(*rows, strict=True))
    return Curves(2 * CIRCLES if after else 0, begin, np.concatenate(poses), np.concatenate(controls), *columns)


def _in_line(kind: Kind, mode: Mode, way: int) -> FloatArray | None:
    """Controls from hitch angles until trailers are in line."""
    return swing(kind, mode, (0.0,) * len(mode), way)


def _ends(kind: Kind, bent: bool, hitches: Mode | None) -> list[Callable[[Kind, Mode, int], FloatArray | None]]:
    """Ends of curves other than in line: controls from the hitch angles of a circle to those at the goal."""
    if hitches is None:
        return [lambda kind, mode, way: held(0, 0.0, 0.0)] if bent else []

    def directly(kind: Kind, mode: Mode, way: int) -> FloatArray | None:
        return swing(kind, mode, hitches, way)

    def over_straight(kind: Kind, mode: Mode, way: int, last: int) -> FloatArray | None:
        some = _in_line(kind, mode, way), swing(kind, (0.0,) * len(mode), hitches, last)
        return None if some[0] is None or some[1] is None else np.concatenate([some[0], some[1]])

    return [directly, partial(over_straight, last=1), partial(over_straight, last=-1)]


def _driven(kind: Kind, mode: Mode, controls: FloatArray) -> Floats:
    """``(n + 1, 6)`` poses from the origin on; without any controls it is there that a car stays."""
    return drive(kind, mode, controls)[0] if len(controls) else np.zeros((1, POSE_SIZE))


@compiled
def _turned(x: float, y: float, angle: float) -> tuple[float, float]:
    c, s = np.float64(cosine(np.float32(angle))), np.float64(sine(np.float32(angle)))
    return c * x - s * y, s * x + c * y


@compiled
def _arc(curves: Curves, circle: Whole, turn: float) -> float:
    """Length of the arc by which the heading turns so far in all, swings included; negative in reverse."""
    direction = 1.0 if curves.curvature[circle] * curves.stride[circle] > 0 else -1.0
    left = direction * (turn - curves.swung[circle])
    return direction * (left - TURN * np.floor(left / TURN)) / curves.curvature[circle]


@compiled
def _count(curves: Curves, circle: Whole, length: float) -> int:
    return int(np.ceil(length / curves.stride[circle] - 1e-6))


@compiled
def _joined(curves: Curves, goal: Goal, x: float, y: float, heading: float, first: int, second: int) -> Curve:
    """The curve by two circles, if there is one."""
    if np.isnan(curves.swung[second]):
        return NO_CURVE
    px, py = _turned(curves.ahead[first, 0], curves.ahead[first, 1], heading)
    qx, qy = _turned(curves.behind[second, 0], curves.behind[second, 1], goal.heading)
    dx, dy = goal.x + qx - x - px, goal.y + qy - y - py
    along = curves.ahead[second, 0] - curves.behind[first, 0]
    across = curves.ahead[second, 1] - curves.behind[first, 1]
    square = dx * dx + dy * dy - across * across
    if square < 0:
        return NO_CURVE
    way = 1.0 if curves.stride[first] > 0 else -1.0
    whole = way * np.sqrt(square)
    straight = whole - along
    if way * straight < 0:
        return NO_CURVE
    faced = np.float64(arctan2(np.float32(dy), np.float32(dx))) - arctan2(np.float32(across), np.float32(whole))
    one, other = _arc(curves, first, faced - heading), _arc(curves, second, goal.heading - faced)
    swings = curves.begin[2 * first + 2] - curves.begin[2 * first]
    swings += curves.begin[2 * second + 2] - curves.begin[2 * second]
    driven = _count(curves, first, one) + _count(curves, first, straight) + _count(curves, second, other)
    return int(swings) + driven, first, one, straight, second, other


@compiled
def curve_of(curves: Curves, goal: Goal, x: float, y: float, heading: float, way: float) -> Curve:
    """The quickest curve from a pose, trailers in line, forwards (``way`` is 1) or in reverse (-1)."""
    begin, best = 0 if way > 0 else CIRCLES, NO_CURVE
    along, across = _turned(goal.x - x, goal.y - y, -heading)
    if curves.curvature.shape[0] == 0 or np.isnan(goal.heading):
        return best
    turn = abs(turned_by(goal.heading - heading))
    if curves.last == 0 and way * along >= 0 and abs(across) <= 0.5 * goal.radius and turn <= 0.5 * goal.tolerance:
        return _count(curves, begin, along), -1, 0.0, along, begin, 0.0
    for first in range(begin, begin + CIRCLES):
        for level in range(curves.last + first - first % 2, curves.swung.shape[0], 2 * CIRCLES):
            for second in range(level, level + 2):
                curve = _joined(curves, goal, x, y, heading, first, second)
                if curve[0] > 0 and (best[0] == 0 or curve[0] < best[0]):
                    best = curve
    return best


@compiled
def _sweep_swing(curves: Curves, number: Whole, swept: Floats, at: int) -> int:
    """Fill in the steps of a swing from step ``at`` on; return the step at its end."""
    x, y, heading = swept[at, 0], swept[at, 1], swept[at, 2]
    for row in range(curves.begin[number], curves.begin[number + 1]):
        at += 1
        px, py, turned = moved(x, y, heading, curves.poses[row])
        write_pose(swept, at, px, py, turned, curves.poses[row])
    return at


@compiled
def _sweep_drive(curves: Curves, circle: Whole, curvature: float, length: float, swept: Floats, at: int) -> int:
    """The same for an arc or a straight on which hitch angles stay as they are."""
    begin, count = at, _count(curves, circle, length)
    x, y, heading = swept[at, 0], swept[at, 1], swept[at, 2]
    for step in range(1, count + 1):
        at, gone = begin + step, length * step / count
        dx, dy = gone, 0.0
        if curvature != 0.0:
            half = 0.5 * curvature * gone
            dx, dy = _turned(2 * np.float64(sine(np.float32(half))) / curvature, 0.0, half)
        dx, dy = _turned(dx, dy, heading)
        write_pose(swept, at, x + dx, y + dy, turned_by(heading + curvature * gone), swept[begin])
    return at


@compiled
def sweep_curve(curves: Curves, curve: Curve, swept: Floats) -> int:
    """Fill in the poses of a curve, from that in the first row of ``swept`` on; return the number of steps."""
    _, first, one, straight, second, other = curve
    at = 0
    if first >= 0:
        at = _sweep_swing(curves, 2 * first, swept, at)
        at = _sweep_drive(curves, first, curves.curvature[first], one, swept, at)
        at = _sweep_swing(curves, 2 * first + 1, swept, at)
    at = _sweep_drive(curves, second, 0.0, straight, swept, at)
    if first >= 0:
        at = _sweep_swing(curves, 2 * second, swept, at)
        at = _sweep_drive(curves, second, curves.curvature[second], other, swept, at)
        at = _sweep_swing(curves, 2 * second + 1, swept, at)
    return at


def curve_controls(curves: Curves, curve: Curve, dt: float) -> FloatArray:
    """``(n, 2)`` its controls."""
    _, first, one, straight, second, other = curve

    def driven(circle: int, length: float, steering: float) -> FloatArray:
        count = int(np.ceil(length / curves.stride[circle] - 1e-6))
        return held(count, length / max(count, 1) / dt, steering)

    def curved(circle: int, length: float) -> list[FloatArray]:
        begin, middle, end = curves.begin[2 * circle : 2 * circle + 3].tolist()
        arc = driven(circle, length, curves.steering[circle])
        return [curves.controls[begin:middle], arc, curves.controls[middle:end]]

    if first < 0:
        return driven(second, straight, 0.0)
    return np.concatenate([*curved(first, one), driven(second, straight, 0.0), *curved(second, other)])
