"""Cars with up to three trailers: ``x = [px, py, heading, hitch_1, ...]``, ``u = [speed, steering]``, at once.

One without trailers is ``car_first_order``. The position is the middle of the rear axle, where the first trailer is
hitched; each further one is hitched to the axle of the one before it. A hitch angle is what a trailer's heading lags
behind that of the body before it, and a trailer turns at ``speed sin(hitch) / length``, with the speed of the axle
before it. Source: S. M. LaValle, *Planning Algorithms*, section 13.1.2.4. At its largest hitch angle a trailer is
dragged along.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import chain

from d4orm_env.dynamics.formulas import at_once, clip, commanded_drive, first_order_approach, limit_drive, turn_towards
from d4orm_env.dynamics.robot_model import OWN_LIMITS, SPEED, Limit, Model, ModelFunctions, Ops, TimeStep, Vector

MAX_STEERING, MAX_REVERSE_SPEED, WHEELBASE, HITCH_1, HITCH_2, HITCH_3 = (OWN_LIMITS + i for i in (0, 1, 2, 3, 5, 7))
"""Of a hitch the largest angle, in the next column its length."""


def _derivative_0(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    turn_rate = u[0] * ops.sin(u[1]) / (ops.cos(u[1]) * limits[WHEELBASE])
    return (u[0] * ops.cos(x[2]), u[0] * ops.sin(x[2]), turn_rate)


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


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (limit_drive(u[0], limits, limits[MAX_REVERSE_SPEED], ops), clip(u[1], limits[MAX_STEERING], ops))


def _limit_state_0(x: Vector, limits: Vector, ops: Ops) -> Vector:
    return x


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


def _track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
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
        name=f"car_with_{count}_trailer" + "s" * (count > 1) if count else "car_first_order",
        dimension=2,
        state_names=("px", "py", "heading", *(f"hitch_{number}" for number in numbers)),
        control_names=("speed", "steering"),
        control_limits=(SPEED, MAX_STEERING),
        heading_index=2,
        speed_indices=(),
        functions=ModelFunctions(
            derivative, _limit_control, limit_state, commanded_drive, at_once, first_order_approach, _track
        ),
        own_limits=(
            Limit("max_steering", 0.6, most=1.5),
            Limit("max_reverse_speed", 0.5),
            Limit("wheelbase", 0.3),
            *chain(*map(_hitch_limits, numbers)),
        ),
        state_limits=tuple((2 + number, column) for number, column in zip(numbers, columns)),
        lower_limits=((SPEED, MAX_REVERSE_SPEED),),
        trailers=tuple((2 + number, column + 1) for number, column in zip(numbers, columns)),
    )


FIRST_ORDER_CARS = (
    _car(_derivative_1, _limit_state_1, 1),
    _car(_derivative_2, _limit_state_2, 2),
    _car(_derivative_3, _limit_state_3, 3),
    _car(_derivative_0, _limit_state_0, 0),
)
"""With one, two and three trailers, and with none."""
