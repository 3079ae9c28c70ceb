"""The last stretch to a goal, straight and exact: a turn on the spot, a drive, and another turn."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.engine.compiling import compiled
from d4orm_env.engine.elementary import arctan2
from d4orm_planners.manoeuvres.lattice import turned_by

NOWHERE, TURNING, SIDEWAYS, CURVING = range(4)
"""Robots that cannot turn on the spot and have no last stretch; those that can; those that need not; and first-order
cars, whose last stretch is in :mod:`~d4orm_planners.manoeuvres.curves`."""
NEAR = 1e-3  #: Distance from the goal that needs no drive, as a share of the goal radius


class Limits(NamedTuple):
    """Abilities of a robot."""

    way: int  #: One of :data:`NOWHERE`, :data:`TURNING`, :data:`SIDEWAYS` and :data:`CURVING`
    speed: float  #: [m/s]
    reverse: float  #: Speed backwards [m/s]
    acceleration: float  #: [m/s^2], infinite for first-order robots
    left: float  #: Turn rate to the left [rad/s]
    right: float  #: The same to the right
    turn_acceleration: float  #: [rad/s^2], infinite for robots that take any turn rate at once
    dt: float  #: Time step [s]


class Goal(NamedTuple):
    """A robot's goal."""

    x: float  #: [m]
    y: float  #: [m]
    heading: float  #: [rad], NaN for any
    hitches: tuple[float, float, float]  #: Hitch angles [rad], NaN for any
    radius: float  #: Distance at which the robot has arrived beyond doubt [m]
    tolerance: float  #: The same of its heading [rad]
    speed: float  #: The same of its speed [m/s]
    docks: bool  #: Whether the robot stays wherever it first arrives


Leg: TypeAlias = tuple[int, int, float]
"""Steps to speed up, and as many to brake; those at full speed; and the signed length or angle."""
Snap: TypeAlias = tuple[Leg, Leg, Leg, float, float]
"""The first turn, the drive, the last turn, and the direction of the drive."""


@compiled
def _steps(amount: float, per_step: float) -> int:
    return max(0, int(np.ceil(abs(amount) / per_step - 1e-6)))


@compiled
def _leg(amount: float, speed: float, acceleration: float, dt: float) -> Leg:
    """From rest to rest."""
    length, ramp, cruise = abs(amount), 0, _steps(amount, speed * dt)
    if length > 0.0 and acceleration < np.inf:
        ramp = max(1, _steps(speed, acceleration * dt))
        if length < speed * ramp * dt:
            ramp = max(1, int(np.ceil(np.sqrt(length / acceleration) / dt - 1e-6)))
        cruise = max(0, cruise - ramp)
    return ramp, cruise, amount


@compiled
def _turn(limits: Limits, angle: float) -> Leg:
    return _leg(angle, limits.left if angle > 0 else limits.right, limits.turn_acceleration, limits.dt)


@compiled
def _leg_steps(leg: Leg) -> int:
    return 2 * leg[0] + leg[1]


@compiled
def snap_of(limits: Limits, goal: Goal, x: float, y: float, heading: float, way: float) -> Snap:
    """The last stretch from a pose at rest, forwards (``way`` is 1) or backwards (-1)."""
    dx, dy = goal.x - x, goal.y - y
    distance = np.sqrt(dx * dx + dy * dy)
    turn = end = 0.0
    if distance > NEAR * goal.radius:
        dx, dy = dx / distance, dy / distance
    else:
        dx, dy, distance = 0.0, 0.0, 0.0
    if limits.way == TURNING:
        if distance > 0.0:
            wanted = np.float64(arctan2(np.float32(way * dy), np.float32(way * dx)))
            turn = turned_by(wanted - heading)
        end = turned_by(goal.heading - heading - turn) if not np.isnan(goal.heading) else 0.0
    drive = _leg(way * distance, limits.speed if way > 0 else limits.reverse, limits.acceleration, limits.dt)
    return _turn(limits, turn), drive, _turn(limits, end), dx, dy


@compiled
def snap_steps(snap: Snap) -> int:
    """Steps that it takes."""
    return _leg_steps(snap[0]) + _leg_steps(snap[1]) + _leg_steps(snap[2])


@compiled
def _share(leg: Leg, step: int) -> tuple[float, float]:
    """Share of a leg that is behind after so many steps of it, and the speed as a share of the highest."""
    ramp, cruise, _ = leg
    if ramp == 0:
        return step / max(cruise, 1), 1.0
    whole = float(ramp + cruise)
    if step <= ramp:
        return 0.5 * step * step / ramp / whole, step / ramp
    if step <= ramp + cruise:
        return (step - 0.5 * ramp) / whole, 1.0
    left = 2 * ramp + cruise - step
    return 1.0 - 0.5 * left * left / ramp / whole, left / ramp


@compiled
def _gone(leg: Leg, step: int) -> float:
    """Length or angle after so many steps of a leg; before it begins none, and when it has ended all."""
    count = _leg_steps(leg)
    return leg[2] * _share(leg, max(0, min(step, count)))[0] if count > 0 else 0.0


@compiled
def snap_pose(limits: Limits, snap: Snap, x: float, y: float, heading: float, step: int) -> tuple[float, ...]:
    """Position, heading and speed after so many steps of it; the heading is not wound up."""
    turn, drive, end, dx, dy = snap
    at = step - _leg_steps(turn)
    late, gone, pace = at - _leg_steps(drive), abs(_gone(drive, at)), 0.0
    if at > 0 >= late:
        top = abs(drive[2]) / (max(drive[0] + drive[1], 1) * limits.dt)
        pace = _share(drive, at)[1] * top
    return x + gone * dx, y + gone * dy, heading + _gone(turn, step) + _gone(end, late), pace


def _leg_controls(leg: Leg, dt: float, first_order: bool) -> Floats:
    """``(n,)`` speeds or accelerations."""
    ramp, cruise, amount = leg
    top = amount / (max(ramp + cruise, 1) * dt)
    if first_order:
        return np.full(cruise, top)
    push = top / (max(ramp, 1) * dt)
    return np.array([push] * ramp + [0.0] * cruise + [-push] * ramp)


def snap_controls(limits: Limits, snap: Snap) -> FloatArray:
    """``(n, 2)`` its controls: speed, or acceleration, and turn rate, or its change; for robots without a heading along
    x and y.
    """
    turn, drive, end, dx, dy = snap
    turns_at_once = limits.turn_acceleration == np.inf
    direction = (dx, dy) if limits.way == SIDEWAYS else (1.0, 0.0)
    driven = _leg_controls(drive, limits.dt, limits.acceleration == np.inf)
    rows = [np.outer(_leg_controls(leg, limits.dt, turns_at_once), (0.0, 1.0)) for leg in (turn, end)]
    rows.insert(1, np.outer(driven, direction))
    return np.concatenate(rows).astype(np.float32)
