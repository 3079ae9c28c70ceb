"""Robots that move in any direction of the plane, driven by their acceleration, velocity or jerk."""

from __future__ import annotations

from d4orm_env.dynamics.formulas import (
    at_once,
    control_scale,
    first_order_approach,
    norm_scale,
    planar_approach,
    without_limit,
)  # fmt: skip
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
)  # fmt: skip

MAX_JERK = OWN_LIMITS


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
"""A double integrator: ``x = [px, py, vx, vy]``, ``u = [ax, ay]`` (paper, section IV-B)."""


def _commanded(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (u[0], u[1])


def _advance(x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    return (x[0] + h.full * u[0], x[1] + h.full * u[1])


def _limit_velocity(u: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[SPEED], ops)
    return (u[0] * scale, u[1] * scale)


def _track_at_once(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
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
        _commanded,
        _limit_velocity,
        without_limit,
        _commanded,
        at_once,
        first_order_approach,
        _track_at_once,
        _advance,
    ),
)
"""First order: ``x = [px, py]``, ``u = [vx, vy]`` (paper, section VIII-D)."""


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
        _jerk_derivative, _jerk_limit_control, _jerk_limit_state, _velocity, _jerk_rest, _jerk_approach, _jerk_track
    ),
    own_limits=(Limit("max_jerk", 4.0),),
    state_limits=((4, ACCELERATION), (5, ACCELERATION)),
)
"""A triple integrator: ``x = [px, py, vx, vy, ax, ay]``, ``u = [jx, jy]``, the jerk [m/s^3]."""
