"""The CPU engine's first pass over samples: perturb, roll out and score a tile of them.

It makes the noise of a tile where it is used, moves the robots, checks contacts and adds up rewards, with
everything the tile needs in cache. It takes a block of steps at a time, robot by robot, so that a robot's rows stay in
the first level of the cache, and checks contacts once all robots have moved. It keeps the noise for the second pass,
which averages: a quarter of a number per sample and control, because samples share it, which is a third of the time of
making it again.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import TimeStep
from d4orm_env.engine import obstacles
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import ONE, WITHOUT_ARRAYS, ZERO, aligned_zeros, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.footprint_contacts import place_bodies, refine_static
from d4orm_env.engine.noise import DRAWS
from d4orm_env.engine.sample_noise import TURN, VECTOR, Drawing, draw_block, fill_keys
from d4orm_env.engine.simd import BLOCK, NOWHERE, TILE, subtract_where, use_wide_registers
from d4orm_env.engine.stepping import Docking, dispatch, docking_of, make_stepper, models_key, models_of_kernel
from d4orm_env.engine.tile_layout import READ, WRITE, Row
from d4orm_planners.engine.proximity import (
    DIGITS,
    POSES,
    Bodies,
    Scratch,
    enclose,
    make_scratch,
    mark_robots,
    near_static,
    place_of,
    pose_of,
)

# First rows of a robot in the workspace: see tiles, which has others because it keeps more of a robot.
STATE, DOCKED, TOTAL, ROWS = 0, 6, 7, 9
STRIDE = ROWS * TILE
HALF = np.float32(0.5)

CONTROL_ROWS = 3
"""Rows of one step's controls."""


class Workspace(NamedTuple):
    """Per-thread workspace to score tiles of ``K`` robots over ``H`` steps.

    Attributes:
        w: ``(K STRIDE,)`` the robots.
        places: Their places in a block, see :func:`~d4orm_planners.engine.proximity.place_of`.
        draws: ``(BLOCK 4 DRAWS,)`` one robot's noise in a block.
        controls: ``(BLOCK CONTROL_ROWS TILE,)`` one robot's controls in a block.
        moved: ``(DOCKED TILE,)`` one robot's states, moved and not docked yet.
        keys: ``(2, K H P)`` keys of the noise streams, ``P`` pairs of components each.
        standing: ``(K,)`` whether a robot has docked in all samples.
        scratch: Scratch of :mod:`~d4orm_planners.engine.proximity`.
        poses: ``(F POSES,)`` poses of the ``F`` bodies in a block, or of size zero where all are discs.
    """

    w: FloatArray
    places: FloatArray
    draws: FloatArray
    controls: FloatArray
    moved: FloatArray
    keys: NDArray[np.uint32]
    standing: BoolArray
    scratch: Scratch
    poses: FloatArray


class Scoring(NamedTuple):
    """Rules by which samples are scored, in all steps of a run.

    Attributes:
        docked: ``(K,)`` bool, docked from the beginning.
        collisions: Whether robots count when near each other or near a moving body.
        bodies: Dynamic obstacles, :class:`~d4orm_planners.engine.proximity.Bodies`.
        bounds: ``(S, d, 2)`` boxes beyond them, see :func:`~d4orm_planners.engine.proximity.bound_boxes`.
        penalties: ``(K,)`` what a violation costs per step.
        per_pair: Whether it costs so much for every robot and body that is near.
    """

    docked: BoolArray
    collisions: bool
    bodies: Bodies
    bounds: FloatArray
    penalties: FloatArray
    per_pair: bool


Score: TypeAlias = Kernel[[ProblemArrays, Scoring, Drawing, IntArray, Workspace, FloatArray, FloatArray], None]
"""A kernel of :func:`score_kernel`."""


