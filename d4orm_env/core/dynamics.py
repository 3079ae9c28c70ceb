"""Robot models, each written once in scalar style.

A model is a handful of pure functions on tuples of numbers. They contain no loops, no array library and no float
literals, so that the CPU engine compiles them with numba, the JAX engine traces them over arrays whose last axis is the
sample, and CasADi can differentiate them, all from the same source and in the caller's precision. Mathematical
functions come in through :class:`Ops`.

Sources: paper, section IV-B (the double integrators and the differential drive) and section VIII-D (the first-order
holonomic ground robots).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

SPEED, ACCELERATION, TURN_RATE = range(3)
"""Columns of a robot's limits: speed [m/s], acceleration [m/s^2], turn rate [rad/s]."""


class Ops(NamedTuple):
    """The mathematical functions a model may call, from whichever library compiles it."""

    cos: Callable[..., Any]
    sin: Callable[..., Any]
    sqrt: Callable[..., Any]
    minimum: Callable[..., Any]
    maximum: Callable[..., Any]
    arctan2: Callable[..., Any]
    where: Callable[..., Any]
    """``(condition, a, b) -> a`` where the condition holds, ``b`` elsewhere."""


class ModelFunctions(NamedTuple):
    """What a model computes. ``x`` is the state tuple, ``u`` the control tuple, ``limits`` the robot's three limits."""

    derivative: Callable[..., Any]
    """``(x, u, ops) -> dx/dt``."""
    limit_control: Callable[..., Any]
    """``(u, limits, ops) -> u`` inside the robot's limits."""
    limit_state: Callable[..., Any]
    """``(x, limits, ops) -> x`` at no more than the speed limit."""
    velocity: Callable[..., Any]
    """``(x, u, ops) -> `` velocity vector in the world frame [m/s]."""
    rest: Callable[..., Any]
    """``(x, zero) -> x`` standing still at the same place and heading."""
    integrate: Callable[..., Any]
    """``(x, u, h, ops) -> x`` after a :class:`~d4orm_env.core.transition.TimeStep`: what classical Runge-Kutta makes of
    the derivative with the control held constant, written out without the terms that cancel.
    """
    approach: Callable[..., Any]
    """``(x, goal, limits, h, ops) -> `` fastest velocity straight to the goal from which it can stop there [m/s]."""
    track: Callable[..., Any]
    """``(x, velocity, limits, h, ops) -> u`` that would bring it to a velocity within a step; it may exceed the limits.
    """


@dataclass(frozen=True)
class Model:
    """A robot model: its sizes, the meaning of its components and its functions.

    Attributes:
        name: Registry name.
        dimension: Position dimensions ``d``, 2 or 3; the first ``d`` state components are the position [m].
        state_names: One name per state component; ``len`` is the model's state size.
        control_names: One name per control component; ``len`` is the model's control size.
        control_limits: Column of the robot's limits that bounds each control component.
        heading_index: State component holding the heading [rad], or ``None`` for a model without one.
        speed_indices: State components holding velocity or speed [m/s].
        functions: The scalar-style functions.
    """

    name: str
    dimension: int
    state_names: tuple[str, ...]
    control_names: tuple[str, ...]
    control_limits: tuple[int, ...]
    heading_index: int | None
    speed_indices: tuple[int, ...]
    functions: ModelFunctions

    @property
    def state_size(self) -> int:
        return len(self.state_names)

    @property
    def control_size(self) -> int:
        return len(self.control_names)


def norm_scale(square: Any, limit: Any, ops: Ops) -> Any:
    """Factor that brings a vector of this squared length to at most ``limit``; exactly one for a shorter vector."""
    return limit / ops.sqrt(ops.maximum(square, limit * limit))


def control_scale(square: Any, limit: Any, ops: Ops) -> Any:
    """As :func:`norm_scale`; NaN where the square has overflowed, lest the control pass for none at all."""
    return norm_scale(square, limit, ops) + (square - square)


def clip(value: Any, limit: Any, ops: Ops) -> Any:
    return ops.maximum(-limit, ops.minimum(limit, value))


def stopping_speed(distance: Any, limits: Any, h: Any, ops: Ops) -> Any:
    """Fastest speed from which a robot with a limited acceleration stops within a distance."""
    acceleration = limits[ACCELERATION]
    # Braking begins with the next step.
    lost = acceleration * h.half
    return ops.minimum(limits[SPEED], ops.sqrt((acceleration + acceleration) * distance + lost * lost) - lost)


def share(part: Any, whole: Any, other: Any, ops: Ops) -> Any:
    """``part / whole``, and no division by zero where both are: ``other`` is any number but zero."""
    return part / ops.where(whole > 0, whole, other)


# Double integrator in the plane: x = [px, py, vx, vy], u = [ax, ay].


def holonomic2d_derivative(x: Any, u: Any, ops: Ops) -> Any:
    return (x[2], x[3], u[0], u[1])


# A constant acceleration gives a parabola, which Runge-Kutta follows exactly.


