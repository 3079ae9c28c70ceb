"""The CPU engine's sampling kernels: perturb, roll out and score a tile of samples in one pass; average in a second.

The first pass makes the noise of a tile where it is used, moves the robots, checks contacts and adds up rewards, with
everything the tile needs in cache. It takes a block of steps at a time, robot by robot, so that a robot's rows stay in
the first level of the cache, and checks contacts once all robots have moved. It keeps the noise for the second pass: a
quarter of a number per sample and control, because samples share it, which is a third of the time of making it again.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from d4orm_env.core import collision, reward, robot_model, transition
from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.dynamics import MODELS
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.robot_model import TimeStep
from d4orm_env.engine import lanes, noise, obstacles, proximity, tiles
from d4orm_env.engine.caching import Kernel, cached_kernel, fingerprint
from d4orm_env.engine.lanes import (
    BLOCK,
    TILE,
    add_turned,
    add_turned_squares,
    copy_chunk,
    subtract_where,
    use_wide_registers,
)
from d4orm_env.engine.noise import DRAWS
from d4orm_env.engine.proximity import Bodies, Scratch, enclose, make_scratch, mark_robots, near_static, place_of
from d4orm_env.engine.tiles import (
    INLINED,
    NOWHERE,
    ONE,
    OPS,
    OPTIONS,
    READ,
    WRITE,
    ZERO,
    Docking,
    Row,
    compiled,
    inlined,
    make_stepper,
    models_key,
    models_of_kernel,
    to_fixed_tuple,
)

# First rows of a robot in the workspace: see tiles, which has others because it keeps more of a robot.
STATE, DOCKED, TOTAL, ROWS = 0, 6, 7, 9
STRIDE = ROWS * TILE

HALF = np.float32(0.5)


class Workspace(NamedTuple):
    """What one thread needs to score tiles of ``K`` robots over ``H`` steps.

    Attributes:
        w: ``(K STRIDE,)`` the robots.
        places: Their places in a block, see :func:`~d4orm_env.engine.proximity.place_of`.
        draws: ``(BLOCK 4 DRAWS,)`` one robot's noise in a block.
        controls: ``(BLOCK CONTROL_ROWS TILE,)`` one robot's controls in a block.
        keys: ``(2, K H P)`` keys of the noise streams, ``P`` pairs of components each.
        standing: ``(K,)`` whether a robot has docked in all samples.
        scratch: What is noted of who is near what.
    """

    w: FloatArray
    places: FloatArray
    draws: FloatArray
    controls: FloatArray
    keys: NDArray[np.uint32]
    standing: BoolArray
    scratch: Scratch


class Scoring(NamedTuple):
    """What samples are scored by, in all steps of a run.

    Attributes:
        docked: ``(K,)`` bool, docked from the beginning.
        collisions: Whether robots count when near each other or near a moving body.
        penalty: What a violation costs per step.
        bodies: What moves, :class:`~d4orm_env.engine.proximity.Bodies`.
        bounds: ``(S, d, 2)`` boxes beyond them, see :func:`~d4orm_env.engine.proximity.bound_boxes`.
    """

    docked: BoolArray
    collisions: bool
    penalty: np.float32
    bodies: Bodies
    bounds: FloatArray


class Drawing(NamedTuple):
    """What the samples of a denoising step are drawn from.

    Attributes:
        offset: ``(H, K, m)`` base controls plus mean deformation.
        scale: ``(H, K, m)`` standard deviation of the noise.
        seed: Two uint32 words.
        step: Number of the denoising step.
    """

    offset: FloatArray
    scale: FloatArray
    seed: NDArray[np.uint32]
    step: int


Score: TypeAlias = Kernel[[ProblemArrays, Scoring, Drawing, IntArray, Workspace, FloatArray, FloatArray], None]
"""A kernel of :func:`score_kernel`."""


def make_workspace(shape: tuple[int, ...], dimension: int) -> Workspace:
    """A workspace for controls of this shape, ``(H, K, m)``."""
    num_steps, num_robots, num_controls = shape
    return Workspace(
        tiles.aligned_zeros(num_robots * STRIDE), tiles.aligned_zeros(num_robots * BLOCK * dimension * TILE),
        tiles.aligned_zeros(BLOCK * 4 * DRAWS), tiles.aligned_zeros(BLOCK * CONTROL_ROWS * TILE),
        np.empty((2, num_robots * num_steps * ((num_controls + 1) // 2)), np.uint32), np.empty(num_robots, np.bool_),
        make_scratch(num_robots, dimension),
    )  # fmt: skip


CONTROL_ROWS = 3
"""Rows of one step's controls."""

