"""A triple integrator in the plane: ``x = [px, py, vx, vy, ax, ay]``, ``u = [jx, jy]``, the jerk [m/s^3]."""

from __future__ import annotations

from d4orm_env.dynamics.formulas import control_scale, norm_scale, planar_approach
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

MAX_JERK = OWN_LIMITS


def _derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[2], x[3], x[4], x[5], u[0], u[1])


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[MAX_JERK], ops)
    return (u[0] * scale, u[1] * scale)


def _limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    slower = norm_scale(x[2] * x[2] + x[3] * x[3], limits[SPEED], ops)
    weaker = norm_scale(x[4] * x[4] + x[5] * x[5], limits[ACCELERATION], ops)
    return (x[0], x[1], x[2] * slower, x[3] * slower, x[4] * weaker, x[5] * weaker)


def _velocity(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[2], x[3])


def _rest(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], zero, zero, zero, zero)


def _approach(x: Vector, goal: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """As a robot's whose brakes act later, by four times the time that the acceleration takes to rise: with less its
    speed, which follows late, overshoots the goal.
    """
    delay = limits[ACCELERATION] / limits[MAX_JERK]
    later = TimeStep(h.full, h.half + delay + delay + delay + delay, h.third, h.sixth)
    return planar_approach(x, goal, limits, later, ops)


def _track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """Aim at the acceleration that closes the gap in the time that it takes to rise from zero to its limit."""
    within = h.full + limits[ACCELERATION] / limits[MAX_JERK]
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
    functions=ModelFunctions(_derivative, _limit_control, _limit_state, _velocity, _rest, _approach, _track),
    own_limits=(Limit("max_jerk", 4.0),),
    state_limits=((4, ACCELERATION), (5, ACCELERATION)),
)
