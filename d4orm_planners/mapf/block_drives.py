"""Drives of beam search for a block of steps, of many paths at once, and what they do wrong.

Compiled with numba. Paths are in the lanes of a workspace, as worlds are in a tile's (:mod:`d4orm_env.engine.tiles`): a
flat float32 array of rows, each a number per path, so that the compiler makes vector instructions of the loops.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.robot_model import SPEED, Model
from d4orm_env.engine.compiling import ONE, ZERO, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.obstacles import is_closed, touches_static
from d4orm_env.engine.simd import TILE, use_wide_registers
from d4orm_env.engine.stepping import PICK, READ, WRITE, docking_of
from d4orm_planners.engine.path_index import is_unsure
from d4orm_planners.engine.path_table import BLOCK, Box, enclose
from d4orm_planners.mapf.beam import Beam
from d4orm_planners.mapf.motion_primitives import Moves, aiming, frame_at
from d4orm_planners.tracking.tracker import velocity_step

_INFINITE = np.float32(np.inf)
_STATE, _CONTROL, _AIM, _PACE, _ARRIVED, _END, _VELOCITY, _LOW, _HIGH, _POSITIONS = 0, 6, 10, 13, 14, 15, 16, 19, 22, 25
"""First rows of the workspace; the positions of a block's steps are the last."""
LANES = (_POSITIONS + 3 * BLOCK) * TILE  #: Size of the workspace of a tile

_AHEAD = np.float32(0.5)  #: Distance ahead of a robot from which the rest of its path is measured [s]

_TOUCH = 100.0  #: Robots that are met rather than an obstacle touched for a step

BlockDriver: TypeAlias = Callable[
    [ProblemArrays, Whole, Moves, Beam, Whole, Whole, Whole, Whole, FloatArray, Floats], None
]
"""``(arrays, robot, moves, beam, first, count, begin, steps, lanes, costs)`` drives the robot from step ``begin`` on
for so many steps along ``count`` of the paths that go on from those in the beam by its moves, from number ``first`` on,
which is in the first lane, and says what each costs at least, as it seems [s]."""


def _lanes_driver(model: Model) -> Callable[[ProblemArrays, Whole, Whole, FloatArray], None]:
    """Function that drives the paths in all lanes for so many steps."""
    approach, step_towards, (_, slowed) = inlined(model.functions.approach), velocity_step(model), aiming(model)
    n, m, d, num_limits = model.state_size, model.control_size, model.dimension, len(model.limit_names)
    read_x, write_x, pick_x, read_position = READ[n], WRITE[n], PICK[n], READ[d]
    read_u, write_u, pick_u = READ[m], WRITE[m], PICK[m]

    @compiled
    def drive(arrays: ProblemArrays, robot: Whole, steps: Whole, w: FloatArray) -> None:
        use_wide_registers()
        dt, docking = arrays.time_step, docking_of(arrays, robot)
        h = transition.TimeStep(dt[0], dt[1], dt[2], dt[3])
        limits, at = to_fixed_tuple(arrays.limits[robot], num_limits), to_fixed_tuple(arrays.goal[robot], d)
        for axis in range(d):
            for s in range(TILE):
                w[(_LOW + axis) * TILE + s], w[(_HIGH + axis) * TILE + s] = _INFINITE, -_INFINITE
        for t in range(steps):
            for s in range(TILE):
                absorbed = transition.absorbed(w[_ARRIVED * TILE + s] > ZERO, docking[2])
                x, aim = read_x(w, _STATE * TILE, s), read_position(w, _AIM * TILE, s)
                velocity = slowed(approach(x, aim, limits, h, OPS), w[_PACE * TILE + s])
                u, after, arrives = step_towards(x, velocity, limits, at, docking, h)
                after = pick_x(absorbed, x, after)
                write_u(w, _CONTROL * TILE, s, pick_u(absorbed, read_u(w, _CONTROL * TILE, s), u))
                write_x(w, _STATE * TILE, s, after)
                w[_ARRIVED * TILE + s] = ONE if absorbed | arrives else ZERO
                w[_END * TILE + s] = w[_END * TILE + s] if absorbed else np.float32(t)
            # Apart from the rest, because where these rows are is not known when that is compiled.
            for axis in range(d):
                for s in range(TILE):
                    w[(_POSITIONS + t * d + axis) * TILE + s] = w[(_STATE + axis) * TILE + s]
                for s in range(TILE):
                    x = w[(_STATE + axis) * TILE + s]
                    low, high = w[(_LOW + axis) * TILE + s], w[(_HIGH + axis) * TILE + s]
                    w[(_LOW + axis) * TILE + s] = x if x < low else low
                    w[(_HIGH + axis) * TILE + s] = x if x > high else high

    return drive


