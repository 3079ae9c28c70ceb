"""Robots that turn in place and drive where they face: unicycles of first and second order, and differential drives.

``unicycle`` has ``x = [px, py, heading]``, ``u = [speed, turn rate]``, both taken at once, and ``unicycle1`` is one
that reverses, and turns right, at limits of its own, as ``unicycle2`` does: ``x = [px, py, heading, speed, turn
rate]``, ``u = [acceleration, turn acceleration]``. ``differential_drive`` has ``x = [px, py, heading, speed]``, ``u =
[turn rate, acceleration]`` (paper, section IV-B).
"""

from __future__ import annotations

import math
from dataclasses import replace

from d4orm_env.dynamics.formulas import (
    at_once,
    between,
    clip,
    commanded_drive,
    first_order_approach,
    planar_approach,
    present_drive,
    turn_towards,
    without_limit,
)
from d4orm_env.dynamics.robot_model import (
    ACCELERATION,
    OWN_LIMITS,
    SPEED,
    TURN_RATE,
    Limit,
    Model,
    ModelFunctions,
    Number,
    Ops,
    TimeStep,
    Vector,
)

MAX_REVERSE_SPEED, MAX_RIGHT_TURN_RATE, MAX_TURN_ACCELERATION = range(OWN_LIMITS, OWN_LIMITS + 3)
_BACKWARDS = (Limit("max_reverse_speed", 0.5), Limit("max_right_turn_rate", math.pi / 2))
_LOWER_LIMITS = ((SPEED, MAX_REVERSE_SPEED), (TURN_RATE, MAX_RIGHT_TURN_RATE))


def _derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (u[0] * ops.cos(x[2]), u[0] * ops.sin(x[2]), u[1])


def _integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    # Two of the four stages of Runge-Kutta are the same: what remains is Simpson's rule.
    middle, end = x[2] + h.half * u[1], x[2] + h.full * u[1]
    along, twice = h.sixth * u[0], h.third * (u[0] + u[0])
    return (
        x[0] + (along * (ops.cos(x[2]) + ops.cos(end)) + twice * ops.cos(middle)),
        x[1] + (along * (ops.sin(x[2]) + ops.sin(end)) + twice * ops.sin(middle)),
        end,
    )


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (clip(u[0], limits[SPEED], ops), clip(u[1], limits[TURN_RATE], ops))


def _track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """Turn to the wanted direction, and drive as fast as it faces that way."""
    along, turn = turn_towards(x[2], velocity, ops)
    return (ops.maximum(along, along - along), clip(turn / h.full, limits[TURN_RATE], ops))


UNICYCLE = Model(
    name="unicycle",
    dimension=2,
    state_names=("px", "py", "heading"),
    control_names=("speed", "turn_rate"),
    control_limits=(SPEED, TURN_RATE),
    heading_index=2,
    speed_indices=(),
    functions=ModelFunctions(
        _derivative, _limit_control, without_limit, commanded_drive, at_once, first_order_approach, _track, _integrate
    ),
)


def _limit_both_ways(u: Vector, limits: Vector, ops: Ops) -> Vector:
    reverse = ops.minimum(limits[MAX_REVERSE_SPEED], limits[SPEED])
    return (
        between(u[0], -reverse, limits[SPEED], ops),
        between(u[1], -limits[MAX_RIGHT_TURN_RATE], limits[TURN_RATE], ops),
    )


UNICYCLE1 = replace(
    UNICYCLE,
    name="unicycle1",
    functions=UNICYCLE.functions._replace(limit_control=_limit_both_ways),
    own_limits=_BACKWARDS,
    lower_limits=_LOWER_LIMITS,
)


def _derivative2(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[3] * ops.cos(x[2]), x[3] * ops.sin(x[2]), x[4], u[0], u[1])


