"""A first-order holonomic ground robot: ``x = [px, py]``, ``u = [vx, vy]`` (paper, section VIII-E)."""

from __future__ import annotations

from d4orm_env.dynamics.formulas import at_once, control_scale, first_order_approach, without_limit
from d4orm_env.dynamics.robot_model import SPEED, Model, ModelFunctions, Ops, TimeStep, Vector


def _derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (u[0], u[1])


def _integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    return (x[0] + h.full * u[0], x[1] + h.full * u[1])


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[SPEED], ops)
    return (u[0] * scale, u[1] * scale)


def _velocity(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (u[0], u[1])


def _track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    return velocity


VELOCITY2D = Model(
    name="velocity2d",
    dimension=2,
    state_names=("px", "py"),
    control_names=("vx", "vy"),
    control_limits=(SPEED, SPEED),
    heading_index=None,
    speed_indices=(),
    functions=ModelFunctions(
        _derivative, _limit_control, without_limit, _velocity, at_once, first_order_approach, _track, _integrate
    ),
)
