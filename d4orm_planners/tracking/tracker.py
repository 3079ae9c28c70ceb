"""The loop that drives a robot along a reference under its own dynamics, compiled with numba.

A reference is data and a guide, a function that returns the velocity wanted next. There are guides from point to point
(:func:`straight_kernel`), along positions and velocities in time (:func:`reference_kernel`), along a route as others
let it pass (:mod:`~d4orm_planners.tracking.path_drives`), and by the clock
(:mod:`~d4orm_planners.tracking.timed_path`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, TypeAlias

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray, Whole
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import SPEED, TURN_RATE, Model, TimeStep
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS, ZERO, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS, cosine, sine
from d4orm_env.engine.stepping import SQUARED_GAP, Docking, Row, docking_of, make_stepper, models_key
from d4orm_planners.tracking.pursuit import vectors
from d4orm_planners.tracking.steering import CREEPING, by_model

Guide: TypeAlias = Callable[[Any, Any, int, Row, Row, Row, TimeStep], tuple[Row, Any, bool]]
"""``(reference, memory, step, state, goal, limits, h) -> (velocity, memory, is_at_end)``: the velocity wanted, the
guide's memory for the next step, and whether the reference ends here: without absorbing goals robots arrive only
there."""
Tracker: TypeAlias = Callable[[ProblemArrays, Whole, Any, Any, int, Row, bool, FloatArray, FloatArray], int]
VelocityStep: TypeAlias = Callable[[Row, Row, Row, Row, Docking, TimeStep], tuple[Row, Row, bool]]


@cache
def velocity_step(model: Model) -> VelocityStep:
    """The compiled step of a robot of this model towards a velocity; at its goal it turns to its goal heading.

    ``(state, velocity, limits, goal, docking, h) -> (control, state, has_arrived)``.
    """
    move, dock = make_stepper(model)
    track, limit_control = inlined(model.functions.track), inlined(model.functions.limit_control)
    squared_gap, has_heading = SQUARED_GAP[model.dimension], model.heading_index is not None
    heading = model.heading_index or 0

    @inlined
    def towards_pose(
        turns: np.bool_ | None, x: Row, velocity: Row, limits: Row, goal: Row, docking: Docking, h: TimeStep
    ) -> Row:
        if turns is None:
            return velocity
        gap2, creep, wanted = squared_gap(x, goal), limits[SPEED] * CREEPING, docking[3]
        if wanted[3] == np.inf:
            return velocity
        if gap2 <= docking[0]:
            return (creep * wanted[1], creep * wanted[2])
        # Nearer than it can drive round, it faces the goal first.
        facing_x, facing_y = cosine(x[heading]), sine(x[heading])
        along = facing_x * velocity[0] + facing_y * velocity[1]
        across = facing_x * velocity[1] - facing_y * velocity[0]
        near = gap2 * limits[TURN_RATE] * limits[TURN_RATE] < limits[SPEED] * limits[SPEED]
        if near and OPS.maximum(across, -across) > along * limits[TURN_RATE] * h.full:
            return (CREEPING * velocity[0], CREEPING * velocity[1])
        return velocity

    @inlined
    def step(x: Row, velocity: Row, limits: Row, goal: Row, docking: Docking, h: TimeStep) -> tuple[Row, Row, bool]:
        if has_heading:
            velocity = towards_pose(docking[3][0], x, velocity, limits, goal, docking, h)
        control = limit_control(track(x, velocity, limits, h, OPS), limits, OPS)
        x, _, arrived = dock(False, move(False, x, control, limits, h), control, limits, goal, docking)
        return control, x, arrived

    return step


def tracker(model: Model, guide: Guide) -> Tracker:
    """The compiled loop for robots of this model along references of this guide.

    ``(arrays, robot, reference, memory, first, state, arrived, controls, states) -> arrival`` drives a robot of the
    team from its state at step ``first`` to the end of ``controls`` ``(H, m)``, fills these and ``states`` ``(H+1, n)``
    after that step, and returns the step of arrival; ``H + 1`` for none. Where goals are absorbing it is at rest from
    then on.
    """
    step_towards = velocity_step(model)
    n, m, d, num_limits = model.state_size, model.control_size, model.dimension, len(model.limit_names)

    @inlined
    def drive(
        arrays: ProblemArrays, robot: Whole, reference: Any, memory: Any, first: int, x: Row, arrived: bool,
        controls: FloatArray, states: FloatArray,
    ) -> int:  # fmt: skip
        dt = arrays.time_step
        docking = docking_of(arrays, robot)
        h = TimeStep(dt[0], dt[1], dt[2], dt[3])
        limits, goal = to_fixed_tuple(arrays.limits[robot], num_limits), to_fixed_tuple(arrays.goal[robot], d)
        horizon = controls.shape[0]
        arrival = first if arrived else horizon + 1
        for step in range(first, horizon):
            if transition.absorbed(arrived, arrays.docks):
                for i in range(m):
                    controls[step:, i] = ZERO
                for i in range(n):
                    states[step + 1 :, i] = x[i]
                break
            velocity, memory, is_at_end = guide(reference, memory, step, x, goal, limits, h)
            control, x, arrived = step_towards(x, velocity, limits, goal, docking, h)
            for i in range(m):
                controls[step, i] = control[i]
            for i in range(n):
                states[step + 1, i] = x[i]
            if not (arrived and (is_at_end or arrays.docks)):
                arrival = horizon + 1
            elif arrival > horizon:
                arrival = step + 1
        return arrival

    return drive


Drives = Kernel[[ProblemArrays, IntArray, IntArray, FloatArray, np.float32, FloatArray, FloatArray, BoolArray], None]
"""A kernel of :func:`straight_kernel`."""


@cache
def straight_kernel(name: str) -> Drives:
    """The compiled drives of robots of the model with this name, each as if alone.

    Args of the kernel: the team, the numbers of these robots, and of all: ``switch`` ``(R, V)``, the time step from
    which on a path is driven, ``vias`` ``(R, V, P, d)``, points to come near to one after the other before the goal,
    the square of how near, controls ``u`` ``(R, V, H, m)`` and states ``x`` ``(R, V, H+1, n)``, changed from that step
    on, and ``arrived`` ``(R, V)``, output.
    """
    model = MODELS[name]
    _, dock = make_stepper(model)
    approach, squared_gap = inlined(model.functions.approach), SQUARED_GAP[model.dimension]
    n, m, d, num_limits = model.state_size, model.control_size, model.dimension, len(model.limit_names)

    @inlined
    def by_points(
        reference: tuple[FloatArray, np.float32], passed: int, step: int, x: Row, goal: Row, limits: Row, h: TimeStep
    ) -> tuple[Row, int, bool]:
        (vias, near2), aim = reference, goal
        while passed < vias.shape[0]:
            aim = to_fixed_tuple(vias[passed], d)
            if not squared_gap(x, aim) < near2:
                break
            passed, aim = passed + 1, goal
        return approach(x, aim, limits, h, OPS), passed, True

    drive = tracker(model, by_points)

    @cached_kernel(variant=name, key=models_key((name,)), **WITHOUT_ARRAYS)
    def drive_straight(
        arrays: ProblemArrays, robots: IntArray, switch: IntArray, vias: FloatArray, near2: np.float32,
        u: FloatArray, x: FloatArray, arrived: BoolArray,
    ) -> None:  # fmt: skip
        arrays = borrow(arrays)
        passed = np.int64(0)  # a literal would compile what it is passed to once more
        for r in robots:
            docking = docking_of(arrays, r)
            limits, goal = to_fixed_tuple(arrays.limits[r], num_limits), to_fixed_tuple(arrays.goal[r], d)
            for v in range(switch.shape[1]):
                first, at_goal = switch[r, v], False
                state = to_fixed_tuple(x[r, v, first], n)
                if first > 0:
                    control = to_fixed_tuple(u[r, v, first - 1], m)
                    state, _, at_goal = dock(False, state, control, limits, goal, docking)
                arrival = drive(arrays, r, (vias[r, v], near2), passed, first, state, at_goal, u[r, v], x[r, v])
                arrived[r, v] = arrival < x.shape[2]

    return drive_straight


Reference: TypeAlias = tuple[FloatArray, FloatArray, np.float32]


@cache
def reference_kernel(
    name: str,
) -> Kernel[[ProblemArrays, IntArray, FloatArray, FloatArray, np.float32, FloatArray, FloatArray], None]:
    """The compiled drives of robots of the model with this name.

    Args of the kernel: the team, the numbers of these robots, and of all: positions and velocities ``(K, T, d)`` of the
    reference, the gain [1/s], ``controls`` ``(K, T, m)``, output, and ``states`` ``(K, T+1, n)`` after the first one.
    """
    model = MODELS[name]
    scaled, _, between = vectors(model.dimension)
    n, d = model.state_size, model.dimension

    @inlined
    def towards(
        reference: Reference, memory: int, step: int, x: Row, goal: Row, limits: Row, h: TimeStep
    ) -> tuple[Row, int, bool]:
        positions, velocities, gain = reference
        error = between(x, to_fixed_tuple(positions[step], d))
        return scaled(to_fixed_tuple(velocities[step], d), error, gain), memory, False

    drive = tracker(model, towards)

    @cached_kernel(variant=name, key=models_key((name,)), **WITHOUT_ARRAYS)
    def drive_reference(
        arrays: ProblemArrays, robots: IntArray, positions: FloatArray, velocities: FloatArray, gain: np.float32,
        controls: FloatArray, states: FloatArray,
    ) -> None:  # fmt: skip
        arrays = borrow(arrays)
        nothing = np.int64(0)
        for k in robots:
            x = to_fixed_tuple(states[k, 0], n)
            drive(arrays, k, (positions[k], velocities[k], gain), nothing, 0, x, False, controls[k], states[k])

    return drive_reference


def follow_reference(
    problem: Problem, states: FloatArray, positions: FloatArray, velocities: FloatArray, gain: float
) -> FloatArray:
    """``(T, K, m)`` controls that drive robots along a reference, as if they had no goals.

    Args:
        problem: The robots.
        states: ``(K, n)`` their present states.
        positions: ``(T, K, d)`` of the reference at the beginning of every time step [m].
        velocities: ``(T, K, d)`` likewise [m/s].
        gain: Share of the position error that is corrected in a second [1/s].
    """
    anywhere = problem.arrays._replace(
        docks=np.bool_(False), turns_at_goals=None, goal_direction=None, squared_goal_chord=None, footprints=None
    )
    due, wanted = (np.ascontiguousarray(np.moveaxis(part, 0, 1), np.float32) for part in (positions, velocities))
    controls = np.zeros((problem.num_robots, len(positions), problem.control_size), np.float32)
    driven = np.empty((problem.num_robots, len(positions) + 1, problem.state_size), np.float32)
    driven[:, 0] = states
    rest = due, wanted, np.float32(gain), controls, driven
    for model, robots in by_model(problem):
        reference_kernel(model.name)(anywhere, np.array(robots), *rest)
    # The norm may come out above the limit by a rounding error.
    return np.clip(np.moveaxis(controls, 1, 0), *problem.team.control_bounds)
