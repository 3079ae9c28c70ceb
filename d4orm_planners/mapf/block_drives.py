"""Blocks of steps that beam search drives robots for, many paths at once, compiled with numba.

Paths are in the lanes of a workspace, as worlds are in a tile's (:mod:`d4orm_env.engine.tiles`): a flat float32 array
of rows, each a number per path, so that the compiler makes vector instructions of the loops.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.robot_model import SPEED, Model
from d4orm_env.engine.compiling import ONE, ZERO, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.obstacles import is_closed, touches_static
from d4orm_env.engine.simd import TILE, use_wide_registers
from d4orm_env.engine.stepping import PICK, READ, WRITE, Row, docking_of
from d4orm_planners.engine.path_index import is_unsure
from d4orm_planners.engine.path_table import BLOCK
from d4orm_planners.mapf.beam import Beam
from d4orm_planners.mapf.motion_primitives import Moves, aiming, frame_at
from d4orm_planners.tracking.tracker import velocity_step

_STATE, _CONTROL, _AIM, _PACE, _ARRIVED, _END, _POSITIONS = 0, 6, 10, 13, 14, 15, 16
"""First rows of the workspace; the positions of a block's steps are the last."""
LANES = (_POSITIONS + 3 * BLOCK) * TILE
"""Size of the workspace."""

_AHEAD = np.float32(0.5)
"""Distance ahead of a robot from which the rest of its path is measured [s]."""

_TOUCH = 100.0
"""Robots that are met rather than an obstacle touched for a step."""

BlockDriver: TypeAlias = Callable[[ProblemArrays, Whole, Moves, Beam, Whole, Whole, Whole, FloatArray], None]
"""``(arrays, robot, moves, beam, first, count, steps, lanes)`` drives the robot for so many steps along ``count`` of
the paths that go on from those in the beam by its moves, from number ``first`` on, which is in the first lane."""
PathReader: TypeAlias = Callable[[ProblemArrays, Whole, Whole, Whole, FloatArray], tuple[Row, Row, bool, float]]
"""``(arrays, robot, lane, first, lanes)`` gives state, velocity, arrival and cost [s] of a path whose block began at
step ``first``."""


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

    return drive


def block_driver(model: Model) -> BlockDriver:
    """Function that drives paths for a block."""
    drive, (aim_of, _) = _lanes_driver(model), aiming(model)
    n, num_limits, no_control = model.state_size, len(model.limit_names), (ZERO,) * model.control_size
    write_x, write_u, write_position = WRITE[n], WRITE[model.control_size], WRITE[model.dimension]

    @compiled
    def drive_block(
        arrays: ProblemArrays, robot: Whole, moves: Moves, beam: Beam, first: Whole, count: Whole, steps: Whole,
        w: FloatArray,
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

    return drive_block


def path_reader(model: Model) -> PathReader:
    """Function that reads what has become of a path."""
    velocity_of, read_x, read_u = inlined(model.functions.velocity), READ[model.state_size], READ[model.control_size]
    d, num_limits = model.dimension, len(model.limit_names)

    @inlined
    def read_path(
        arrays: ProblemArrays, robot: Whole, s: Whole, first: Whole, w: FloatArray
    ) -> tuple[Row, Row, bool, float]:
        limits, goal = to_fixed_tuple(arrays.limits[robot], num_limits), arrays.goal[robot]
        state, at_goal = read_x(w, _STATE * TILE, s), w[_ARRIVED * TILE + s] > ZERO
        velocity = velocity_of(state, read_u(w, _CONTROL * TILE, s), limits, OPS)
        end = first + np.int64(w[_END * TILE + s])
        cost = end * arrays.time_step[0]
        if not at_goal:
            rest2 = 0.0
            for axis in range(d):
                gap = goal[axis] - (state[axis] + _AHEAD * velocity[axis])
                rest2 += gap * gap
            cost += max(np.sqrt(rest2) - np.sqrt(arrays.squared_goal_radius), ZERO) / limits[SPEED]
        return state, velocity, at_goal, cost

    return read_path


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


@compiled
def count_faults(arrays: ProblemArrays, robot: Whole, steps: Whole, end: Whole, path: FloatArray) -> float:
    """Count in robots met what a path ``(BLOCK, d)`` does wrong by itself in a block of so many steps, in which it
    moves until ``end``.
    """
    goal, safety_distance, faults = arrays.goal[robot], arrays.radius[robot] + arrays.margin, 0.0
    closed = is_closed(arrays)
    for t in range(steps):
        if t <= end and is_unsure(arrays, path[t], goal):
            faults += 1.0
        if closed and touches_static(arrays, safety_distance, path[t]):
            faults += _TOUCH
    return faults