def make_workspace(shape: tuple[int, ...], dimension: int, num_bodies: int) -> Workspace:
    """A workspace for controls of this shape, ``(H, K, m)``, and so many bodies: none if all are discs."""
    num_steps, num_robots, num_controls = shape
    return Workspace(
        aligned_zeros(num_robots * STRIDE), aligned_zeros(num_robots * BLOCK * dimension * TILE),
        aligned_zeros(BLOCK * 4 * DRAWS), aligned_zeros(BLOCK * CONTROL_ROWS * TILE), aligned_zeros(DOCKED * TILE),
        np.empty((2, num_robots * num_steps * ((num_controls + 1) // 2)), np.uint32), np.empty(num_robots, np.bool_),
        make_scratch(num_robots, dimension), aligned_zeros(num_bodies * POSES),
    )  # fmt: skip


@compiled
def _copy(source: FloatArray, target: FloatArray) -> None:
    for i in range(target.shape[0]):
        target[i] = source[i]


@cache
def _runner(name: str) -> Callable[..., None]:
    """The compiled steps of one robot of this model in every sample of a tile, which add its reward without violations.
    The draws and controls are the same few rows for every robot: they stay in cache.
    """
    model = MODELS[name]
    move, dock = make_stepper(model)
    limit_control = inlined(model.functions.limit_control)
    read_x, write_x = READ[model.state_size], WRITE[model.state_size]
    read_u, write_u = READ[model.control_size], WRITE[model.control_size]
    turn, vector, dimension = TURN[model.control_size], VECTOR[model.control_size], model.dimension
    num_limits = len(model.limit_names)

    @compiled
    def run(
        all_limits: FloatArray, h: TimeStep, docking: Docking, goal: Row, inverse: np.float32,
        offset: FloatArray, scale: FloatArray, draws: FloatArray, controls: FloatArray, moved: FloatArray,
        places: FloatArray, f: FootprintArrays | None, k: int, poses: FloatArray, w: FloatArray,
    ) -> None:  # fmt: skip
        use_wide_registers()
        limits = to_fixed_tuple(all_limits, num_limits)
        goal, count = goal[:dimension], offset.shape[0]
        for i in range(count):
            u = controls[i * CONTROL_ROWS * TILE : (i + 1) * CONTROL_ROWS * TILE]
            o, c, d = vector(offset[i]), vector(scale[i]), draws[4 * i * DRAWS : 4 * (i + 1) * DRAWS]
            for s in range(DRAWS):
                u1, u2, u3, u4 = turn(o, c, d, s)
                write_u(u, 0, s, limit_control(u1, limits, OPS))
                write_u(u, DRAWS, s, limit_control(u2, limits, OPS))
                write_u(u, 2 * DRAWS, s, limit_control(u3, limits, OPS))
                write_u(u, 3 * DRAWS, s, limit_control(u4, limits, OPS))
        # Two loops for the same reason as in tiles. They read rows and write others: to store a choice between a new
        # number and the one that is there becomes a masked store, which takes long on AMD's processors without AVX-512.
        for i in range(count):
            u = controls[i * CONTROL_ROWS * TILE : (i + 1) * CONTROL_ROWS * TILE]
            for s in range(TILE):
                standing = transition.stands(w[DOCKED * TILE + s] > ZERO, docking[2])
                x = move(standing, read_x(w, STATE * TILE, s), read_u(u, 0, s), limits, h)
                write_x(moved, 0, s, x)
            for s in range(TILE):
                standing = transition.stands(w[DOCKED * TILE + s] > ZERO, docking[2])
                x, gap2, docked = dock(standing, read_x(moved, 0, s), read_u(u, 0, s), limits, goal, docking)
                write_x(w, STATE * TILE, s, x)
                w[DOCKED * TILE + s] = ONE if docked else ZERO
                w[TOTAL * TILE + s] += transition.step_reward(np.sqrt(gap2), inverse, (ZERO, ZERO, ZERO), ZERO, ONE)
            _copy(w[: dimension * TILE], places[i * dimension * TILE : (i + 1) * dimension * TILE])
            if f is not None:
                place_bodies(f, k, w, poses, POSES, pose_of(i))

    return run


@inlined
def _add_standing(goal: FloatArray, inverse: np.float32, count: np.float32, w: FloatArray) -> None:
    """Add the reward, violations aside, of ``count`` steps in which the robot does not move."""
    for s in range(TILE):
        gap2 = ZERO
        for axis in range(goal.shape[0]):
            gap = w[(STATE + axis) * TILE + s] - goal[axis]
            gap2 += gap * gap
        w[TOTAL * TILE + s] += count * transition.step_reward(np.sqrt(gap2), inverse, (ZERO, ZERO, ZERO), ZERO, ONE)


@inlined
def _all_docked(w: FloatArray) -> bool:
    if w[DOCKED * TILE] == ZERO:
        return False
    total = ZERO
    for s in range(TILE):
        total += w[DOCKED * TILE + s]
    return total == np.float32(TILE)


@inlined
def _begin_tile(arrays: ProblemArrays, docked: BoolArray, w: FloatArray) -> None:
    for k in range(arrays.radius.shape[0]):
        robot = w[k * STRIDE : (k + 1) * STRIDE]
        for i in range(arrays.start.shape[1]):
            robot[(STATE + i) * TILE : (STATE + i + 1) * TILE] = arrays.start[k, i]
        robot[DOCKED * TILE : (DOCKED + 1) * TILE] = ONE if docked[k] else ZERO
        robot[TOTAL * TILE : (TOTAL + 1) * TILE] = ZERO


@inlined
def _stay(dimension: int, w: FloatArray, places: FloatArray) -> None:
    """Fill the places of every step of a block with where the robot is."""
    for step in range(BLOCK):
        _copy(w[: dimension * TILE], places[step * dimension * TILE : (step + 1) * dimension * TILE])


@inlined
def _stay_turned(f: FootprintArrays | None, k: int, w: FloatArray, poses: FloatArray) -> None:
    """Fill the poses of every step of a block with the robot's."""
    if f is not None:
        for step in range(BLOCK):
            place_bodies(f, k, w, poses, POSES, pose_of(step))


@inlined
def _punish_near(near: NDArray[np.uint64], digits: int, count: int, penalties: FloatArray, w: FloatArray) -> None:
    """Take the penalties from the robots that are near each other or a body, in the steps of a block."""
    for k in range(near.shape[1]):
        cost = penalties[k]
        for digit in range(digits):
            for step in range(count):
                if near[digit, k, step] != NOWHERE:
                    subtract_where(w, k * STRIDE + TOTAL * TILE, near[digit, k, step], cost)
            cost += cost


@inlined
def _score_tile(
    run_robot: Callable[..., None],
    arrays: ProblemArrays,
    scoring: Scoring,
    drawing: Drawing,
    counter: int,
    kept: FloatArray,
    space: Workspace,
) -> None:
    """Roll out a tile of samples, noise beginning with this counter; leave summed rewards in rows TOTAL."""
    w, places, draws, controls, standing = space.w, space.places, space.draws, space.controls, space.standing
    moved, keys, scratch, offset, scale = space.moved, space.keys, space.scratch, drawing.offset, drawing.scale
    poses, footprints = space.poses, arrays.footprints
    penalties, bounds, digits = scoring.penalties, scoring.bounds, DIGITS if scoring.per_pair else 1
    num_steps, num_robots, num_controls = offset.shape
    num_pairs = (num_controls + 1) // 2
    # Taken out of the tuple once: every access counts a reference, which costs as much as several samples.
    codes, all_limits, goals, inverse = arrays.model_codes, arrays.limits, arrays.goal, arrays.inverse_initial_distance
    h = transition.TimeStep(arrays.time_step[0], arrays.time_step[1], arrays.time_step[2], arrays.time_step[3])
    docks, dimension = arrays.docks, goals.shape[1]
    radius, margin = arrays.radius, arrays.margin
    standing[:] = False
    _begin_tile(arrays, scoring.docked, w)
    boxes = scratch.boxes
    for first in range(0, num_steps, BLOCK):
        count = min(BLOCK, num_steps - first)
        for k in range(num_robots):
            # The noise of a robot that stands counts in the mean all the same.
            stream = (k * num_steps + first) * num_pairs
            draw_block(keys, counter, stream, count, num_pairs, kept, draws)
            robot = w[k * STRIDE : (k + 1) * STRIDE]
            own_places = places[place_of(k, 0, dimension) : place_of(k + 1, 0, dimension)]
            if standing[k]:
                _stay(dimension, robot, own_places)
                _stay_turned(footprints, k, robot, poses)
                enclose(k, radius[k] + HALF * margin, dimension, places, boxes)
                continue
            goal = (goals[k, 0], goals[k, 1], goals[k, dimension - 1])
            last, docking = first + count, docking_of(arrays, k)
            run_robot(
                codes[k], all_limits[k], h, docking, goal, inverse[k], offset[first:last, k], scale[first:last, k],
                draws, controls, moved, own_places, footprints, k, poses, robot,
            )  # fmt: skip
            # Once a robot stands in every sample nothing about it changes any more: neither its place nor its flags
            # towards static obstacles.
            rest = 0
            if docks and _all_docked(robot):
                standing[k] = True
                rest = num_steps - (first + count)
                _add_standing(goals[k], inverse[k], np.float32(rest), robot)
            enclose(k, radius[k] + HALF * margin, dimension, places, boxes)
            if near_static(arrays, k, bounds, boxes, scratch.buffer):
                for step in range(count):
                    rows = own_places[step * dimension * TILE : (step + 1) * dimension * TILE]
                    touch = obstacles.near_obstacles(arrays, radius[k] + margin, rows, scratch.buffer)
                    begin, buffer = pose_of(step), scratch.buffer
                    touch = refine_static(footprints, arrays, k, touch, margin, rows, poses, POSES, begin, buffer)
                    steps = np.float32(1 + rest if step == count - 1 else 1)
                    subtract_where(robot, TOTAL * TILE, touch, steps * penalties[k])
        if scoring.collisions:
            mark_robots(arrays, scoring.bodies, digits, first, count, places, poses, scratch)
            _punish_near(scratch.near, digits, count, penalties, w)


def score_kernel(models: tuple[str, ...]) -> Score:
    """The first pass for a team of these models.

    The kernel fills the columns of ``rewards`` ``(K, M)`` that a range of tiles covers with mean rewards over time. Its
    arguments:

    - ``arrays``: The problem.
    - ``scoring``: What samples are scored by, a :class:`Scoring`.
    - ``drawing``: What they are drawn from, a :class:`Drawing`.
    - ``tile_range``: First tile and the one after the last.
    - ``space``: This thread's.
    - ``kept``: ``(T, K, H, P, 2, DRAWS)`` the noise of ``T`` tiles, in ``P`` pairs of components, output.
    - ``rewards``: Output.
    """
    return _score_kernel(models_of_kernel(models))


@cache
def _score_kernel(models: tuple[str, ...]) -> Score:
    run_robot = dispatch({name: _runner(name) for name in models})

    @cached_kernel(variant="_".join(models), key=models_key(models), **WITHOUT_ARRAYS)
    def score_tiles(
        arrays: ProblemArrays,
        scoring: Scoring,
        drawing: Drawing,
        tile_range: IntArray,
        space: Workspace,
        kept: FloatArray,
        rewards: FloatArray,
    ) -> None:
        use_wide_registers()
        arrays, scoring, drawing, space = borrow(arrays), borrow(scoring), borrow(drawing), borrow(space)
        num_robots, num_samples = rewards.shape
        fill_keys(drawing.seed, drawing.step, num_robots, kept.shape[2], kept.shape[3], space.keys)
        for index in range(tile_range[0], tile_range[1]):
            first = index * TILE
            _score_tile(run_robot, arrays, scoring, drawing, index * DRAWS, kept.reshape(-1), space)
            for k in range(num_robots):
                # The last tile may reach beyond the last sample.
                for s in range(min(TILE, num_samples - first)):
                    rewards[k, first + s] = space.w[k * STRIDE + TOTAL * TILE + s] / np.float32(kept.shape[2])

    return score_tiles
