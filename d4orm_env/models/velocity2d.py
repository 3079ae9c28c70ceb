"""A first-order holonomic ground robot: ``x = [px, py]``, ``u = [vx, vy]`` (paper, section VIII-D)."""

from __future__ import annotations

from typing import Any

from d4orm_env.core.robot_model import (
    SPEED,
    Model,
    ModelFunctions,
    Ops,
    control_scale,
    first_order_approach,
)


def _derivative(x: Any, u: Any, limits: Any, ops: Ops) -> Any:
    return (u[0], u[1])


def _integrate(x: Any, u: Any, limits: Any, h: Any, ops: Ops) -> Any:
    return (x[0] + h.full * u[0], x[1] + h.full * u[1])


def _limit_control(u: Any, limits: Any, ops: Ops) -> Any:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[SPEED], ops)
    return (u[0] * scale, u[1] * scale)


def _limit_state(x: Any, limits: Any, ops: Ops) -> Any:
    return x


def _velocity(x: Any, u: Any, limits: Any, ops: Ops) -> Any:
    return (u[0], u[1])


def _rest(x: Any, zero: Any) -> Any:
    return x


def _track(x: Any, velocity: Any, limits: Any, h: Any, ops: Ops) -> Any:
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
        derivative=_derivative,
        limit_control=_limit_control,
        limit_state=_limit_state,
        velocity=_velocity,
        rest=_rest,
        integrate=_integrate,
        approach=first_order_approach,
        track=_track,
    ),
)
