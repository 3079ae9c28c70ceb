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
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.robot_model import TimeStep
from d4orm_env.engine import obstacles
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS, aligned_zeros, inlined
from d4orm_env.engine.footprint_contacts import refine_static
from d4orm_env.engine.noise import DRAWS
from d4orm_env.engine.sample_noise import Drawing, draw_block, fill_keys
from d4orm_env.engine.simd import BLOCK, NOWHERE, TILE, subtract_where, use_wide_registers
from d4orm_env.engine.stepping import dispatch, docking_of, models_key, models_of_kernel
from d4orm_planners.engine.proximity import (
    DIGITS,
    POSES,
    Bodies,
    Scratch,
    enclose,
    make_scratch,
    mark_robots,
    near_static,
    pose_of,
    position_of,
)
from d4orm_planners.engine.sample_rollout import (
    ARRIVED,
    CONTROL_ROWS,
    STRIDE,
    TOTAL,
    add_rest_rewards,
    all_arrived,
    begin_tile,
    runner,
    stay,
)

HALF = np.float32(0.5)


class Workspace(NamedTuple):
    """Per-thread workspace to score tiles of ``K`` robots over ``H`` steps."""

    w: FloatArray  #: ``(K STRIDE,)`` the robots
    positions: FloatArray  #: Their positions in a block, see :func:`~d4orm_planners.engine.proximity.position_of`
    draws: FloatArray  #: ``(BLOCK 4 DRAWS,)`` one robot's noise in a block
    controls: FloatArray  #: ``(BLOCK CONTROL_ROWS TILE,)`` one robot's controls in a block
    moved: FloatArray  #: ``(ARRIVED TILE,)`` one robot's states, moved, before arrivals
    keys: NDArray[np.uint32]  #: ``(2, K H P)`` keys of the noise streams, ``P`` pairs of components each
    at_rest: BoolArray  #: ``(K,)`` whether a robot has arrived in all samples
    scratch: Scratch  #: Scratch of :mod:`~d4orm_planners.engine.proximity`
    poses: FloatArray  #: ``(F POSES,)`` poses of the ``F`` bodies in a block, or of size zero where all are discs


class Scoring(NamedTuple):
    """Rules by which samples are scored, in all steps of a run."""

    arrived: BoolArray  #: ``(K,)`` bool, arrived from the beginning
    collisions: bool  #: Whether robots count when near each other or near a moving body
    bodies: Bodies  #: Dynamic obstacles, :class:`~d4orm_planners.engine.proximity.Bodies`
    bounds: FloatArray  #: ``(S, d, 2)`` boxes beyond them, see :func:`~d4orm_planners.engine.proximity.bound_boxes`
    penalties: FloatArray  #: ``(K,)`` what a violation costs per step
    per_pair: bool  #: Whether it costs so much for every robot and body that is near


Score: TypeAlias = Kernel[[ProblemArrays, Scoring, Drawing, IntArray, Workspace, FloatArray, FloatArray], None]
"""A kernel of :func:`score_kernel`."""


