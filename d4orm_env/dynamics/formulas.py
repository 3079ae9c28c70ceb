"""Formulas that robot models share, in the scalar style of :mod:`d4orm_env.dynamics.robot_model`."""

from __future__ import annotations

from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, Number, Ops, TimeStep, Vector


def norm_scale(square: Number, limit: Number, ops: Ops) -> Number:
    """Factor that brings a vector of this squared length to at most ``limit``; exactly one for a shorter vector."""
    return limit / ops.sqrt(ops.maximum(square, limit * limit))


def control_scale(square: Number, limit: Number, ops: Ops) -> Number:
    """Return :func:`norm_scale`; NaN where the square has overflowed, lest the control pass for none at all."""
    return norm_scale(square, limit, ops) + (square - square)


def clip(value: Number, limit: Number, ops: Ops) -> Number:
    return ops.maximum(-limit, ops.minimum(limit, value))


def between(value: Number, least: Number, most: Number, ops: Ops) -> Number:
    """Return the value, or the bound that it is beyond."""
    return ops.maximum(least, ops.minimum(most, value))


def limit_drive(speed: Number, limits: Vector, reverse: Number, ops: Ops) -> Number:
    """Return a speed within the limits of driving forwards and, no larger, in ``reverse``."""
    return between(speed, -ops.minimum(reverse, limits[SPEED]), limits[SPEED], ops)


def stopping_speed(distance: Number, limits: Vector, h: TimeStep, ops: Ops) -> Number:
    """Fastest speed from which a robot with a limited acceleration stops within a distance."""
    acceleration = limits[ACCELERATION]
    # Braking begins with the next step.
    lost = acceleration * h.half
    return ops.minimum(limits[SPEED], ops.sqrt((acceleration + acceleration) * distance + lost * lost) - lost)


def share(part: Number, whole: Number, other: Number, ops: Ops) -> Number:
    """``part / whole``, and no division by zero where both are: ``other`` is any number but zero."""
    return part / ops.where(whole > 0, whole, other)


def planar_approach(x: Vector, goal: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """:attr:`ModelFunctions.approach` of a planar model with a limited acceleration."""
    gap_x, gap_y = goal[0] - x[0], goal[1] - x[1]
    distance = ops.sqrt(gap_x * gap_x + gap_y * gap_y)
    pace = share(stopping_speed(distance, limits, h, ops), distance, h.full, ops)
    return (gap_x * pace, gap_y * pace)


def first_order_approach(x: Vector, goal: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """:attr:`ModelFunctions.approach` of a planar model that takes a new speed at once."""
    gap_x, gap_y = goal[0] - x[0], goal[1] - x[1]
    distance = ops.sqrt(gap_x * gap_x + gap_y * gap_y)
    # It stops at once, and need only not overshoot within a step.
    pace = share(ops.minimum(limits[SPEED], distance / h.full), distance, h.full, ops)
    return (gap_x * pace, gap_y * pace)


def turn_towards(heading: Number, velocity: Vector, ops: Ops) -> tuple[Number, Number]:
    """The wanted velocity's part along the heading [m/s], and the turn that brings the heading to it [rad]."""
    facing_x, facing_y = ops.cos(heading), ops.sin(heading)
    along = facing_x * velocity[0] + facing_y * velocity[1]
    across = facing_x * velocity[1] - facing_y * velocity[0]
    none = along - along
    # To stand still no heading is better than the present one.
    return along, ops.where(along * along + across * across > 0, ops.arctan2(across, along), none)


def present_drive(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    """:attr:`ModelFunctions.velocity` of a model whose heading and speed are the components 2 and 3 of its state."""
    return (x[3] * ops.cos(x[2]), x[3] * ops.sin(x[2]))


def commanded_drive(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    """The same where the speed is the first component of the control."""
    return (u[0] * ops.cos(x[2]), u[0] * ops.sin(x[2]))


def at_once(x: Vector, zero: Number) -> Vector:
    """:attr:`ModelFunctions.rest` of a model that takes a new speed at once."""
    return x


def without_limit(x: Vector, limits: Vector, ops: Ops) -> Vector:
    """:attr:`ModelFunctions.limit_state` of a model whose state holds nothing to limit."""
    return x