SOURCES = fingerprint((robot_model, transition, collision, reward, noise, lanes, obstacles, tiles, proximity))
for _function in (
    noise.xor_shift,
    noise.hash32,
    noise.stream_key,
    noise.normal_pair,
    noise.unit_interval,
    noise.quarter_sine,
    noise.with_sign,
    noise.log_unit,
):
    register_jitable(**INLINED)(_function)


@compiled
def _uint32(x: int) -> np.uint32:
    return np.uint32(x)


@compiled
def _int32(x: int) -> np.int32:
    return np.int32(x)


@compiled
def _to_float(x: np.int32) -> np.float32:
    return np.float32(x)


@compiled
def _float_bits(x: np.float32) -> np.int32:
    return np.float32(x).view(np.int32)


@compiled
def _bits_float(x: np.int32) -> np.float32:
    return np.int32(x).view(np.float32)


@compiled
def _sqrt(x: np.float32) -> np.float32:
    return np.sqrt(x)


BIT_OPS = noise.BitOps(_uint32, _int32, _to_float, _float_bits, _bits_float, _sqrt)


@compiled
def _draw(key: tuple[np.uint32, np.uint32], first: int, draws: FloatArray) -> None:
    """Fill two rows with normals, from counter number ``first`` on."""
    use_wide_registers()
    for s in range(DRAWS):
        x, y = noise.normal_pair(np.uint32(first + s), key, BIT_OPS)
        draws[s] = x
        draws[DRAWS + s] = y


@compiled
def _copy(source: FloatArray, target: FloatArray) -> None:
    for i in range(target.shape[0]):
        target[i] = source[i]


@inlined
def _draw_block(
    keys: NDArray[np.uint32], first: int, begin: int, count: int, num_pairs: int, kept: FloatArray, draws: FloatArray
) -> None:
    """Draw a robot's noise of a block of ``count`` steps.

    Args:
        keys: ``(2, K H P)`` see :func:`_fill_keys`.
        first: The tile's first counter number.
        begin: Number of the robot's stream at the first step.
        count: Steps in the block.
        num_pairs: ``P``, pairs of components.
        kept: ``(T K H P 2 DRAWS,)`` where the noise is kept, output.
        draws: ``(BLOCK 4 DRAWS,)`` the same noise, two rows for each of up to two pairs of components, output.
    """
    # Of all tiles before this one.
    before = first // DRAWS * keys.shape[1]
    for i in range(count):
        for pair in range(num_pairs):
            stream, row = begin + i * num_pairs + pair, (2 * i + pair) * 2 * DRAWS
            _draw((keys[0, stream], keys[1, stream]), first, draws[row : row + 2 * DRAWS])
            for half in range(2):
                copy_chunk(draws, row + half * DRAWS, kept, (2 * (before + stream) + half) * DRAWS)


# The four samples that share their draws, see :func:`noise.turned`, of which ``o`` is the mean and ``c`` the scale.


@compiled
def _turn2(o: Row, c: Row, d: FloatArray, s: int) -> tuple[Row, Row, Row, Row]:
    x, y = d[s], d[DRAWS + s]
    a, b, across, along = c[0] * x, c[1] * y, c[0] * y, c[1] * x
    return (o[0] + a, o[1] + b), (o[0] - a, o[1] - b), (o[0] - across, o[1] + along), (o[0] + across, o[1] - along)