def make_workspace(shape: tuple[int, ...], dimension: int, num_bodies: int) -> Workspace:
    """A workspace for controls of this shape, ``(H, K, m)``, and so many bodies: none if all are discs."""
    num_steps, num_robots, num_controls = shape
    return Workspace(
        aligned_zeros(num_robots * STRIDE), aligned_zeros(num_robots * BLOCK * dimension * TILE),
        aligned_zeros(BLOCK * 4 * DRAWS), aligned_zeros(BLOCK * CONTROL_ROWS * TILE), aligned_zeros(ARRIVED * TILE),
        np.empty((2, num_robots * num_steps * ((num_controls + 1) // 2)), np.uint32), np.empty(num_robots, np.bool_),
        make_scratch(num_robots, dimension), aligned_zeros(num_bodies * POSES),
    )  # fmt: skip


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
def _punish_static(
    arrays: ProblemArrays, scoring: Scoring, k: int, count: int, rest: int, positions: FloatArray, poses: FloatArray,
    scratch: Scratch, w: FloatArray,
) -> None:  # fmt: skip
    """Take the penalty from robot ``k`` where it is near an obstacle or the bounds; ``rest`` times more at the end."""
    radius, margin, dimension, buffer = arrays.wall_radius[k], arrays.margin, arrays.goal.shape[1], scratch.buffer
    if not near_static(arrays, k, scoring.bounds, scratch.boxes, buffer):
        return
    for step in range(count):
        rows = positions[step * dimension * TILE : (step + 1) * dimension * TILE]
        touch = obstacles.near_obstacles(arrays, radius + margin, rows, buffer)
        begin = pose_of(step)
        touch = refine_static(arrays.footprints, arrays, k, touch, margin, rows, poses, POSES, begin, buffer)
        steps = np.float32(1 + rest if step == count - 1 else 1)
        subtract_where(w, TOTAL * TILE, touch, steps * scoring.penalties[k])


@inlined
def _advance_robot(
    run_robot: Callable[..., None], arrays: ProblemArrays, scoring: Scoring, drawing: Drawing, counter: int,
    kept: FloatArray, space: Workspace, h: TimeStep, k: int, first: int, count: int,
) -> None:  # fmt: skip
    """Move robot ``k`` for ``count`` steps of a block from ``first`` on, and reward it, but for what moves as well."""
    num_steps, _, num_controls = drawing.offset.shape
    num_pairs, dimension = (num_controls + 1) // 2, arrays.goal.shape[1]
    half_width = arrays.radius[k] + HALF * arrays.margin
    # The noise of a robot at rest counts in the mean all the same.
    draw_block(space.keys, counter, (k * num_steps + first) * num_pairs, count, num_pairs, kept, space.draws)
    robot, footprints = space.w[k * STRIDE : (k + 1) * STRIDE], arrays.footprints
    positions = space.positions[position_of(k, 0, dimension) : position_of(k + 1, 0, dimension)]
    if space.at_rest[k]:
        stay(dimension, footprints, k, robot, positions, space.poses)
        enclose(k, half_width, dimension, space.positions, space.scratch.boxes)
        return
    goals, last = arrays.goal, first + count
    goal = (goals[k, 0], goals[k, 1], goals[k, dimension - 1])
    run_robot(
        arrays.model_codes[k], arrays.limits[k], h, docking_of(arrays, k), goal, arrays.inverse_initial_distance[k],
        drawing.offset[first:last, k], drawing.scale[first:last, k], space.draws, space.controls, space.moved,
        positions, footprints, k, space.poses, robot,
    )  # fmt: skip
    # Once a robot has arrived in every sample, neither its position nor its contacts with obstacles change any more.
    rest = 0
    if arrays.docks and all_arrived(robot):
        space.at_rest[k] = True
        rest = num_steps - last
        add_rest_rewards(goals[k], arrays.inverse_initial_distance[k], np.float32(rest), robot)
    enclose(k, half_width, dimension, space.positions, space.scratch.boxes)
    _punish_static(arrays, scoring, k, count, rest, positions, space.poses, space.scratch, robot)


@inlined
def _score_tile(
    run_robot: Callable[..., None], arrays: ProblemArrays, scoring: Scoring, drawing: Drawing, counter: int,
    kept: FloatArray, space: Workspace,
) -> None:  # fmt: skip
    """Roll out a tile of samples, noise beginning with this counter; leave summed rewards in rows TOTAL."""
    penalties, digits = scoring.penalties, DIGITS if scoring.per_pair else 1
    h = TimeStep(arrays.time_step[0], arrays.time_step[1], arrays.time_step[2], arrays.time_step[3])
    num_steps, num_robots, _ = drawing.offset.shape
    space.at_rest[:] = False
    begin_tile(arrays, scoring.arrived, space.w)
    for first in range(0, num_steps, BLOCK):
        count = min(BLOCK, num_steps - first)
        for k in range(num_robots):
            _advance_robot(run_robot, arrays, scoring, drawing, counter, kept, space, h, k, first, count)
        if scoring.collisions:
            mark_robots(arrays, scoring.bodies, digits, first, count, space.positions, space.poses, space.scratch)
            _punish_near(space.scratch.near, digits, count, penalties, space.w)


def score_kernel(models: tuple[str, ...]) -> Score:
    """The first pass for a team of these models.

    The kernel fills the columns of ``rewards`` ``(K, M)`` that a range of tiles covers with mean rewards over time. Its
    arguments:

    - ``arrays``: The problem.
    - ``scoring``: The rules of the scores.
    - ``drawing``: The distribution of the samples.
    - ``tile_range``: First tile and the one after the last.
    - ``space``: This thread's workspace.
    - ``kept``: ``(T, K, H, P, 2, DRAWS)`` the noise of ``T`` tiles, in ``P`` pairs of components, output.
    - ``rewards``: Output.
    """
    return _score_kernel(models_of_kernel(models))


@cache
def _score_kernel(models: tuple[str, ...]) -> Score:
    run_robot = dispatch({name: runner(name) for name in models})

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