def _lanes_pricer(model: Model) -> Callable[[ProblemArrays, Whole, Whole, FloatArray, Floats], None]:
    """Function that works out the velocities of the paths in all lanes, and what they cost; see :data:`BlockDriver`."""
    velocity_of, read_x, read_u = inlined(model.functions.velocity), READ[model.state_size], READ[model.control_size]
    d, num_limits, write_velocity = model.dimension, len(model.limit_names), WRITE[model.dimension]

    @compiled
    def price(arrays: ProblemArrays, robot: Whole, begin: Whole, w: FloatArray, costs: Floats) -> None:
        use_wide_registers()
        limits, goal = to_fixed_tuple(arrays.limits[robot], num_limits), to_fixed_tuple(arrays.goal[robot], d)
        dt, goal_radius = arrays.time_step[0], np.sqrt(arrays.squared_goal_radius)
        for s in range(TILE):
            state, at_goal = read_x(w, _STATE * TILE, s), w[_ARRIVED * TILE + s] > ZERO
            velocity = velocity_of(state, read_u(w, _CONTROL * TILE, s), limits, OPS)
            write_velocity(w, _VELOCITY * TILE, s, velocity)
            rest2 = 0.0
            for axis in range(d):
                gap = goal[axis] - (state[axis] + _AHEAD * velocity[axis])
                rest2 += gap * gap
            cost = (begin + np.int64(w[_END * TILE + s])) * dt
            rest = max(np.sqrt(rest2) - goal_radius, ZERO) / limits[SPEED]
            costs[s] = cost if at_goal else cost + rest

    return price


def block_driver(model: Model) -> BlockDriver:
    """Function that drives paths for a block."""
    drive, price, (aim_of, _) = _lanes_driver(model), _lanes_pricer(model), aiming(model)
    n, num_limits, no_control = model.state_size, len(model.limit_names), (ZERO,) * model.control_size
    write_x, write_u, write_position = WRITE[n], WRITE[model.control_size], WRITE[model.dimension]

    @compiled
    def drive_block(
        arrays: ProblemArrays, robot: Whole, moves: Moves, beam: Beam, first: Whole, count: Whole, begin: Whole,
        steps: Whole, w: FloatArray, costs: Floats,
    ) -> None:  # fmt: skip
        goal, limits = arrays.goal[robot], to_fixed_tuple(arrays.limits[robot], num_limits)
        goal_radius, frame = np.sqrt(arrays.squared_goal_radius), frame_at(beam.states[0], goal)
        for s in range(count):
            node, number = (first + s) // moves.pace.shape[0], (first + s) % moves.pace.shape[0]
            state = to_fixed_tuple(beam.states[node], n)
            if s == 0 or number == 0:
                frame = frame_at(beam.states[node], goal)
            write_x(w, _STATE * TILE, s, state)
            write_u(w, _CONTROL * TILE, s, no_control)
            write_position(w, _AIM * TILE, s, aim_of(frame, state, limits, goal, goal_radius, moves, number))
            w[_PACE * TILE + s], w[_ARRIVED * TILE + s], w[_END * TILE + s] = moves.pace[number], ZERO, ZERO
        drive(arrays, robot, steps, w)
        price(arrays, robot, begin, w, costs)

    return drive_block


