"""A double integrator in space: ``x = [px, py, pz, vx, vy, vz]``, ``u = [ax, ay, az]`` (paper, section IV-B)."""

from __future__ import annotations

from d4orm_env.dynamics.formulas import control_scale, norm_scale, share, stopping_speed
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, Model, ModelFunctions, Number, Ops, TimeStep, Vector


def _derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[3], x[4], x[5], u[0], u[1], u[2])


def _integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    return (
        x[0] + h.full * (x[3] + h.half * u[0]),
        x[1] + h.full * (x[4] + h.half * u[1]),
        x[2] + h.full * (x[5] + h.half * u[2]),
        x[3] + h.full * u[0],
        x[4] + h.full * u[1],
        x[5] + h.full * u[2],
    )


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = control_scale(u[0] * u[0] + u[1] * u[1] + u[2] * u[2], limits[ACCELERATION], ops)
    return (u[0] * scale, u[1] * scale, u[2] * scale)


def _limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = norm_scale(x[3] * x[3] + x[4] * x[4] + x[5] * x[5], limits[SPEED], ops)
    return (x[0], x[1], x[2], x[3] * scale, x[4] * scale, x[5] * scale)


def _velocity(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[3], x[4], x[5])


def _rest(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], x[2], zero, zero, zero)


def _approach(x: Vector, goal: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    gap_x, gap_y, gap_z = goal[0] - x[0], goal[1] - x[1], goal[2] - x[2]
    distance = ops.sqrt(gap_x * gap_x + gap_y * gap_y + gap_z * gap_z)
    pace = share(stopping_speed(distance, limits, h, ops), distance, h.full, ops)
    return (gap_x * pace, gap_y * pace, gap_z * pace)


def _track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    return ((velocity[0] - x[3]) / h.full, (velocity[1] - x[4]) / h.full, (velocity[2] - x[5]) / h.full)


HOLONOMIC3D = Model(
    name="holonomic3d",
    dimension=3,
    state_names=("px", "py", "pz", "vx", "vy", "vz"),
    control_names=("ax", "ay", "az"),
    control_limits=(ACCELERATION, ACCELERATION, ACCELERATION),
    heading_index=None,
    speed_indices=(3, 4, 5),
    functions=ModelFunctions(
        _derivative, _limit_control, _limit_state, _velocity, _rest, _approach, _track, _integrate
    ),
)
