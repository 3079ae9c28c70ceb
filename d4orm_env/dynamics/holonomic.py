"""Robots that move in any direction: integrators of first to third order (paper, sections IV-B and VIII-D).

``velocity2d`` has ``x = [px, py]``, ``u = [vx, vy]``; ``holonomic2d`` and ``holonomic3d`` ``x = [px, .., vx, ..]``,
``u = [ax, ..]``; ``holonomic3d_drag`` is one that the air brakes, its acceleration ``u - drag v`` with ``drag`` in 1/s;
and ``holonomic2d_jerk`` has ``x = [px, py, vx, vy, ax, ay]``, ``u = [jx, jy]``, the jerk [m/s^3].
"""

from __future__ import annotations

from dataclasses import replace

from d4orm_env.dynamics.formulas import (
    at_once,
    control_scale,
    first_order_approach,
    norm_scale,
    planar_approach,
    share,
    stopping_speed,
    without_limit,
)
from d4orm_env.dynamics.robot_model import (
    ACCELERATION,
    OWN_LIMITS,
    SPEED,
    Limit,
    Model,
    ModelFunctions,
    Number,
    Ops,
    TimeStep,
    Vector,
)

DRAG = MAX_JERK = OWN_LIMITS


def _first_derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (u[0], u[1])


def _first_integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    return (x[0] + h.full * u[0], x[1] + h.full * u[1])


def _first_limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[SPEED], ops)
    return (u[0] * scale, u[1] * scale)


def _first_velocity(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (u[0], u[1])


def _first_track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
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
        _first_derivative, _first_limit_control, without_limit, _first_velocity, at_once, first_order_approach,
        _first_track, _first_integrate,
    ),
)  # fmt: skip


def _planar_derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[2], x[3], u[0], u[1])


# A constant acceleration gives a parabola, which Runge-Kutta follows exactly.


def _planar_integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    return (
        x[0] + h.full * (x[2] + h.half * u[0]),
        x[1] + h.full * (x[3] + h.half * u[1]),
        x[2] + h.full * u[0],
        x[3] + h.full * u[1],
    )


def _planar_limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[ACCELERATION], ops)
    return (u[0] * scale, u[1] * scale)


def _planar_limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = norm_scale(x[2] * x[2] + x[3] * x[3], limits[SPEED], ops)
    return (x[0], x[1], x[2] * scale, x[3] * scale)


def _planar_velocity(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[2], x[3])


def _planar_rest(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], zero, zero)


def _planar_track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
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
        _planar_derivative, _planar_limit_control, _planar_limit_state, _planar_velocity, _planar_rest, planar_approach,
        _planar_track, _planar_integrate,
    ),
)  # fmt: skip


def _jerk_derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[2], x[3], x[4], x[5], u[0], u[1])


def _jerk_limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[MAX_JERK], ops)
    return (u[0] * scale, u[1] * scale)


def _jerk_limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    slower = norm_scale(x[2] * x[2] + x[3] * x[3], limits[SPEED], ops)
    weaker = norm_scale(x[4] * x[4] + x[5] * x[5], limits[ACCELERATION], ops)
    return (x[0], x[1], x[2] * slower, x[3] * slower, x[4] * weaker, x[5] * weaker)


def _jerk_rest(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], zero, zero, zero, zero)


def _jerk_approach(x: Vector, goal: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """As a robot's whose brakes act later, by the time that the acceleration takes from zero to its limit."""
    later = TimeStep(h.full, h.half + limits[ACCELERATION] / limits[MAX_JERK], h.third, h.sixth)
    return planar_approach(x, goal, limits, later, ops)


def _jerk_track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """Aim at the acceleration that closes the gap in twice the time that it takes to rise."""
    delay = limits[ACCELERATION] / limits[MAX_JERK]
    within = h.full + delay + delay
    wanted_x, wanted_y = (velocity[0] - x[2]) / within, (velocity[1] - x[3]) / within
    return ((wanted_x - x[4]) / (h.full + h.half), (wanted_y - x[5]) / (h.full + h.half))


HOLONOMIC2D_JERK = Model(
    name="holonomic2d_jerk",
    dimension=2,
    state_names=("px", "py", "vx", "vy", "ax", "ay"),
    control_names=("jx", "jy"),
    control_limits=(MAX_JERK, MAX_JERK),
    heading_index=None,
    speed_indices=(2, 3),
    functions=ModelFunctions(
        _jerk_derivative, _jerk_limit_control, _jerk_limit_state, _planar_velocity, _jerk_rest, _jerk_approach,
        _jerk_track,
    ),
    own_limits=(Limit("max_jerk", 4.0),),
    state_limits=((4, ACCELERATION), (5, ACCELERATION)),
)  # fmt: skip


def _spatial_derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[3], x[4], x[5], u[0], u[1], u[2])


def _spatial_integrate(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    return (
        x[0] + h.full * (x[3] + h.half * u[0]),
        x[1] + h.full * (x[4] + h.half * u[1]),
        x[2] + h.full * (x[5] + h.half * u[2]),
        x[3] + h.full * u[0],
        x[4] + h.full * u[1],
        x[5] + h.full * u[2],
    )


def _spatial_limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = control_scale(u[0] * u[0] + u[1] * u[1] + u[2] * u[2], limits[ACCELERATION], ops)
    return (u[0] * scale, u[1] * scale, u[2] * scale)


def _spatial_limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = norm_scale(x[3] * x[3] + x[4] * x[4] + x[5] * x[5], limits[SPEED], ops)
    return (x[0], x[1], x[2], x[3] * scale, x[4] * scale, x[5] * scale)


def _spatial_velocity(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[3], x[4], x[5])


def _spatial_rest(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], x[2], zero, zero, zero)


def _spatial_approach(x: Vector, goal: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    gap_x, gap_y, gap_z = goal[0] - x[0], goal[1] - x[1], goal[2] - x[2]
    distance = ops.sqrt(gap_x * gap_x + gap_y * gap_y + gap_z * gap_z)
    pace = share(stopping_speed(distance, limits, h, ops), distance, h.full, ops)
    return (gap_x * pace, gap_y * pace, gap_z * pace)


def _spatial_track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
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
        _spatial_derivative, _spatial_limit_control, _spatial_limit_state, _spatial_velocity, _spatial_rest,
        _spatial_approach, _spatial_track, _spatial_integrate,
    ),
)  # fmt: skip


def _drag_derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    drag = limits[DRAG]
    return (x[3], x[4], x[5], u[0] - drag * x[3], u[1] - drag * x[4], u[2] - drag * x[5])


def _drag_track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    drag = limits[DRAG]
    return (
        (velocity[0] - x[3]) / h.full + drag * x[3],
        (velocity[1] - x[4]) / h.full + drag * x[4],
        (velocity[2] - x[5]) / h.full + drag * x[5],
    )


HOLONOMIC3D_DRAG = replace(
    HOLONOMIC3D,
    name="holonomic3d_drag",
    functions=HOLONOMIC3D.functions._replace(derivative=_drag_derivative, track=_drag_track, integrate=None),
    own_limits=(Limit("drag", 0.5),),
)
