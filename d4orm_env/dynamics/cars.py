"""Cars, which cannot turn on the spot, and cars with one to three trailers.

``car`` is the kinematic bicycle, ``x = [px, py, heading, speed, steering]``, ``u = [acceleration, steering rate]``. The
position is the middle of the rear axle, and the heading turns at ``speed tan(steering) / wheelbase``. Source: S. M.
LaValle, *Planning Algorithms*, section 13.1.2.1, with the speed and the steering angle as states.

Cars with trailers have ``x = [px, py, heading, hitch_1, ...]``, ``u = [speed, steering]``, at once. The first trailer
is hitched to the rear axle; each further one is hitched to the axle of the one before it. A hitch angle is what a
trailer's heading lags behind that of the body before it, and a trailer turns at ``speed sin(hitch) / length``, with the
speed of the axle before it (section 13.1.2.4). At its largest hitch angle a trailer is dragged along.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import chain

from d4orm_env.dynamics.formulas import (
    at_once,
    between,
    clip,
    commanded_drive,
    first_order_approach,
    planar_approach,
    present_drive,
    turn_towards,
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

MAX_STEERING, MAX_STEERING_RATE, WHEELBASE = range(OWN_LIMITS, OWN_LIMITS + 3)
MAX_REVERSE_SPEED, HITCH_1, HITCH_2, HITCH_3 = OWN_LIMITS + 1, OWN_LIMITS + 3, OWN_LIMITS + 5, OWN_LIMITS + 7
"""Columns of cars with trailers, which have no steering rate; of a hitch the largest angle, in the next one its length.
"""
_STEERING, _WHEELBASE = Limit("max_steering", 0.6, most=1.5), Limit("wheelbase", 0.3)


def _derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    turn_rate = x[3] * ops.sin(x[4]) / (ops.cos(x[4]) * limits[WHEELBASE])
    return (x[3] * ops.cos(x[2]), x[3] * ops.sin(x[2]), turn_rate, u[0], u[1])


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (clip(u[0], limits[ACCELERATION], ops), clip(u[1], limits[MAX_STEERING_RATE], ops))


def _limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[0], x[1], x[2], clip(x[3], limits[SPEED], ops), clip(x[4], limits[MAX_STEERING], ops))


def _rest(x: Vector, zero: Number) -> Vector:
    return (x[0], x[1], x[2], zero, x[4])


def _track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """Turn the front to the wanted direction, forwards where that lies ahead and in reverse where it lies behind.

    It drives as fast as wanted wherever it faces, because it turns only as it drives.
    """
    along, turn = turn_towards(x[2], velocity, ops)
    pace = ops.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1])
    ahead = along >= 0
    steering, speed = clip(ops.where(ahead, turn, -turn), limits[MAX_STEERING], ops), ops.where(ahead, pace, -pace)
    return ((speed - x[3]) / h.full, (steering - x[4]) / h.full)


CAR = Model(
    name="car",
    dimension=2,
    state_names=("px", "py", "heading", "speed", "steering"),
    control_names=("acceleration", "steering_rate"),
    control_limits=(ACCELERATION, MAX_STEERING_RATE),
    heading_index=2,
    speed_indices=(3,),
    functions=ModelFunctions(_derivative, _limit_control, _limit_state, present_drive, _rest, planar_approach, _track),
    own_limits=(_STEERING, Limit("max_steering_rate", 1.0), _WHEELBASE),
    state_limits=((4, MAX_STEERING),),
)


def _derivative_1(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    turn_rate = u[0] * ops.sin(u[1]) / (ops.cos(u[1]) * limits[WHEELBASE])
    first = u[0] * ops.sin(x[3]) / limits[HITCH_1 + 1]
    return (u[0] * ops.cos(x[2]), u[0] * ops.sin(x[2]), turn_rate, turn_rate - first)


def _derivative_2(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    turn_rate = u[0] * ops.sin(u[1]) / (ops.cos(u[1]) * limits[WHEELBASE])
    first = u[0] * ops.sin(x[3]) / limits[HITCH_1 + 1]
    second = u[0] * ops.cos(x[3]) * ops.sin(x[4]) / limits[HITCH_2 + 1]
    return (u[0] * ops.cos(x[2]), u[0] * ops.sin(x[2]), turn_rate, turn_rate - first, first - second)


def _derivative_3(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    turn_rate = u[0] * ops.sin(u[1]) / (ops.cos(u[1]) * limits[WHEELBASE])
    first = u[0] * ops.sin(x[3]) / limits[HITCH_1 + 1]
    speed = u[0] * ops.cos(x[3])
    second = speed * ops.sin(x[4]) / limits[HITCH_2 + 1]
    third = speed * ops.cos(x[4]) * ops.sin(x[5]) / limits[HITCH_3 + 1]
    return (u[0] * ops.cos(x[2]), u[0] * ops.sin(x[2]), turn_rate, turn_rate - first, first - second, second - third)


def _limit_at_once(u: Vector, limits: Vector, ops: Ops) -> Vector:
    reverse = ops.minimum(limits[MAX_REVERSE_SPEED], limits[SPEED])
    return (between(u[0], -reverse, limits[SPEED], ops), clip(u[1], limits[MAX_STEERING], ops))


def _limit_state_1(x: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[0], x[1], x[2], clip(x[3], limits[HITCH_1], ops))


def _limit_state_2(x: Vector, limits: Vector, ops: Ops) -> Vector:
    return (x[0], x[1], x[2], clip(x[3], limits[HITCH_1], ops), clip(x[4], limits[HITCH_2], ops))


def _limit_state_3(x: Vector, limits: Vector, ops: Ops) -> Vector:
    return (
        x[0],
        x[1],
        x[2],
        clip(x[3], limits[HITCH_1], ops),
        clip(x[4], limits[HITCH_2], ops),
        clip(x[5], limits[HITCH_3], ops),
    )


def _track_at_once(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    """Turn the front to the wanted direction, forwards where that lies ahead and in reverse where it lies behind."""
    along, turn = turn_towards(x[2], velocity, ops)
    pace = ops.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1])
    ahead = along >= 0
    return (ops.where(ahead, pace, -pace), clip(ops.where(ahead, turn, -turn), limits[MAX_STEERING], ops))


def _hitch_limits(number: int) -> tuple[Limit, Limit]:
    return Limit(f"max_hitch_angle_{number}", math.pi / 4, most=math.pi / 2), Limit(f"hitch_length_{number}", 0.5)


def _car(derivative: Callable[..., Vector], limit_state: Callable[..., Vector], count: int) -> Model:
    numbers, columns = range(1, count + 1), (HITCH_1, HITCH_2, HITCH_3)[:count]
    return Model(
        name=f"car_with_{count}_trailer" + "s" * (count > 1),
        dimension=2,
        state_names=("px", "py", "heading", *(f"hitch_{number}" for number in numbers)),
        control_names=("speed", "steering"),
        control_limits=(SPEED, MAX_STEERING),
        heading_index=2,
        speed_indices=(),
        functions=ModelFunctions(
            derivative, _limit_at_once, limit_state, commanded_drive, at_once, first_order_approach, _track_at_once
        ),
        own_limits=(_STEERING, Limit("max_reverse_speed", 0.5), _WHEELBASE, *chain(*map(_hitch_limits, numbers))),
        state_limits=tuple((2 + number, column) for number, column in zip(numbers, columns)),
        lower_limits=((SPEED, MAX_REVERSE_SPEED),),
        trailers=tuple((2 + number, column + 1) for number, column in zip(numbers, columns)),
    )


CARS_WITH_TRAILERS = (
    _car(_derivative_1, _limit_state_1, 1),
    _car(_derivative_2, _limit_state_2, 2),
    _car(_derivative_3, _limit_state_3, 3),
)
"""With one, two and three."""
