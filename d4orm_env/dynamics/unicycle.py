"""A unicycle of first order: ``x = [px, py, heading]``, ``u = [speed, turn rate]``, both taken at once."""

from __future__ import annotations

from d4orm_env.dynamics.formulas import (
    at_once,
    clip,
    commanded_drive,
    first_order_approach,
    turn_towards,
    without_limit,
)
from d4orm_env.dynamics.robot_model import SPEED, TURN_RATE, Model, ModelFunctions, Ops, TimeStep, Vector


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
