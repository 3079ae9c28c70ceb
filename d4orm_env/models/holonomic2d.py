"""A double integrator in the plane: ``x = [px, py, vx, vy]``, ``u = [ax, ay]`` (paper, section IV-B)."""

from __future__ import annotations

from typing import Any

from d4orm_env.core.robot_model import (
    ACCELERATION,
    SPEED,
    Model,
    ModelFunctions,
    Ops,
    control_scale,
    norm_scale,
    planar_approach,
)


def _derivative(x: Any, u: Any, limits: Any, ops: Ops) -> Any:
    return (x[2], x[3], u[0], u[1])


# A constant acceleration gives a parabola, which Runge-Kutta follows exactly.


def _integrate(x: Any, u: Any, limits: Any, h: Any, ops: Ops) -> Any:
    return (
        x[0] + h.full * (x[2] + h.half * u[0]),
        x[1] + h.full * (x[3] + h.half * u[1]),
        x[2] + h.full * u[0],
        x[3] + h.full * u[1],
    )


def _limit_control(u: Any, limits: Any, ops: Ops) -> Any:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[ACCELERATION], ops)
    return (u[0] * scale, u[1] * scale)


def _limit_state(x: Any, limits: Any, ops: Ops) -> Any:
    scale = norm_scale(x[2] * x[2] + x[3] * x[3], limits[SPEED], ops)
    return (x[0], x[1], x[2] * scale, x[3] * scale)


def _velocity(x: Any, u: Any, limits: Any, ops: Ops) -> Any:
    return (x[2], x[3])


def _rest(x: Any, zero: Any) -> Any:
    return (x[0], x[1], zero, zero)


def _track(x: Any, velocity: Any, limits: Any, h: Any, ops: Ops) -> Any:
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
        derivative=_derivative,
        limit_control=_limit_control,
        limit_state=_limit_state,
        velocity=_velocity,
        rest=_rest,
        integrate=_integrate,
        approach=planar_approach,
        track=_track,
    ),
)