@compiled
def _turn3(o: Row, c: Row, d: FloatArray, s: int) -> tuple[Row, Row, Row, Row]:
    first, second, third, fourth = _turn2(o, c, d, s)
    # Of the second pair one component is left over.
    a, across = c[2] * d[2 * DRAWS + s], c[2] * d[3 * DRAWS + s]
    z = o[2]
    return (*first, z + a), (*second, z - a), (*third, z - across), (*fourth, z + across)


@compiled
def _vector2(x: FloatArray) -> Row:
    return (x[0], x[1])


@compiled
def _vector3(x: FloatArray) -> Row:
    return (x[0], x[1], x[2])


_TURN = {2: _turn2, 3: _turn3}
_VECTOR = {2: _vector2, 3: _vector3}


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
    turn, vector, dimension = _TURN[model.control_size], _VECTOR[model.control_size], model.dimension
    num_limits = len(model.limit_names)

    @compiled
    def run(
        all_limits: FloatArray, h: TimeStep, docking: Docking, goal: Row, inverse: np.float32, offset: FloatArray,
        scale: FloatArray, draws: FloatArray, controls: FloatArray, places: FloatArray, w: FloatArray,
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
        # Two loops for the same reason as in tiles.
        for i in range(count):
            u = controls[i * CONTROL_ROWS * TILE : (i + 1) * CONTROL_ROWS * TILE]
            for s in range(TILE):
                standing = transition.stands(w[DOCKED * TILE + s] > ZERO, docking[2])
                x = move(standing, read_x(w, STATE * TILE, s), read_u(u, 0, s), limits, h)
                write_x(w, STATE * TILE, s, x)
            for s in range(TILE):
                standing = transition.stands(w[DOCKED * TILE + s] > ZERO, docking[2])
                x, gap2, docked = dock(standing, read_x(w, STATE * TILE, s), read_u(u, 0, s), limits, goal, docking)
                write_x(w, STATE * TILE, s, x)
                w[DOCKED * TILE + s] = ONE if docked else ZERO
                w[TOTAL * TILE + s] += reward.step_reward(np.sqrt(gap2), inverse, ZERO, ZERO, ONE)
            _copy(w[: dimension * TILE], places[i * dimension * TILE : (i + 1) * dimension * TILE])

    return run


@inlined
def _add_standing(goal: FloatArray, inverse: np.float32, count: np.float32, w: FloatArray) -> None:
    """Add the reward, violations aside, of ``count`` steps in which the robot does not move."""
    for s in range(TILE):
        gap2 = ZERO
        for axis in range(goal.shape[0]):
            gap = w[(STATE + axis) * TILE + s] - goal[axis]
            gap2 += gap * gap
        w[TOTAL * TILE + s] += count * reward.step_reward(np.sqrt(gap2), inverse, ZERO, ZERO, ONE)


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
def _punish_near(near: NDArray[np.uint64], count: int, penalty: np.float32, w: FloatArray) -> None:
    """Take the penalty from the robots that are near each other or a body, in the steps of a block."""
    for k in range(near.shape[0]):
        for step in range(count):
            if near[k, step] != NOWHERE:
                subtract_where(w, k * STRIDE + TOTAL * TILE, near[k, step], penalty)


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
    keys, scratch, offset, scale = space.keys, space.scratch, drawing.offset, drawing.scale
    penalty, bounds = scoring.penalty, scoring.bounds
    num_steps, num_robots, num_controls = offset.shape
    num_pairs = (num_controls + 1) // 2
    # Taken out of the tuple once: every access counts a reference, which costs as much as several samples.
    codes, all_limits, goals, inverse = arrays.model_codes, arrays.limits, arrays.goal, arrays.inverse_initial_distance
    h = transition.TimeStep(arrays.time_step[0], arrays.time_step[1], arrays.time_step[2], arrays.time_step[3])
    docks, dimension = arrays.docks, goals.shape[1]
    docking = (arrays.squared_goal_radius, arrays.squared_goal_speed, docks)
    radius, margin = arrays.radius, arrays.margin
    standing[:] = False
    _begin_tile(arrays, scoring.docked, w)
    boxes = scratch.boxes
    for first in range(0, num_steps, BLOCK):
        count = min(BLOCK, num_steps - first)
        for k in range(num_robots):
            # The noise of a robot that stands counts in the mean all the same.
            stream = (k * num_steps + first) * num_pairs
            _draw_block(keys, counter, stream, count, num_pairs, kept, draws)
            robot = w[k * STRIDE : (k + 1) * STRIDE]
            own_places = places[place_of(k, 0, dimension) : place_of(k + 1, 0, dimension)]
            if standing[k]:
                _stay(dimension, robot, own_places)
                enclose(k, radius[k] + HALF * margin, dimension, places, boxes)
                continue
            goal = (goals[k, 0], goals[k, 1], goals[k, dimension - 1])
            last = first + count
            run_robot(
                codes[k], all_limits[k], h, docking, goal, inverse[k], offset[first:last, k], scale[first:last, k],
                draws, controls, own_places, robot,
            )  # fmt: skip
            # Once a robot stands in every sample nothing about it changes any more: neither its place nor its flags
            # towards static obstacles.
            rest = 0
            if docks and _all_docked(robot):
                standing[k] = True
                rest = num_steps - (first + count)
                _add_standing(goals[k], inverse[k], np.float32(rest), robot)
            enclose(k, radius[k] + HALF * margin, dimension, places, boxes)
            if near_static(arrays, k, bounds, boxes, scratch.spare):
                for step in range(count):
                    rows = own_places[step * dimension * TILE : (step + 1) * dimension * TILE]
                    touch = obstacles.near_obstacles(arrays, radius[k] + margin, rows, scratch.spare)
                    steps = np.float32(1 + rest if step == count - 1 else 1)
                    subtract_where(robot, TOTAL * TILE, touch, steps * penalty)
        if scoring.collisions:
            mark_robots(radius, margin, scoring.bodies, first, count, places, scratch)
            _punish_near(scratch.near, count, penalty, w)


@compiled
def _fill_keys(
    seed: NDArray[np.uint32], step: int, num_robots: int, num_steps: int, num_pairs: int, keys: NDArray[np.uint32]
) -> None:
    """Fill ``keys`` ``(2, K H P)`` with those of the noise streams of a denoising step."""
    for k in range(num_robots):
        for pair in range(num_pairs):
            for t in range(num_steps):
                key = noise.stream_key(
                    seed[0], seed[1], np.uint32(step), np.uint32(k), np.uint32(t), np.uint32(pair), BIT_OPS
                )
                stream = (k * num_steps + t) * num_pairs + pair
                keys[0, stream] = key[0]
                keys[1, stream] = key[1]


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
    run_robot = tiles.dispatch({name: _runner(name) for name in models})

    @cached_kernel(models_key(SOURCES, models), variant="_".join(models), **OPTIONS)
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
        num_robots, num_samples = rewards.shape
        _fill_keys(drawing.seed, drawing.step, num_robots, kept.shape[2], kept.shape[3], space.keys)
        for index in range(tile_range[0], tile_range[1]):
            first = index * TILE
            _score_tile(run_robot, arrays, scoring, drawing, index * DRAWS, kept.reshape(-1), space)
            for k in range(num_robots):
                # The last tile may reach beyond the last sample.
                for s in range(min(TILE, num_samples - first)):
                    rewards[k, first + s] = space.w[k * STRIDE + TOTAL * TILE + s] / np.float32(kept.shape[2])

    return score_tiles


@compiled
def _sum_lanes(sums: FloatArray, time_range: IntArray, k: int, moment: FloatArray) -> None:
    """Put the sums ``(T P 2 DRAWS,)`` of robot ``k`` over their lanes into ``moment`` ``(H, K, m)``."""
    num_controls = moment.shape[2]
    rows = num_controls + num_controls % 2
    for t in range(time_range[0], time_range[1]):
        for i in range(num_controls):
            begin = ((t - time_range[0]) * rows + i) * DRAWS
            # Halves upon halves: an order of summation that does not depend on the width of registers.
            half = DRAWS // 2
            while half > 0:
                for lane in range(begin, begin + half):
                    sums[lane] += sums[lane + half]
                half //= 2
            moment[t, k, i] = sums[begin]


@cached_kernel(SOURCES, **OPTIONS)
def average_noise(
    kept: FloatArray,
    odd: FloatArray,
    even: FloatArray,
    time_range: IntArray,
    first_moment: FloatArray,
    second_moment: FloatArray,
) -> None:
    """Weighted mean of the noise, and of its square.

    Args:
        kept: The noise that :func:`score_tiles` kept.
        odd: ``(2, K, M / 4)`` weights summed over the samples that share a counter, times the cosine of their turn and
            times its sine; ``(2, 1, M / 4)`` where all robots have the same weights.
        even: As many with the squares of cosine and sine.
        time_range: First time step and the one after the last.
        first_moment: ``(H, K, m)``, output.
        second_moment: ``(H, K, m)``, output, or an empty array to do without.
    """
    use_wide_registers()
    num_tiles, num_robots, num_steps, num_pairs = kept.shape[0], kept.shape[1], kept.shape[2], kept.shape[3]
    draws, count = kept.reshape(-1), (time_range[1] - time_range[0]) * num_pairs
    sums = tiles.aligned_zeros(count * 2 * DRAWS)
    squares = tiles.aligned_zeros(count * 2 * DRAWS if second_moment.size > 0 else 0)
    for k in range(num_robots):
        row = min(k, odd.shape[1] - 1)
        sums[:] = ZERO
        squares[:] = ZERO
        for tile in range(num_tiles):
            stream, lane = ((tile * num_robots + k) * num_steps + time_range[0]) * num_pairs, tile * DRAWS
            for i in range(count):
                begin = 2 * (stream + i) * DRAWS
                add_turned(sums, 2 * i * DRAWS, draws, begin, odd[0, row], lane, odd[1, row], lane)
            if second_moment.size > 0:
                for i in range(count):
                    begin = 2 * (stream + i) * DRAWS
                    add_turned_squares(squares, 2 * i * DRAWS, draws, begin, even[0, row], lane, even[1, row], lane)
        _sum_lanes(sums, time_range, k, first_moment)
        if second_moment.size > 0:
            _sum_lanes(squares, time_range, k, second_moment)


@cached_kernel(SOURCES, **OPTIONS)
def project_noise(kept: FloatArray, centre: FloatArray, along: FloatArray, across: FloatArray) -> None:
    """Inner products of every draw with a direction, and with that direction turned by 90 degrees.

    Args:
        kept: The noise that :func:`score_tiles` kept.
        centre: ``(H, K, P, 2)`` the direction.
        along: ``(K, T, DRAWS)``, output.
        across: ``(K, T, DRAWS)``, output.
    """
    num_tiles, num_robots, num_steps, num_pairs = kept.shape[0], kept.shape[1], kept.shape[2], kept.shape[3]
    along[:] = ZERO
    across[:] = ZERO
    for k in range(num_robots):
        for tile in range(num_tiles):
            for t in range(num_steps):
                for pair in range(num_pairs):
                    x, y = centre[t, k, pair, 0], centre[t, k, pair, 1]
                    for s in range(DRAWS):
                        first, second = kept[tile, k, t, pair, 0, s], kept[tile, k, t, pair, 1, s]
                        along[k, tile, s] += x * first + y * second
                        across[k, tile, s] += y * first - x * second
