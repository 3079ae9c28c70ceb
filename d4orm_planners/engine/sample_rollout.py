"""Rollout of one robot in every sample of a tile, compiled with numba."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import Model, TimeStep
from d4orm_env.engine.compiling import ONE, ZERO, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.footprint_contacts import place_bodies
from d4orm_env.engine.noise import DRAWS
from d4orm_env.engine.sample_noise import TURN, VECTOR
from d4orm_env.engine.simd import BLOCK, TILE, use_wide_registers
from d4orm_env.engine.stepping import READ, WRITE, Docking, Row, make_stepper
from d4orm_planners.engine.proximity import POSES, pose_of

# First rows of a robot in the workspace: see tiles, which has others because it keeps more of a robot.
STATE, ARRIVED, TOTAL, ROWS = 0, 6, 7, 9
STRIDE = ROWS * TILE
CONTROL_ROWS = 3  #: Rows of one step's controls


@compiled
def _copy(source: FloatArray, target: FloatArray) -> None:
    for i in range(target.shape[0]):
        target[i] = source[i]


def _control_writer(model: Model) -> Callable[..., None]:
    """Function that makes controls of the draws of a block, within the robot's limits."""
    limit_control, write_u = inlined(model.functions.limit_control), WRITE[model.control_size]
    turn, vector = TURN[model.control_size], VECTOR[model.control_size]

    @inlined
    def write_controls(
        limits: Row, offset: FloatArray, scale: FloatArray, draws: FloatArray, controls: FloatArray
    ) -> None:
        for i in range(offset.shape[0]):
            u = controls[i * CONTROL_ROWS * TILE : (i + 1) * CONTROL_ROWS * TILE]
            o, c, d = vector(offset[i]), vector(scale[i]), draws[4 * i * DRAWS : 4 * (i + 1) * DRAWS]
            for s in range(DRAWS):
                u1, u2, u3, u4 = turn(o, c, d, s)
                write_u(u, 0, s, limit_control(u1, limits, OPS))
                write_u(u, DRAWS, s, limit_control(u2, limits, OPS))
                write_u(u, 2 * DRAWS, s, limit_control(u3, limits, OPS))
                write_u(u, 3 * DRAWS, s, limit_control(u4, limits, OPS))

    return write_controls


@cache
def runner(name: str) -> Callable[..., None]:
    """The compiled steps of one robot of this model in every sample of a tile, which add its reward without violations.
    The draws and controls are the same few rows for every robot: they stay in cache.
    """
    model = MODELS[name]
    move, dock = make_stepper(model)
    write_controls = _control_writer(model)
    read_x, write_x, read_u = READ[model.state_size], WRITE[model.state_size], READ[model.control_size]
    num_limits, dimension = len(model.limit_names), model.dimension

    @compiled
    def run(
        all_limits: FloatArray, h: TimeStep, docking: Docking, goal: Row, inverse: np.float32,
        offset: FloatArray, scale: FloatArray, draws: FloatArray, controls: FloatArray, moved: FloatArray,
        positions: FloatArray, f: FootprintArrays | None, k: int, poses: FloatArray, w: FloatArray,
    ) -> None:  # fmt: skip
        use_wide_registers()
        limits, goal = to_fixed_tuple(all_limits, num_limits), goal[:dimension]
        write_controls(limits, offset, scale, draws, controls)
        # Two loops for the same reason as in tiles. They read rows and write others: to store a choice between a new
        # number and the one that is there becomes a masked store, which takes long on AMD's processors without AVX-512.
        for i in range(offset.shape[0]):
            u = controls[i * CONTROL_ROWS * TILE : (i + 1) * CONTROL_ROWS * TILE]
            for s in range(TILE):
                at_rest = transition.absorbed(w[ARRIVED * TILE + s] > ZERO, docking[2])
                x = move(at_rest, read_x(w, STATE * TILE, s), read_u(u, 0, s), limits, h)
                write_x(moved, 0, s, x)
            for s in range(TILE):
                at_rest = transition.absorbed(w[ARRIVED * TILE + s] > ZERO, docking[2])
                x, gap2, arrived = dock(at_rest, read_x(moved, 0, s), read_u(u, 0, s), limits, goal, docking)
                write_x(w, STATE * TILE, s, x)
                w[ARRIVED * TILE + s] = ONE if arrived else ZERO
                w[TOTAL * TILE + s] += transition.step_reward(np.sqrt(gap2), inverse, (ZERO, ZERO, ZERO), ZERO, ONE)
            _copy(w[: dimension * TILE], positions[i * dimension * TILE : (i + 1) * dimension * TILE])
            if f is not None:
                place_bodies(f, k, w, poses, POSES, pose_of(i))

    return run


@inlined
def add_rest_rewards(goal: FloatArray, inverse: np.float32, count: np.float32, w: FloatArray) -> None:
    """Add the reward, violations aside, of ``count`` steps in which the robot does not move."""
    for s in range(TILE):
        gap2 = ZERO
        for axis in range(goal.shape[0]):
            gap = w[(STATE + axis) * TILE + s] - goal[axis]
            gap2 += gap * gap
        w[TOTAL * TILE + s] += count * transition.step_reward(np.sqrt(gap2), inverse, (ZERO, ZERO, ZERO), ZERO, ONE)


@inlined
def all_arrived(w: FloatArray) -> bool:
    if w[ARRIVED * TILE] == ZERO:
        return False
    total = ZERO
    for s in range(TILE):
        total += w[ARRIVED * TILE + s]
    return total == np.float32(TILE)


@inlined
def begin_tile(arrays: ProblemArrays, arrived: BoolArray, w: FloatArray) -> None:
    for k in range(arrays.radius.shape[0]):
        robot = w[k * STRIDE : (k + 1) * STRIDE]
        for i in range(arrays.start.shape[1]):
            robot[(STATE + i) * TILE : (STATE + i + 1) * TILE] = arrays.start[k, i]
        robot[ARRIVED * TILE : (ARRIVED + 1) * TILE] = ONE if arrived[k] else ZERO
        robot[TOTAL * TILE : (TOTAL + 1) * TILE] = ZERO


@inlined
def stay(
    dimension: int, f: FootprintArrays | None, k: int, w: FloatArray, positions: FloatArray, poses: FloatArray
) -> None:
    """Fill the positions and the poses of every step of a block with the present ones."""
    for step in range(BLOCK):
        _copy(w[: dimension * TILE], positions[step * dimension * TILE : (step + 1) * dimension * TILE])
    if f is not None:
        for step in range(BLOCK):
            place_bodies(f, k, w, poses, POSES, pose_of(step))
