"""Angles that do not wind up: one rule for every state, wherever it comes from.

An angle within :data:`MOST_TURNS` turns stays as it is, to the bit. One beyond is taken back by as many turns, so that
float32 resolves every angle to 2e-6 rad however long a robot spins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from d4orm_env.core.arrays import FloatArray

if TYPE_CHECKING:
    from d4orm_env.core.team import Team

MOST_TURNS = 8
"""More than a robot makes in a plan of usual length, and few enough that float32 resolves the angle well."""

MAX_ANGLE = np.float32(2 * np.pi * MOST_TURNS)
"""No angle of a state is larger [rad]."""

# The turns in two parts, of which taking off the first one is exact.
_HIGH = np.float32(50.25)
_LOW = np.float32(2 * np.pi * MOST_TURNS - 50.25)

Numbers = Any
"""Numbers of whichever library calls."""


def unwound(angle: Numbers, ops: Any) -> Numbers:
    """``angle`` within :data:`MAX_ANGLE`, if it is within twice that [rad]."""
    back = ops.where(angle < -MAX_ANGLE, (angle + _HIGH) + _LOW, angle)
    return ops.where(angle > MAX_ANGLE, (angle - _HIGH) - _LOW, back)


def unwound_states(team: Team, states: FloatArray) -> FloatArray:
    """``states`` ``(..., K, n)`` with all angles within :data:`MAX_ANGLE`; a copy if any was not."""
    angles = np.zeros(states.shape[-2:], np.bool_)
    for robot, model in enumerate(team.robot_models):
        angles[robot, list(model.angles)] = True
    wound = angles & (np.abs(states) > MAX_ANGLE)
    if not wound.any():
        return states
    values, within = states[wound].astype(np.float64), states.copy()
    while (np.abs(values) > MAX_ANGLE).any():
        values = unwound(values, np)
    within[wound] = values
    return within


def unwinding(limit_state: Callable[..., Numbers], index: int) -> Callable[..., Numbers]:
    """``limit_state`` of a model followed by :func:`unwound` of one component; compiled code compiles it as well."""
    after = index + 1

    def limit_and_unwind(x: Numbers, limits: Numbers, ops: Any) -> Numbers:
        y = limit_state(x, limits, ops)
        return y[:index] + (unwound(y[index], ops),) + y[after:]  # noqa: RUF005 - numba knows no unpacking here

    return limit_and_unwind


@dataclass(frozen=True)
class Unwinding:
    """:func:`unwinding` as an object, which can be pickled and taken apart."""

    limit_state: Callable[..., Numbers]
    index: int

    def __call__(self, x: Numbers, limits: Numbers, ops: Any) -> Numbers:
        return unwinding(self.limit_state, self.index)(x, limits, ops)
