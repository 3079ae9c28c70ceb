"""The last stretch to a goal, straight and exact: a turn on the spot, a drive, and another turn."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.engine.compiling import compiled
from d4orm_env.engine.elementary import arctan2
from d4orm_planners.manoeuvres.lattice import turned_by

NOWHERE, TURNING, SIDEWAYS = range(3)
"""Robots that cannot turn on the spot and have no last stretch; those that can; those that need not."""
NEAR = 1e-5
"""Distance from the goal that needs no drive [m]."""


class Limits(NamedTuple):
    """What a robot can do.

    Attributes:
        way: One of :data:`NOWHERE`, :data:`TURNING` and :data:`SIDEWAYS`.
        speed: [m/s].
        acceleration: [m/s^2], infinite for first-order robots.
        turn_rate: [rad/s].
        dt: Time step [s].
    """

    way: int
    speed: float
    acceleration: float
    turn_rate: float
    dt: float


class Goal(NamedTuple):
    """A robot's goal.

    Attributes:
        x: [m].
        y: [m].
        heading: [rad], NaN for any.
        radius: Distance at which it is there beyond doubt [m].
        tolerance: The same of its heading [rad].
        speed: The same of its speed [m/s].
        docks: Whether it stays wherever it first is there.
    """

    x: float
    y: float
    heading: float
    radius: float
    tolerance: float
    speed: float
    docks: bool


Snap: TypeAlias = tuple[int, float, int, int, float, float, float, int, float]
"""Steps and angle of the first turn; steps to speed up and at full speed, signed length, and its direction; steps and
angle of the last turn."""


@compiled
def _steps(amount: float, per_step: float) -> int:
    return max(0, int(np.ceil(abs(amount) / per_step - 1e-6)))


@compiled
def snap_of(limits: Limits, goal: Goal, x: float, y: float, heading: float, way: float) -> Snap:
    """The last stretch from a pose at rest, forwards (``way`` is 1) or backwards (-1)."""
    dx, dy = goal.x - x, goal.y - y
    distance = np.sqrt(dx * dx + dy * dy)
    turn, end = 0.0, heading
    if distance > NEAR:
        dx, dy = dx / distance, dy / distance
    else:
        dx, dy, distance = 0.0, 0.0, 0.0
    if limits.way == TURNING:
        if distance > 0.0:
            wanted = np.float64(arctan2(np.float32(way * dy), np.float32(way * dx)))
            turn = turned_by(wanted - heading)
        end = turned_by(goal.heading - heading - turn) if not np.isnan(goal.heading) else 0.0
    else:
        end = 0.0
    ramp, cruise = 0, _steps(distance, limits.speed * limits.dt)
    if distance > 0.0 and limits.acceleration < np.inf:
        ramp = max(1, _steps(limits.speed, limits.acceleration * limits.dt))
        if distance < limits.speed * ramp * limits.dt:
            ramp = max(1, int(np.ceil(np.sqrt(distance / limits.acceleration) / limits.dt - 1e-6)))
        cruise = max(0, cruise - ramp)
    rate = limits.turn_rate * limits.dt
    return _steps(turn, rate), turn, ramp, cruise, way * distance, dx, dy, _steps(end, rate), end


@compiled
def snap_steps(snap: Snap) -> int:
    """Steps that it takes."""
    return snap[0] + 2 * snap[2] + snap[3] + snap[7]


@compiled
def _share(snap: Snap, step: int) -> tuple[float, float]:
    """Share of the drive that is behind after so many steps of it, and the speed as a share of the highest."""
    ramp, cruise = snap[2], snap[3]
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
def snap_pose(limits: Limits, snap: Snap, x: float, y: float, heading: float, step: int) -> tuple[float, ...]:
    """Pose and speed after so many steps of it; the heading is not wound up."""
    turn_steps, turn, ramp, cruise, length, dx, dy, end_steps, end = snap
    if step <= turn_steps and turn_steps > 0:
        return x, y, heading + turn * step / turn_steps, 0.0
    drive = 2 * ramp + cruise
    at = min(step - turn_steps, drive)
    share, pace = _share(snap, at)
    gone, top = share * abs(length), abs(length) / (max(ramp + cruise, 1) * limits.dt)
    faced, late = heading + turn, step - turn_steps - drive
    if late > 0:
        faced, pace = faced + end * late / end_steps, 0.0
    return x + gone * dx, y + gone * dy, faced, pace * top


def snap_controls(limits: Limits, snap: Snap, first_order: bool) -> FloatArray:
    """``(n, 2)`` its controls: speed, or acceleration, and turn rate; for robots without a heading along x and y."""
    turn_steps, turn, ramp, cruise, length, dx, dy, end_steps, end = snap
    rows = [np.tile([0.0, turn / (max(turn_steps, 1) * limits.dt)], (turn_steps, 1))]
    top = length / (max(ramp + cruise, 1) * limits.dt)
    push = top / (max(ramp, 1) * limits.dt)
    pushes = [top] * cruise if first_order else [push] * ramp + [0.0] * cruise + [-push] * ramp
    direction = (dx, dy) if limits.way == SIDEWAYS else (1.0, 0.0)
    rows.append(np.array(pushes).reshape(-1, 1) * np.array([direction]))
    rows.append(np.tile([0.0, end / (max(end_steps, 1) * limits.dt)], (end_steps, 1)))
    return np.concatenate(rows).astype(np.float32)
