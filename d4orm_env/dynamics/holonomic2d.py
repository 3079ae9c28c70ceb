"""A double integrator in the plane: ``x = [px, py, vx, vy]``, ``u = [ax, ay]`` (paper, section IV-B)."""

from __future__ import annotations

from d4orm_env.dynamics.formulas import control_scale, norm_scale, planar_approach
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, Model, ModelFunctions, Number, Ops, TimeStep, Vector


def _derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[2], x[3], u[0], u[1])


# A constant acceleration gives a parabola, which Runge-Kutta follows exactly.


def _integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    return (
        x[0] + h.full * (x[2] + h.half * u[0]),
        x[1] + h.full * (x[3] + h.half * u[1]),
        x[2] + h.full * u[0],
        x[3] + h.full * u[1],
    )


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[ACCELERATION], ops)
    return (u[0] * scale, u[1] * scale)


def _limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = norm_scale(x[2] * x[2] + x[3] * x[3], limits[SPEED], ops)
    return (x[0], x[1], x[2] * scale, x[3] * scale)


def _velocity(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[2], x[3])


def _rest(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], zero, zero)


def _track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    return ((velocity[0] - x[2]) / h.full, (velocity[1] - x[3]) / h.full)


HOLONOMIC2D = Model(
    name="holonomic2d",
    dimension=2,
    state_names=("px", "py", "vx", "vy"),
    control_names=("ax", "ay"),
    control_limits=(ACCELERATION, ACCELERATION),
    heading_index=None,
    speed_indices=(2, 3),
    functions=ModelFunctions(
        _derivative, _limit_control, _limit_state, _velocity, _rest, planar_approach, _track, _integrate
    ),
)
