"""The unicycle of first order that reverses, and turns right, at limits of its own.

State and control are those of :data:`~d4orm_env.dynamics.unicycle.UNICYCLE`.
"""

from __future__ import annotations

import math
from dataclasses import replace

from d4orm_env.dynamics.formulas import between, limit_drive
from d4orm_env.dynamics.robot_model import OWN_LIMITS, SPEED, TURN_RATE, Limit, Ops, Vector
from d4orm_env.dynamics.unicycle import UNICYCLE

MAX_REVERSE_SPEED, MAX_RIGHT_TURN_RATE = range(OWN_LIMITS, OWN_LIMITS + 2)


def _limit_control(u: Vector, limits: Vector, ops: Ops) -> Vector:
    return (
        limit_drive(u[0], limits, limits[MAX_REVERSE_SPEED], ops),
        between(u[1], -limits[MAX_RIGHT_TURN_RATE], limits[TURN_RATE], ops),
    )


UNICYCLE1 = replace(
    UNICYCLE,
    name="unicycle1",
    functions=UNICYCLE.functions._replace(limit_control=_limit_control),
    own_limits=(Limit("max_reverse_speed", 0.5), Limit("max_right_turn_rate", math.pi / 2)),
    lower_limits=((SPEED, MAX_REVERSE_SPEED), (TURN_RATE, MAX_RIGHT_TURN_RATE)),
)
