"""A car, the kinematic bicycle: ``x = [px, py, heading, speed, steering]``, ``u = [acceleration, steering rate]``.

The position is the middle of the rear axle. The heading turns at ``speed tan(steering) / wheelbase``, so that a car
cannot turn on the spot. Source: S. M. LaValle, *Planning Algorithms*, section 13.1.2.1, with the speed and the
steering angle as states.
"""

from __future__ import annotations

from d4orm_env.dynamics.formulas import clip, limit_drive, planar_approach, present_drive, turn_towards
from d4orm_env.dynamics.robot_model import (
    ACCELERATION,
    OWN_LIMITS,
    SPEED,
    UNLIMITED,
    Limit,
    Model,
    ModelFunctions,
    Number,
    Ops,
    TimeStep,
    Vector,
)

MAX_STEERING, MAX_STEERING_RATE, WHEELBASE, MAX_REVERSE_SPEED = range(OWN_LIMITS, OWN_LIMITS + 4)


def _derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    turn_rate = x[3] * ops.sin(x[4]) / (ops.cos(x[4]) * limits[WHEELBASE])
    return (x[3] * ops.cos(x[2]), x[3] * ops.sin(x[2]), turn_rate, u[0], u[1])


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (clip(u[0], limits[ACCELERATION], ops), clip(u[1], limits[MAX_STEERING_RATE], ops))


def _limit_state(x: Vector, limits: Vector, ops: Ops) -> Vector:
    speed = limit_drive(x[3], limits, limits[MAX_REVERSE_SPEED], ops)
    return (x[0], x[1], x[2], speed, clip(x[4], limits[MAX_STEERING], ops))


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
    own_limits=(
        Limit("max_steering", 0.6, most=1.5),
        Limit("max_steering_rate", 1.0),
        Limit("wheelbase", 0.3),
        Limit("max_reverse_speed", UNLIMITED),
    ),
    state_limits=((4, MAX_STEERING),),
    lower_limits=((SPEED, MAX_REVERSE_SPEED),),
)
