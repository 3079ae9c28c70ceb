"""A unicycle of second order: ``x = [px, py, heading, speed, turn rate]``, ``u = [acceleration, turn acceleration]``.

It reverses, and turns right, at limits of its own.
"""

from __future__ import annotations

import math

from d4orm_env.dynamics.formulas import between, clip, limit_drive, planar_approach, present_drive, turn_towards
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


def _derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[3] * ops.cos(x[2]), x[3] * ops.sin(x[2]), x[4], u[0], u[1])


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (clip(u[0], limits[ACCELERATION], ops), clip(u[1], limits[MAX_TURN_ACCELERATION], ops))


def _limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    speed = limit_drive(x[3], limits, limits[MAX_REVERSE_SPEED], ops)
    return (x[0], x[1], x[2], speed, between(x[4], -limits[MAX_RIGHT_TURN_RATE], limits[TURN_RATE], ops))


def _rest(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], x[2], zero, zero)


def _track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
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
    functions=ModelFunctions(_derivative, _limit_control, _limit_state, present_drive, _rest, planar_approach, _track),
    own_limits=(
        Limit("max_reverse_speed", 0.5),
        Limit("max_right_turn_rate", math.pi / 2),
        Limit("max_turn_acceleration", math.pi),
    ),
    state_limits=((4, TURN_RATE),),
    lower_limits=((SPEED, MAX_REVERSE_SPEED), (TURN_RATE, MAX_RIGHT_TURN_RATE)),
)