def _limit_control2(u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (clip(u[0], limits[ACCELERATION], ops), clip(u[1], limits[MAX_TURN_ACCELERATION], ops))


def _limit_state2(x: Vector, limits: Vector, ops: Ops) -> Vector:
    reverse = ops.minimum(limits[MAX_REVERSE_SPEED], limits[SPEED])
    speed = between(x[3], -reverse, limits[SPEED], ops)
    return (x[0], x[1], x[2], speed, between(x[4], -limits[MAX_RIGHT_TURN_RATE], limits[TURN_RATE], ops))


def _rest2(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], x[2], zero, zero)


def _track2(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """Turn to the wanted direction, from as fast as it can stop turning, and drive as fast as it faces that way."""
    along, turn = turn_towards(x[2], velocity, ops)
    strength = limits[MAX_TURN_ACCELERATION]
    lost, left = strength * h.half, ops.maximum(turn, -turn)
    rate = ops.sqrt((strength + strength) * left + lost * lost) - lost
    rate = between(ops.where(turn >= 0, rate, -rate), -limits[MAX_RIGHT_TURN_RATE], limits[TURN_RATE], ops)
    return ((ops.maximum(along, along - along) - x[3]) / h.full, (rate - x[4]) / h.full)


UNICYCLE2 = Model(
    name="unicycle2",
    dimension=2,
    state_names=("px", "py", "heading", "speed", "turn_rate"),
    control_names=("acceleration", "turn_acceleration"),
    control_limits=(ACCELERATION, MAX_TURN_ACCELERATION),
    heading_index=2,
    speed_indices=(3,),
    functions=ModelFunctions(
        _derivative2, _limit_control2, _limit_state2, present_drive, _rest2, planar_approach, _track2
    ),
    own_limits=(*_BACKWARDS, Limit("max_turn_acceleration", math.pi)),
    state_limits=((4, TURN_RATE),),
    lower_limits=_LOWER_LIMITS,
)


def _drive_derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[3] * ops.cos(x[2]), x[3] * ops.sin(x[2]), u[0], u[1])


def _drive_integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    # The heading turns evenly, so that two of the four stages are the same, and what remains is Simpson's rule. The
    # headings half-way and at the end come from the first one, turned twice by the same angle.
    turn = h.half * u[0]
    turn_x, turn_y = ops.cos(turn), ops.sin(turn)
    x0, y0 = ops.cos(x[2]), ops.sin(x[2])
    x1, y1 = x0 * turn_x - y0 * turn_y, y0 * turn_x + x0 * turn_y
    x2, y2 = x1 * turn_x - y1 * turn_y, y1 * turn_x + x1 * turn_y
    speed1, speed2 = x[3] + h.half * u[1], x[3] + h.full * u[1]
    twice = speed1 + speed1
    return (
        x[0] + (h.sixth * (x[3] * x0 + speed2 * x2) + h.third * (twice * x1)),
        x[1] + (h.sixth * (x[3] * y0 + speed2 * y2) + h.third * (twice * y1)),
        x[2] + h.full * u[0],
        speed2,
    )


def _drive_limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (clip(u[0], limits[TURN_RATE], ops), clip(u[1], limits[ACCELERATION], ops))


def _drive_limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[0], x[1], x[2], clip(x[3], limits[SPEED], ops))


def _drive_rest(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], x[2], zero)


def _drive_track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """Turn to the wanted direction, and drive as fast as it faces that way."""
    along, turn = turn_towards(x[2], velocity, ops)
    return (clip(turn / h.full, limits[TURN_RATE], ops), (ops.maximum(along, along - along) - x[3]) / h.full)


DIFFERENTIAL_DRIVE = Model(
    name="differential_drive",
    dimension=2,
    state_names=("px", "py", "heading", "speed"),
    control_names=("turn_rate", "acceleration"),
    control_limits=(TURN_RATE, ACCELERATION),
    heading_index=2,
    speed_indices=(3,),
    functions=ModelFunctions(
        _drive_derivative, _drive_limit_control, _drive_limit_state, present_drive, _drive_rest, planar_approach,
        _drive_track, _drive_integrate,
    ),
)  # fmt: skip
