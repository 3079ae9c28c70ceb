"""Driving towards points of a route under a robot's own dynamics, compiled with numba.

A robot that turns in place turns before it drives. One that turns only as it drives pursues a point ahead of it, as far
off as its turning circle takes (R. C. Coulter, *Implementation of the pure pursuit path tracking algorithm*,
CMU-RI-TR-92-01, 1992), in reverse where that lies behind, and where it lies aside it swings round or backs up until it
can drive there.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import SPEED, Model, TimeStep
from d4orm_env.engine.compiling import ONE, ZERO, compiled, inlined
from d4orm_env.engine.elementary import OPS, cosine, sine
from d4orm_env.engine.stepping import SQUARED_NORM, Row

if TYPE_CHECKING:
    from d4orm_planners.tracking.path_drives import Routes
    from d4orm_planners.tracking.timed_path import Timed

Length: TypeAlias = Callable[[Row], np.float32]
Steering: TypeAlias = Callable[[Row, Row, np.float32, np.float32, bool, Row, TimeStep], Row]
Turning: TypeAlias = Callable[[Row, Row, Row, np.float32, bool, Row], tuple[Row, np.float32]]

LOOKAHEAD = 1 / 3
"""Distance to the point of its route that a robot heads for, beyond what it drives in a step and a half, in radii of
the largest robot, as all lengths below."""
CIRCLES = 0.8  #: The same of one that drives in order to turn, in radii of its turning circle
REACHED, COINCIDING = 2 / 15, 1 / 15  #: Distances at which a robot is at a point, and at which two are one
FACING, CREEP = np.float32(0.8), np.float32(0.01)
"""Cosine of the angle between heading and path from which on a robot drives, and share of its speed before that."""
UNDER_WAY = np.float32(0.05)  #: Share of its speed from which a robot keeps its gear longer, lest it changes often
BEHIND = np.float32(0.5)  #: Cosine of the angle behind it of a point for which a robot under way changes gear
BESIDE = (np.float32(0.3), np.float32(0.954))
"""Cosine and sine of the angle beyond which a point is steered for as sharply as this."""
ASIDE = (np.float32(0.7), np.float32(0.3), np.float32(0.2))
"""Sine of the angle beyond which a robot backs up that comes nearer, is at rest, or is backing up already."""
BACKING = np.float32(0.5)  #: Share of its pace at which a robot backs up


def lookaheads(problem: Problem) -> Floats:
    """``(K,)`` least distance ahead at which robots look [m]."""
    return np.maximum(LOOKAHEAD * problem.team.largest_radius, CIRCLES * problem.team.turning_radius.astype(np.float64))


@compiled
def square_to(points: Floats, i: int, position: Floats | Row) -> float:
    """Squared distance of a point from a position, which may be the beginning of a state."""
    square = 0.0
    for axis in range(points.shape[1]):
        gap = points[i, axis] - position[axis]
        square += gap * gap
    return square


@compiled
def point_reached(points: Floats, arcs: Floats, at: int, last: int, position: Floats | Row, size: float) -> int:
    """The point that a robot has come to that was at ``at``: as far on as each next one is nearer, or reached.

    ``size`` is the radius of the largest robot [m].
    """
    following, reached = at, REACHED * size
    while following < last:
        following += 1
        # Where two arcs join, points coincide but for rounding.
        if arcs[following] - arcs[at] > COINCIDING * size or following == last:
            gap = square_to(points, following, position)
            if gap > square_to(points, at, position) and gap > reached * reached:
                break
            at = following
    return at


@inlined
def point_ahead(
    route: Routes | Timed, paces: Floats, at: int, last: int, stop: float, lookahead: tuple[float, float | np.float32],
    position: Floats | Row, size: float,
) -> int:  # fmt: skip
    """The point that a robot at point ``at`` heads for.

    The slower it must be there, the less far ahead it looks. A sharp corner is driven to before it is turned, and left
    as soon as it is as good as reached.

    Args:
        route: Its points, their arcs and bends.
        paces: Speed at which each may be passed [m/s].
        at: The point that it is at.
        last: The last point that it may head for.
        stop: Length of the route from which on it heads for no further point [m].
        lookahead: Its least look-ahead [m], and the time step [s].
        position: Where it really is [m].
        size: The radius of the largest robot [m].
    """
    target, slowest, reached = min(at + 1, last), paces[at], REACHED * size
    while (
        target < last
        and route.arcs[target] < stop
        and (
            (
                route.arcs[target] - route.arcs[at] < lookahead[0] + 1.5 * lookahead[1] * slowest
                and route.bends[target] > 0.0
            )
            or square_to(route.points, target, position) < reached * reached
        )
    ):
        target += 1
        slowest = min(slowest, paces[target])
    return target


@cache
def steering(name: str) -> Steering:
    """Compiled velocity of a robot of the model with this name towards a target.

    ``(state, target, room, pace, backs_up, limits, h) -> velocity`` is as fast as ``pace`` allows, and such that it can
    stop within ``room``. ``backs_up`` is of those that drive in order to turn.
    """
    robot = MODELS[name]
    approach = inlined(robot.functions.approach)
    scaled, length, between = vectors(robot.dimension)
    turned = _turning(robot, length)

    @inlined
    def steer(
        state: Row, target: Row, room: np.float32, pace: np.float32, backs_up: bool, limits: Row, h: TimeStep
    ) -> Row:
        gap = between(state, target)
        distance = length(gap)
        # As fast as it could drive to a point straight ahead that is as far off as its room goes, towards its target.
        factor = room / distance if distance > ZERO else ZERO
        wanted = approach(state, scaled(state, gap, factor), limits, h, OPS)
        if distance > ZERO:
            wanted, pace = turned(state, gap, wanted, pace, backs_up, limits)
        speed = length(wanted)
        if speed > pace:
            factor = pace / speed
            wanted = scaled(between(wanted, wanted), wanted, factor)
        return wanted

    return steer


def vectors(dimension: int) -> tuple[Callable[[Row, Row, np.float32], Row], Length, Callable[[Row, Row], Row]]:
    """``origin + step * factor``, the length of a step, and the step from a state to a position."""
    squared_norm = SQUARED_NORM[dimension]

    @inlined
    def length(step: Row) -> np.float32:
        return np.sqrt(squared_norm(step))

    @inlined
    def scaled_2(origin: Row, step: Row, factor: np.float32) -> Row:
        return (origin[0] + step[0] * factor, origin[1] + step[1] * factor)

    @inlined
    def between_2(state: Row, target: Row) -> Row:
        return (target[0] - state[0], target[1] - state[1])

    @inlined
    def scaled_3(origin: Row, step: Row, factor: np.float32) -> Row:
        return (origin[0] + step[0] * factor, origin[1] + step[1] * factor, origin[2] + step[2] * factor)

    @inlined
    def between_3(state: Row, target: Row) -> Row:
        return (target[0] - state[0], target[1] - state[1], target[2] - state[2])

    return (scaled_2, length, between_2) if dimension == 2 else (scaled_3, length, between_3)


def _turning(robot: Model, length: Length) -> Turning:
    """Return a function that changes a velocity towards a point so far off, and its pace, in order to face it."""
    heading, velocity = -1 if robot.heading_index is None else robot.heading_index, inlined(robot.functions.velocity)
    at_rest = (ZERO,) * robot.control_size

    @inlined
    def unchanged(
        state: Row, gap: Row, wanted: Row, pace: np.float32, backs_up: bool, limits: Row
    ) -> tuple[Row, np.float32]:
        return wanted, pace

    @inlined
    def in_place(
        state: Row, gap: Row, wanted: Row, pace: np.float32, backs_up: bool, limits: Row
    ) -> tuple[Row, np.float32]:
        facing = (cosine(state[heading]) * gap[0] + sine(state[heading]) * gap[1]) / length(gap)
        return wanted, pace * min(max((facing - FACING) / (ONE - FACING), CREEP), ONE)

    @inlined
    def as_it_drives(
        state: Row, gap: Row, wanted: Row, pace: np.float32, backs_up: bool, limits: Row
    ) -> tuple[Row, np.float32]:
        x, y, distance = cosine(state[heading]), sine(state[heading]), length(gap)
        along, across = (x * gap[0] + y * gap[1]) / distance, (x * gap[1] - y * gap[0]) / distance
        own = velocity(state, at_rest, limits, OPS)
        gear = gear_towards(along, across, (x * own[0] + y * own[1]) / limits[SPEED], backs_up)
        if backs_up and along * gear < ZERO:
            pace *= BACKING
        if along * gear < BESIDE[0]:
            along, across = gear * BESIDE[0], BESIDE[1] if across >= ZERO else -BESIDE[1]
        speed = min(length(wanted), pace)
        return ((x * along - y * across) * speed, (y * along + x * across) * speed), pace

    if heading < 0:
        return unchanged
    return in_place if robot.turns_in_place or robot.dimension == 3 else as_it_drives


@inlined
def gear_towards(along: np.float32, across: np.float32, speed: np.float32, backs_up: bool) -> np.float32:
    """1 to drive forwards, -1 in reverse.

    Args:
        along: Cosine of the angle at which the point lies.
        across: Its sine.
        speed: At which the robot drives, as a share of its limit, negative in reverse.
        backs_up: Whether it drives away from a point that lies too far aside to drive there, and not past it.
    """
    rolls = ONE if speed > UNDER_WAY else (-ONE if speed < -UNDER_WAY else ZERO)
    if not backs_up:
        return ONE if along + rolls * BEHIND >= ZERO else -ONE
    nearer = ONE if along >= ZERO else -ONE
    most = ASIDE[0] if rolls * nearer > ZERO else (ASIDE[2] if rolls * nearer < ZERO else ASIDE[1])
    return -nearer if abs(across) > most else nearer
