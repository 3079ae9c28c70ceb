"""A differential drive: ``x = [px, py, heading, speed]``, ``u = [turn rate, acceleration]`` (paper, section IV-B)."""

from __future__ import annotations

from d4orm_env.dynamics.formulas import clip, limit_drive, planar_approach, present_drive, turn_towards
from d4orm_env.dynamics.robot_model import (
    ACCELERATION,
    OWN_LIMITS,
    SPEED,
    TURN_RATE,
    UNLIMITED,
    Limit,
    Model,
    ModelFunctions,
    Number,
    Ops,
    TimeStep,
    Vector,
)

MAX_REVERSE_SPEED = OWN_LIMITS


def _derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[3] * ops.cos(x[2]), x[3] * ops.sin(x[2]), u[0], u[1])


def _integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
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


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (clip(u[0], limits[TURN_RATE], ops), clip(u[1], limits[ACCELERATION], ops))


def _limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[0], x[1], x[2], limit_drive(x[3], limits, limits[MAX_REVERSE_SPEED], ops))


def _rest(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], x[2], zero)


def _track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
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
        _derivative, _limit_control, _limit_state, present_drive, _rest, planar_approach, _track, _integrate
    ),
    own_limits=(Limit("max_reverse_speed", UNLIMITED),),
    lower_limits=((SPEED, MAX_REVERSE_SPEED),),
)
