"""The CPU engine's sampling kernels: perturb, roll out and score a tile of samples in one pass; average in a second.

The first pass makes the noise of a tile where it is used, moves the robots, checks contacts and adds up rewards, with
everything the tile needs in cache. The second makes the noise of the samples that count again, which is cheaper than
writing it to memory and reading it back.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core import collision, dynamics, reward, transition
from d4orm_env.engine import noise, tiles
from d4orm_env.engine.caching import cached_kernel, fingerprint
from d4orm_env.engine.noise import MIRROR
from d4orm_env.engine.tiles import (
    CONTROL,
    DISTANCE2,
    DOCKED,
    GOAL,
    INLINED,
    NEAR_OBSTACLE,
    NEAR_ROBOT,
    ONE,
    OPTIONS,
    ROWS,
    SCRATCH,
    STATE,
    STRIDE,
    TILE,
    TOTAL,
    ZERO,
    compiled,
    inlined,
    robot_rows,
)

SOURCES = fingerprint((dynamics, transition, collision, reward, noise, tiles))
LANES = 32
"""Width of blocked sums: fixed, so that results do not depend on the machine's vectors."""

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
def _uint32(x: Any) -> Any:
    return np.uint32(x)


@compiled
def _int32(x: Any) -> Any:
    return np.int32(x)


@compiled
def _to_float(x: Any) -> Any:
    return np.float32(x)


@compiled
def _float_bits(x: Any) -> Any:
    return np.float32(x).view(np.int32)


@compiled
def _bits_float(x: Any) -> Any:
    return np.int32(x).view(np.float32)


@compiled
def _sqrt(x: Any) -> Any:
    return np.sqrt(x)


BIT_OPS = noise.BitOps(_uint32, _int32, _to_float, _float_bits, _bits_float, _sqrt)


@compiled
def _perturb(key: Any, first: Any, offset: Any, scale: Any, rows: Any) -> None:
    """Fill two rows with ``offset + scale * noise``, mirrored as :func:`noise.antithetic` says."""
    counter = first // 2
    for s in range(MIRROR):
        x, y = noise.normal_pair(np.uint32(counter + s), key, BIT_OPS)
        x, y = scale[0] * x, scale[1] * y
        rows[s] = offset[0] + x
        rows[MIRROR + s] = offset[0] - x
        rows[TILE + s] = offset[1] + y
        rows[TILE + MIRROR + s] = offset[1] - y