@inlined
def read_state(s: Whole, w: FloatArray, state: FloatArray, motion: FloatArray) -> None:
    """Read where a path has come to: its ``state`` ``(n,)``, and position and velocity ``(2d,)``."""
    d = motion.shape[0] // 2
    for i in range(state.shape[0]):  # a mixed team's may be longer
        state[i] = w[(_STATE + i) * TILE + s]
    for axis in range(d):
        motion[axis], motion[d + axis] = w[(_STATE + axis) * TILE + s], w[(_VELOCITY + axis) * TILE + s]


@inlined
def has_arrived(s: Whole, w: FloatArray) -> bool:
    """Check whether a path has come to the goal."""
    return w[_ARRIVED * TILE + s] > ZERO


@compiled
def enclose_lanes(d: Whole, count: Whole, lanes: FloatArray) -> Box:
    """A box round so many paths in a block, in the tiles ``(T, LANES)``."""
    x_low, x_high, y_low, y_high, z_low, z_high = _INFINITE, -_INFINITE, _INFINITE, -_INFINITE, ZERO, ZERO
    if d == 3:
        z_low, z_high = _INFINITE, -_INFINITE
    for first in range(0, count, TILE):
        w = lanes[first // TILE]
        for s in range(min(TILE, count - first)):
            x_low, x_high = min(x_low, w[_LOW * TILE + s]), max(x_high, w[_HIGH * TILE + s])
            y_low, y_high = min(y_low, w[(_LOW + 1) * TILE + s]), max(y_high, w[(_HIGH + 1) * TILE + s])
            if d == 3:
                z_low, z_high = min(z_low, w[(_LOW + 2) * TILE + s]), max(z_high, w[(_HIGH + 2) * TILE + s])
    low = np.float64(x_low), np.float64(y_low), np.float64(z_low)
    return low, (np.float64(x_high), np.float64(y_high), np.float64(z_high))


@compiled
def read_positions(s: Whole, steps: Whole, w: FloatArray, path: FloatArray) -> None:
    """Read where a path was at every step of a block; ``path`` ``(BLOCK, d)`` is output."""
    d = path.shape[1]
    for t in range(steps):
        for axis in range(d):
            path[t, axis] = w[(_POSITIONS + t * d + axis) * TILE + s]


@inlined
def end_of(s: Whole, w: FloatArray) -> Whole:
    """The last step of a block in which a path moves."""
    return np.int64(w[_END * TILE + s])


@inlined
def _comes_near(arrays: ProblemArrays, goal: FloatArray, path: FloatArray, steps: Whole) -> bool:
    """Check whether a path may come so near to the goal that rounding decides; mostly it is much farther away."""
    middle, spread = enclose(path, path.shape[1], np.int64(0), steps)
    gap2, extent = 0.0, 0.0
    for axis in range(path.shape[1]):
        gap = middle[axis] - np.float64(goal[axis])
        gap2, extent = gap2 + gap * gap, max(extent, abs(middle[axis]))
    far = 3 * np.sqrt(np.float64(arrays.squared_goal_radius)) + (extent + spread) * 2.0**-8 + spread
    return gap2 <= far * far


@compiled
def count_faults(arrays: ProblemArrays, robot: Whole, steps: Whole, end: Whole, path: FloatArray) -> float:
    """Count in robots met what a path ``(BLOCK, d)`` does wrong by itself in a block of so many steps, in which it
    moves until ``end``.
    """
    goal, safety_distance, faults = arrays.goal[robot], arrays.wall_radius[robot] + arrays.margin, 0.0
    closed, near = is_closed(arrays), _comes_near(arrays, goal, path, steps)
    if not (closed or near):
        return faults
    for t in range(steps):
        if near and t <= end and is_unsure(arrays, path[t], goal):
            faults += 1.0
        if closed and touches_static(arrays, safety_distance, path[t]):
            faults += _TOUCH
    return faults
