"""Robots driving to points on their own, compiled with numba: whole paths, many at a time."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import OPTIONS, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.stepping import make_stepper, models_key
from d4orm_env.engine.tile_layout import SQUARED_GAP


class DriveRules(NamedTuple):
    """Rules for all paths.

    Attributes:
        time_step: ``(4,)`` see :class:`~d4orm_env.dynamics.robot_model.TimeStep`.
        docks: Whether a robot that has arrived stays there for good.
        near2: Square of how near to a point is near [m^2].
    """

    time_step: FloatArray
    docks: np.bool_
    near2: np.float32


class RobotSpec(NamedTuple):
    """A robot that drives as if alone.

    Attributes:
        time_step: As of :class:`DriveRules`, like the next one.
        docks: Whether it stays for good where it has arrived.
        docking: ``(2,)`` squares of the goal radius and of the goal speed.
        limits: ``(L,)``.
        goal: ``(d,)`` [m].
        start: ``(n,)``.
    """

    time_step: FloatArray
    docks: np.bool_
    docking: FloatArray
    limits: FloatArray
    goal: FloatArray
    start: FloatArray

    @classmethod
    def of(cls, problem: Problem, robot: int) -> RobotSpec:
        """A robot of a team."""
        arrays, goal, start = problem.arrays, problem.goal[robot], problem.start[robot]
        return cls(arrays.time_step, arrays.docks, arrays.docking[robot], arrays.limits[robot], goal, start)


class DriveInputs(NamedTuple):
    """``V`` paths of each of ``R`` robots: as given at first, then straight by points to the goal.

    Attributes:
        limits: ``(R, L)`` of the robots.
        docking: ``(R, 2)`` squares of the goal radius and of their goal speeds.
        goals: ``(R, d)``.
        states: ``(R, H+1, n)`` as given.
        controls: ``(R, H, m)`` as given, inside the limits, zero for docked robots.
        switch: ``(R, V)`` time step from which on a path is driven.
        vias: ``(R, V, P, d)`` points to come near to one after the other, before the goal.
    """

    limits: FloatArray
    docking: FloatArray
    goals: FloatArray
    states: FloatArray
    controls: FloatArray
    switch: NDArray[np.int64]
    vias: FloatArray


@cache
def drive_kernel(name: str) -> Kernel[[DriveRules, DriveInputs, IntArray, FloatArray, FloatArray, BoolArray], None]:
    """The compiled drives of robots of the model with this name, each as if alone.

    The kernel fills, for robots of these numbers, controls ``u`` ``(R, V, H, m)``, left alone once docked,
    states ``x`` ``(R, V, H+1, n)`` and ``arrived`` ``(R, V)``.
    """
    robot = MODELS[name]
    move, dock = make_stepper(robot)
    approach, track = inlined(robot.functions.approach), inlined(robot.functions.track)
    limit_control, squared_gap = inlined(robot.functions.limit_control), SQUARED_GAP[robot.dimension]
    n, m, d, num_limits = robot.state_size, robot.control_size, robot.dimension, len(robot.limit_names)

    @cached_kernel(variant=name, key=models_key((name,)), **OPTIONS)
    def drive(
        rules: DriveRules, given: DriveInputs, robots: IntArray, u: FloatArray, x: FloatArray, arrived: BoolArray
    ) -> None:
        dt = rules.time_step
        h = transition.TimeStep(dt[0], dt[1], dt[2], dt[3])
        num_paths, horizon, num_vias = given.switch.shape[1], given.controls.shape[1], given.vias.shape[2]
        for r in robots:
            docking = (given.docking[r, 0], given.docking[r, 1], rules.docks)
            own_limits, goal = to_fixed_tuple(given.limits[r], num_limits), to_fixed_tuple(given.goals[r], d)
            for v in range(num_paths):
                first, at_goal, passed = given.switch[r, v], False, 0
                for t in range(first + 1):
                    for i in range(n):
                        x[r, v, t, i] = given.states[r, t, i]
                for t in range(first):
                    for i in range(m):
                        u[r, v, t, i] = given.controls[r, t, i]
                state = to_fixed_tuple(given.states[r, first], n)
                if first > 0:
                    control = to_fixed_tuple(given.controls[r, first - 1], m)
                    state, _, at_goal = dock(False, state, control, own_limits, goal, docking)
                for t in range(first, horizon):
                    if transition.stands(at_goal, rules.docks):
                        for i in range(n):
                            x[r, v, t + 1 :, i] = state[i]
                        break
                    aim = goal
                    while passed < num_vias:
                        aim = to_fixed_tuple(given.vias[r, v, passed], d)
                        if not squared_gap(state, aim) < rules.near2:
                            break
                        passed, aim = passed + 1, goal
                    wanted = track(state, approach(state, aim, own_limits, h, OPS), own_limits, h, OPS)
                    control = limit_control(wanted, own_limits, OPS)
                    for i in range(m):
                        u[r, v, t, i] = control[i]
                    state = move(False, state, control, own_limits, h)
                    state, _, at_goal = dock(False, state, control, own_limits, goal, docking)
                    for i in range(n):
                        x[r, v, t + 1, i] = state[i]
                arrived[r, v] = at_goal

    return drive