@inlined
def _perturb_robot(seed: Any, step: Any, t: Any, first: Any, k: Any, offset: Any, scale: Any, w: Any) -> None:
    """Fill the control rows of robot ``k`` at time ``t``."""
    num_controls = offset.shape[0]
    for pair in range((num_controls + 1) // 2):
        key = noise.stream_key(seed[0], seed[1], np.uint32(step), np.uint32(k), np.uint32(t), np.uint32(pair), BIT_OPS)
        row = 2 * pair
        # Of an odd number of components the last leaves its partner in the spare row.
        last = min(row + 1, num_controls - 1)
        rows = robot_rows(w, k)[(CONTROL + row) * TILE : (CONTROL + row + 2) * TILE]
        _perturb(key, first, (offset[row], offset[last]), (scale[row], scale[last]), rows)


@inlined
def _extent(row: Any, scratch: Any) -> Any:
    """Smallest and largest number of a row, by halving: a running minimum would not vectorise.

    Args:
        row: ``(TILE,)``.
        scratch: ``(TILE,)``.
    """
    for s in range(32):
        scratch[s] = _smaller(row[s], row[s + 32])
        scratch[s + 32] = _larger(row[s], row[s + 32])
    for s in range(16):
        scratch[s] = _smaller(scratch[s], scratch[s + 16])
        scratch[s + 32] = _larger(scratch[s + 32], scratch[s + 48])
    for s in range(8):
        scratch[s] = _smaller(scratch[s], scratch[s + 8])
        scratch[s + 32] = _larger(scratch[s + 32], scratch[s + 40])
    for s in range(4):
        scratch[s] = _smaller(scratch[s], scratch[s + 4])
        scratch[s + 32] = _larger(scratch[s + 32], scratch[s + 36])
    lower = _smaller(_smaller(scratch[0], scratch[1]), _smaller(scratch[2], scratch[3]))
    upper = _larger(_larger(scratch[32], scratch[33]), _larger(scratch[34], scratch[35]))
    return lower, upper


@inlined
def _smaller(a: Any, b: Any) -> Any:
    """The smaller, and NaN if either is."""
    return a if (a < b) | (a != a) else b


@inlined
def _larger(a: Any, b: Any) -> Any:
    """The larger, and NaN if either is."""
    return a if (a > b) | (a != a) else b


@inlined
def _bound(k: Any, w: Any, box: Any) -> None:
    """Fill ``box`` ``(K, 2, d)`` with the smallest box around robot ``k``'s places in all samples."""
    robot = robot_rows(w, k)
    for axis in range(box.shape[2]):
        lower, upper = _extent(robot[axis * TILE : (axis + 1) * TILE], robot[SCRATCH * TILE : ROWS * TILE])
        # A sample that blew up may be anywhere, and must not hide where the others are.
        box[k, 0, axis] = lower if lower == lower else -np.inf
        box[k, 1, axis] = upper if upper == upper else np.inf


@inlined
def _gap(low_a: Any, high_a: Any, low_b: Any, high_b: Any) -> Any:
    return max(max(low_a - high_b, low_b - high_a), ZERO)


@inlined
def _boxes_apart(box: Any, k: Any, other: Any, reach: Any) -> Any:
    gap2 = ZERO
    for axis in range(box.shape[2]):
        gap = _gap(box[k, 0, axis], box[k, 1, axis], box[other, 0, axis], box[other, 1, axis])
        gap2 += gap * gap
    return gap2 > reach * reach


@inlined
def _point_apart(box: Any, k: Any, point: Any, axes: Any, reach: Any) -> Any:
    gap2 = ZERO
    for axis in range(axes):
        gap = _gap(box[k, 0, axis], box[k, 1, axis], point[axis], point[axis])
        gap2 += gap * gap
    return gap2 > reach * reach


@inlined
def _mark_near_robots(arrays: Any, moving: Any, moving_radius: Any, box: Any, w: Any) -> None:
    dimension = box.shape[2]
    for k in range(box.shape[0]):
        for other in range(k):
            reach = arrays.radius[k] + arrays.radius[other] + arrays.margin
            if not _boxes_apart(box, k, other, reach):
                tiles.mark_pair(reach, k, other, dimension, w)
        for body in range(moving.shape[0]):
            reach = arrays.radius[k] + moving_radius[body] + arrays.margin
            if not _point_apart(box, k, moving[body], dimension, reach):
                tiles.mark_round(reach, k, moving[body], dimension, NEAR_ROBOT, w)


@inlined
def _near_static(arrays: Any, k: Any, box: Any) -> Any:
    """Whether any sample of robot ``k`` may be within the margin of an obstacle or the bounds."""
    dimension = box.shape[2]
    reach = arrays.radius[k] + arrays.margin
    for axis in range(dimension):
        if box[k, 0, axis] - reach <= arrays.bounds[0, axis] or box[k, 1, axis] + reach >= arrays.bounds[1, axis]:
            return True
    for i in range(arrays.balls.shape[0]):
        if not _point_apart(box, k, arrays.balls[i], dimension, reach + arrays.balls[i, dimension]):
            return True
    for i in range(arrays.cylinders.shape[0]):
        if not _point_apart(box, k, arrays.cylinders[i], 2, reach + arrays.cylinders[i, 2]):
            return True
    for i in range(arrays.boxes.shape[0]):
        gap2 = ZERO
        for axis in range(dimension):
            lower, upper = arrays.boxes[i, axis], arrays.boxes[i, dimension + axis]
            gap = _gap(box[k, 0, axis], box[k, 1, axis], lower, upper)
            gap2 += gap * gap
        if gap2 <= reach * reach:
            return True
    return False


@inlined
def _add_rewards(arrays: Any, count: Any, w: Any) -> None:
    for k in range(arrays.radius.shape[0]):
        robot, inverse = robot_rows(w, k), arrays.inverse_initial_distance[k]
        for s in range(TILE):
            distance = np.sqrt(robot[DISTANCE2 * TILE + s])
            near_robot, near_obstacle = robot[NEAR_ROBOT * TILE + s], robot[NEAR_OBSTACLE * TILE + s]
            gain = reward.step_reward(distance, inverse, near_robot, near_obstacle, ONE)
            robot[TOTAL * TILE + s] += count * gain


@inlined
def _all_docked(k: Any, w: Any) -> Any:
    robot = robot_rows(w, k)
    if robot[DOCKED * TILE] == ZERO:
        return False
    lower, _ = _extent(robot[DOCKED * TILE : (DOCKED + 1) * TILE], robot[SCRATCH * TILE : ROWS * TILE])
    return lower > ZERO


@inlined
def _begin_tile(arrays: Any, docked: Any, w: Any) -> None:
    for k in range(arrays.radius.shape[0]):
        o = k * STRIDE
        for s in range(TILE):
            for i in range(arrays.start.shape[1]):
                w[o + (STATE + i) * TILE + s] = arrays.start[k, i]
            w[o + DOCKED * TILE + s] = ONE if docked[k] else ZERO
            w[o + NEAR_ROBOT * TILE + s] = ZERO
            w[o + NEAR_OBSTACLE * TILE + s] = ZERO
            w[o + TOTAL * TILE + s] = ZERO
            for axis in range(arrays.goal.shape[1]):
                w[o + (GOAL + axis) * TILE + s] = arrays.goal[k, axis]
    tiles.measure_goal_distance(arrays.radius.shape[0], arrays.goal.shape[1], w)


@compiled
def _score_tile(
    arrays: Any, offset: Any, scale: Any, docked: Any, collisions: Any, moving: Any, moving_radius: Any, seed: Any,
    step: Any, first: Any, w: Any, box: Any,
) -> None:  # fmt: skip
    """Roll a tile of samples out from number ``first`` and leave their summed rewards in the total rows."""
    num_steps, num_robots, _ = offset.shape
    standing = np.zeros(num_robots, np.bool_)
    _begin_tile(arrays, docked, w)
    for t in range(num_steps):
        num_standing = 0
        for k in range(num_robots):
            if standing[k]:
                num_standing += 1
                continue
            _perturb_robot(seed, step, t, first, k, offset[t, k], scale[t, k], w)
            tiles.move_robot(arrays, k, w)
            # Once a robot stands in every sample nothing about it changes any more: neither its place nor its flags
            # towards static obstacles.
            standing[k] = _all_docked(k, w)
            _bound(k, w, box)
            robot_rows(w, k)[NEAR_OBSTACLE * TILE : (NEAR_OBSTACLE + 1) * TILE] = ZERO
            if _near_static(arrays, k, box):
                tiles.mark_obstacles(arrays, k, arrays.margin, w)
        if num_standing == num_robots and moving.shape[1] == 0:
            _add_rewards(arrays, np.float32(num_steps - t), w)
            break
        if collisions:
            tiles.clear_row(NEAR_ROBOT, num_robots, w)
            _mark_near_robots(arrays, moving[t], moving_radius, box, w)
        _add_rewards(arrays, ONE, w)


@cached_kernel(SOURCES, **OPTIONS)
def score_tiles(
    arrays: Any, offset: Any, scale: Any, docked: Any, collisions: Any, moving: Any, moving_radius: Any, seed: Any,
    step: Any, tile_range: Any, rewards: Any,
) -> None:  # fmt: skip
    """Fill the columns of ``rewards`` ``(K, M)`` that a range of tiles covers with mean rewards over time.

    Args:
        arrays: The problem.
        offset: ``(H, K, m)`` base controls plus mean deformation.
        scale: ``(H, K, m)`` standard deviation of the noise.
        docked: ``(K,)`` bool, docked from the beginning.
        collisions: Whether robots count when near each other or near a moving body.
        moving: ``(H, O, d)`` places of moving bodies after every step.
        moving_radius: ``(O,)``.
        seed: Two uint32 words.
        step: Number of the denoising step.
        tile_range: First tile and the one after the last.
        rewards: Output.
    """
    num_robots, num_samples = rewards.shape
    w = np.zeros(num_robots * STRIDE, np.float32)
    box = np.empty((num_robots, 2, arrays.goal.shape[1]), np.float32)
    for index in range(tile_range[0], tile_range[1]):
        first = index * TILE
        _score_tile(
            arrays, offset, scale, docked, collisions, moving, moving_radius, seed, step, first, w, box
        )  # fmt: skip
        for k in range(num_robots):
            # The last tile may reach beyond the last sample.
            for s in range(min(TILE, num_samples - first)):
                rewards[k, first + s] = w[k * STRIDE + TOTAL * TILE + s] / np.float32(offset.shape[0])


@cached_kernel(SOURCES, **OPTIONS)
def average_noise(
    seed: Any,
    step: Any,
    counters: Any,
    odd: Any,
    even: Any,
    counts: Any,
    time_range: Any,
    first_moment: Any,
    second_moment: Any,
) -> None:
    """Weighted mean of the noise, and of its square, made again for the samples that have any weight.

    Args:
        seed: Two uint32 words.
        step: Number of the denoising step.
        counters: ``(K, .)`` uint32, the noise that counts for each robot.
        odd: ``(K, .)`` weight of the noise: that of its sample minus that of the mirrored one.
        even: ``(K, .)`` weight of its square: the sum of the two.
        counts: ``(K,)`` how many counters there are; the lists are padded with weight zero to whole blocks.
        time_range: First time step and the one after the last.
        first_moment: ``(H, K, m)``, output.
        second_moment: ``(H, K, m)``, output, or an empty array to do without.
    """
    num_controls = first_moment.shape[2]
    with_square = second_moment.size > 0
    w = np.empty(6 * LANES, np.float32)
    for t in range(time_range[0], time_range[1]):
        for k in range(first_moment.shape[1]):
            for pair in range((num_controls + 1) // 2):
                key = noise.stream_key(
                    seed[0], seed[1], np.uint32(step), np.uint32(k), np.uint32(t), np.uint32(pair), BIT_OPS
                )
                _sum_moments(key, counters[k], odd[k], even[k], counts[k], with_square, w)
                for row in range(min(2, num_controls - 2 * pair)):
                    first_moment[t, k, 2 * pair + row] = _total(w, 2 + row)
                    if with_square:
                        second_moment[t, k, 2 * pair + row] = _total(w, 4 + row)


@inlined
def _sum_moments(key: Any, counters: Any, odd: Any, even: Any, count: Any, with_square: Any, w: Any) -> None:
    """Sums over blocks of :data:`LANES`, lane by lane, so that they vectorise and come out the same everywhere.

    ``w`` ``(6 * LANES,)`` holds one block of the noise's two components, then the running sums: first moments of both,
    second moments of both.
    """
    w[2 * LANES :] = ZERO
    for first in range(0, count, LANES):
        counter, weight = counters[first : first + LANES], odd[first : first + LANES]
        for lane in range(LANES):
            x, y = noise.normal_pair(counter[lane], key, BIT_OPS)
            w[lane] = x
            w[LANES + lane] = y
        for lane in range(LANES):
            w[2 * LANES + lane] += weight[lane] * w[lane]
            w[3 * LANES + lane] += weight[lane] * w[LANES + lane]
        if with_square:
            weight = even[first : first + LANES]
            for lane in range(LANES):
                w[4 * LANES + lane] += weight[lane] * w[lane] * w[lane]
                w[5 * LANES + lane] += weight[lane] * w[LANES + lane] * w[LANES + lane]


@inlined
def _total(w: Any, row: Any) -> Any:
    total = ZERO
    for lane in range(LANES):
        total += w[row * LANES + lane]
    return total
