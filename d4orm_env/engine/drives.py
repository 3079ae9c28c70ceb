"""Robots driving to points on their own, compiled with numba: whole ways, many at a time."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core import robot_model, transition
from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.dynamics import MODELS
from d4orm_env.engine import lanes, tiles
from d4orm_env.engine.caching import cached_kernel, fingerprint
from d4orm_env.engine.tiles import (
    OPS,
    OPTIONS,
    SQUARED_GAP,
    ZERO,
    inlined,
    make_stepper,
    models_key,
    to_fixed_tuple,
)

SOURCES = fingerprint((robot_model, transition, lanes, tiles))


class DriveRules(NamedTuple):
    """What holds for all ways.

    Attributes:
        time_step: ``(4,)`` see :class:`~d4orm_env.core.robot_model.TimeStep`.
        docking: ``(2,)`` squares of the goal radius and of the goal speed.
        docks: Whether who has arrived stands there for ever.
        near2: Square of how near to a point is near [m^2].
    """

    time_step: FloatArray
    docking: FloatArray
    docks: np.bool_
    near2: np.float32


class DrivenWays(NamedTuple):
    """``B`` ways, each straight towards a point until it has come near to that, and then to the goal.

    Attributes:
        limits: ``(B, L)`` of the robots.
        goals: ``(B, d)``.
        vias: ``(B, d)`` the points.
        switch: ``(B,)`` time step from which on it is driven so.
    """

    limits: FloatArray
    goals: FloatArray
    vias: FloatArray
    switch: NDArray[np.int64]


@cache
def drive_kernel(name: str) -> Any:
    """The compiled drives of robots of the model with this name, each as if nobody else were there.

    The kernel carries states ``x`` ``(H+1, B, n)`` and controls ``u`` ``(H, B, m)`` on in place, given up to ``switch``
    and inside the limits from there on, zero once docked; ``arrived`` ``(B,)`` is output.
    """
    robot = MODELS[name]
    move, dock = make_stepper(robot)
    approach, track = inlined(robot.functions.approach), inlined(robot.functions.track)
    limit_control, squared_gap = inlined(robot.functions.limit_control), SQUARED_GAP[robot.dimension]
    n, m, d, num_limits = robot.state_size, robot.control_size, robot.dimension, len(robot.limit_names)

    @cached_kernel(models_key(SOURCES, (name,)), variant=name, **OPTIONS)
    def drive(rules: DriveRules, ways: DrivenWays, x: FloatArray, u: FloatArray, arrived: BoolArray) -> None:
        dt, docking = rules.time_step, (rules.docking[0], rules.docking[1], rules.docks)
        h = transition.TimeStep(dt[0], dt[1], dt[2], dt[3])
        for b in range(ways.switch.shape[0]):
            own_limits = to_fixed_tuple(ways.limits[b], num_limits)
            goal, via = to_fixed_tuple(ways.goals[b], d), to_fixed_tuple(ways.vias[b], d)
            first, at_goal = ways.switch[b], False
            state = to_fixed_tuple(x[first, b], n)
            if first > 0:
                state, _, at_goal = dock(False, state, to_fixed_tuple(u[first - 1, b], m), own_limits, goal, docking)
            for t in range(first, u.shape[0]):
                standing = transition.stands(at_goal, rules.docks)
                via = goal if squared_gap(state, via) < rules.near2 else via
                wanted = track(state, approach(state, via, own_limits, h, OPS), own_limits, h, OPS)
                control = limit_control(wanted, own_limits, OPS)
                for i in range(m):
                    u[t, b, i] = ZERO if standing else control[i]
                control = to_fixed_tuple(u[t, b], m)
                state, _, at_goal = dock(
                    standing, move(standing, state, control, own_limits, h), control, own_limits, goal, docking
                )
                for i in range(n):
                    x[t + 1, b, i] = state[i]
            arrived[b] = at_goal

    return drive