def holonomic2d_integrate(x: Any, u: Any, h: Any, ops: Ops) -> Any:
    return (
        x[0] + h.full * (x[2] + h.half * u[0]),
        x[1] + h.full * (x[3] + h.half * u[1]),
        x[2] + h.full * u[0],
        x[3] + h.full * u[1],
    )


def holonomic2d_limit_control(u: Any, limits: Any, ops: Ops) -> Any:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[ACCELERATION], ops)
    return (u[0] * scale, u[1] * scale)


def holonomic2d_limit_state(x: Any, limits: Any, ops: Ops) -> Any:
    scale = norm_scale(x[2] * x[2] + x[3] * x[3], limits[SPEED], ops)
    return (x[0], x[1], x[2] * scale, x[3] * scale)


def holonomic2d_velocity(x: Any, u: Any, ops: Ops) -> Any:
    return (x[2], x[3])


def holonomic2d_rest(x: Any, zero: Any) -> Any:
    return (x[0], x[1], zero, zero)


def holonomic2d_approach(x: Any, goal: Any, limits: Any, h: Any, ops: Ops) -> Any:
    gap_x, gap_y = goal[0] - x[0], goal[1] - x[1]
    distance = ops.sqrt(gap_x * gap_x + gap_y * gap_y)
    pace = share(stopping_speed(distance, limits, h, ops), distance, h.full, ops)
    return (gap_x * pace, gap_y * pace)


def holonomic2d_track(x: Any, velocity: Any, limits: Any, h: Any, ops: Ops) -> Any:
    return ((velocity[0] - x[2]) / h.full, (velocity[1] - x[3]) / h.full)


# Double integrator in space: x = [px, py, pz, vx, vy, vz], u = [ax, ay, az].


def holonomic3d_derivative(x: Any, u: Any, ops: Ops) -> Any:
    return (x[3], x[4], x[5], u[0], u[1], u[2])


def holonomic3d_integrate(x: Any, u: Any, h: Any, ops: Ops) -> Any:
    return (
        x[0] + h.full * (x[3] + h.half * u[0]),
        x[1] + h.full * (x[4] + h.half * u[1]),
        x[2] + h.full * (x[5] + h.half * u[2]),
        x[3] + h.full * u[0],
        x[4] + h.full * u[1],
        x[5] + h.full * u[2],
    )


def holonomic3d_limit_control(u: Any, limits: Any, ops: Ops) -> Any:
    scale = control_scale(u[0] * u[0] + u[1] * u[1] + u[2] * u[2], limits[ACCELERATION], ops)
    return (u[0] * scale, u[1] * scale, u[2] * scale)


def holonomic3d_limit_state(x: Any, limits: Any, ops: Ops) -> Any:
    scale = norm_scale(x[3] * x[3] + x[4] * x[4] + x[5] * x[5], limits[SPEED], ops)
    return (x[0], x[1], x[2], x[3] * scale, x[4] * scale, x[5] * scale)


def holonomic3d_velocity(x: Any, u: Any, ops: Ops) -> Any:
    return (x[3], x[4], x[5])


def holonomic3d_rest(x: Any, zero: Any) -> Any:
    return (x[0], x[1], x[2], zero, zero, zero)


def holonomic3d_approach(x: Any, goal: Any, limits: Any, h: Any, ops: Ops) -> Any:
    gap_x, gap_y, gap_z = goal[0] - x[0], goal[1] - x[1], goal[2] - x[2]
    distance = ops.sqrt(gap_x * gap_x + gap_y * gap_y + gap_z * gap_z)
    pace = share(stopping_speed(distance, limits, h, ops), distance, h.full, ops)
    return (gap_x * pace, gap_y * pace, gap_z * pace)


def holonomic3d_track(x: Any, velocity: Any, limits: Any, h: Any, ops: Ops) -> Any:
    return ((velocity[0] - x[3]) / h.full, (velocity[1] - x[4]) / h.full, (velocity[2] - x[5]) / h.full)


# First-order holonomic: x = [px, py], u = [vx, vy].


def velocity2d_derivative(x: Any, u: Any, ops: Ops) -> Any:
    return (u[0], u[1])


def velocity2d_integrate(x: Any, u: Any, h: Any, ops: Ops) -> Any:
    return (x[0] + h.full * u[0], x[1] + h.full * u[1])


def velocity2d_limit_control(u: Any, limits: Any, ops: Ops) -> Any:
    scale = control_scale(u[0] * u[0] + u[1] * u[1], limits[SPEED], ops)
    return (u[0] * scale, u[1] * scale)


def velocity2d_limit_state(x: Any, limits: Any, ops: Ops) -> Any:
    return x


def velocity2d_velocity(x: Any, u: Any, ops: Ops) -> Any:
    return (u[0], u[1])


def velocity2d_rest(x: Any, zero: Any) -> Any:
    return x


def velocity2d_approach(x: Any, goal: Any, limits: Any, h: Any, ops: Ops) -> Any:
    gap_x, gap_y = goal[0] - x[0], goal[1] - x[1]
    distance = ops.sqrt(gap_x * gap_x + gap_y * gap_y)
    # It stops at once, and need only not overshoot within a step.
    pace = share(ops.minimum(limits[SPEED], distance / h.full), distance, h.full, ops)
    return (gap_x * pace, gap_y * pace)


def velocity2d_track(x: Any, velocity: Any, limits: Any, h: Any, ops: Ops) -> Any:
    return velocity


# Differential drive: x = [px, py, heading, speed], u = [turn rate, acceleration].


def differential_drive_derivative(x: Any, u: Any, ops: Ops) -> Any:
    return (x[3] * ops.cos(x[2]), x[3] * ops.sin(x[2]), u[0], u[1])


def differential_drive_integrate(x: Any, u: Any, h: Any, ops: Ops) -> Any:
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


def differential_drive_limit_control(u: Any, limits: Any, ops: Ops) -> Any:
    return (clip(u[0], limits[TURN_RATE], ops), clip(u[1], limits[ACCELERATION], ops))


def differential_drive_limit_state(x: Any, limits: Any, ops: Ops) -> Any:
    return (x[0], x[1], x[2], clip(x[3], limits[SPEED], ops))


def differential_drive_velocity(x: Any, u: Any, ops: Ops) -> Any:
    return (x[3] * ops.cos(x[2]), x[3] * ops.sin(x[2]))


def differential_drive_rest(x: Any, zero: Any) -> Any:
    return (x[0], x[1], x[2], zero)


def differential_drive_track(x: Any, velocity: Any, limits: Any, h: Any, ops: Ops) -> Any:
    """Turn to the wanted direction, and drive as fast as it faces that way."""
    facing_x, facing_y = ops.cos(x[2]), ops.sin(x[2])
    along = facing_x * velocity[0] + facing_y * velocity[1]
    across = facing_x * velocity[1] - facing_y * velocity[0]
    none = along - along
    # To stand still no heading is better than the present one.
    turn = ops.where(along * along + across * across > 0, ops.arctan2(across, along), none)
    return (clip(turn / h.full, limits[TURN_RATE], ops), (ops.maximum(along, none) - x[3]) / h.full)


MODELS: dict[str, Model] = {
    model.name: model
    for model in (
        Model(
            name="holonomic2d",
            dimension=2,
            state_names=("px", "py", "vx", "vy"),
            control_names=("ax", "ay"),
            control_limits=(ACCELERATION, ACCELERATION),
            heading_index=None,
            speed_indices=(2, 3),
            functions=ModelFunctions(
                holonomic2d_derivative,
                holonomic2d_limit_control,
                holonomic2d_limit_state,
                holonomic2d_velocity,
                holonomic2d_rest,
                holonomic2d_integrate,
                holonomic2d_approach,
                holonomic2d_track,
            ),
        ),
        Model(
            name="holonomic3d",
            dimension=3,
            state_names=("px", "py", "pz", "vx", "vy", "vz"),
            control_names=("ax", "ay", "az"),
            control_limits=(ACCELERATION, ACCELERATION, ACCELERATION),
            heading_index=None,
            speed_indices=(3, 4, 5),
            functions=ModelFunctions(
                holonomic3d_derivative,
                holonomic3d_limit_control,
                holonomic3d_limit_state,
                holonomic3d_velocity,
                holonomic3d_rest,
                holonomic3d_integrate,
                holonomic3d_approach,
                holonomic3d_track,
            ),
        ),
        Model(
            name="velocity2d",
            dimension=2,
            state_names=("px", "py"),
            control_names=("vx", "vy"),
            control_limits=(SPEED, SPEED),
            heading_index=None,
            speed_indices=(),
            functions=ModelFunctions(
                velocity2d_derivative,
                velocity2d_limit_control,
                velocity2d_limit_state,
                velocity2d_velocity,
                velocity2d_rest,
                velocity2d_integrate,
                velocity2d_approach,
                velocity2d_track,
            ),
        ),
        Model(
            name="differential_drive",
            dimension=2,
            state_names=("px", "py", "heading", "speed"),
            control_names=("turn_rate", "acceleration"),
            control_limits=(TURN_RATE, ACCELERATION),
            heading_index=2,
            speed_indices=(3,),
            functions=ModelFunctions(
                differential_drive_derivative,
                differential_drive_limit_control,
                differential_drive_limit_state,
                differential_drive_velocity,
                differential_drive_rest,
                differential_drive_integrate,
                holonomic2d_approach,
                differential_drive_track,
            ),
        ),
    )
}
"""All robot models by name, in the order of their codes."""

MODEL_CODES: dict[str, int] = {name: code for code, name in enumerate(MODELS)}


def get_model(name: str) -> Model:
    """Look a model up by name.

    Raises:
        ValueError: If there is no such model; the message lists those there are.
    """
    try:
        return MODELS[name]
    except KeyError:
        raise ValueError(f"model {name!r} is unknown; choose one of {', '.join(MODELS)}") from None
