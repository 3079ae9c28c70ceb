"""The CPU engine's sampling kernels: perturb, roll out and score a tile of samples in one pass; average in a second.

The first pass makes the noise of a tile where it is used, moves the robots, checks contacts and adds up rewards, with
everything the tile needs in cache. It keeps the noise for the second pass: a quarter of a number per sample and
control, because samples share it, which is a third of the time of making it again.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core import collision, dynamics, reward, transition
from d4orm_env.core.dynamics import MODELS, Model
from d4orm_env.engine import lanes, noise, proximity, tiles
from d4orm_env.engine.caching import cached_kernel, fingerprint
from d4orm_env.engine.lanes import TILE, subtract_where, use_wide_registers
from d4orm_env.engine.noise import DRAWS
from d4orm_env.engine.proximity import STATIC, make_scratch, mark_robots, measure_strides, near_static
from d4orm_env.engine.tiles import (
    DOCKED,
    HOLONOMIC2D,
    HOLONOMIC3D,
    INLINED,
    NOWHERE,
    OBSTACLE,
    ONE,
    OPS,
    OPTIONS,
    READ,
    ROBOT,
    STATE,
    STRIDE,
    TOTAL,
    VELOCITY2D,
    WRITE,
    ZERO,
    compiled,
    inlined,
    make_stepper,
)

SOURCES = fingerprint((dynamics, transition, collision, reward, noise, lanes, tiles, proximity))
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
    """Fill two rows with ``offset + scale * noise``, turned as :func:`noise.turned` says; half a row with the noise."""
    use_wide_registers()
    for s in range(DRAWS):
        x, y = noise.normal_pair(np.uint32(first + s), key, BIT_OPS)
        rows[2 * TILE + s] = x
        rows[2 * TILE + DRAWS + s] = y
        x, y, across, along = scale[0] * x, scale[1] * y, scale[0] * y, scale[1] * x
        rows[s] = offset[0] + x
        rows[DRAWS + s] = offset[0] - x
        rows[2 * DRAWS + s] = offset[0] - across
        rows[3 * DRAWS + s] = offset[0] + across
        rows[TILE + s] = offset[1] + y
        rows[TILE + DRAWS + s] = offset[1] - y
        rows[TILE + 2 * DRAWS + s] = offset[1] + along
        rows[TILE + 3 * DRAWS + s] = offset[1] - along


@compiled
def _keep(draws: Any, kept: Any) -> None:
    for s in range(DRAWS):
        kept[s] = draws[s]


@inlined
def _perturb_robot(
    seed: Any, step: Any, t: Any, first: Any, k: Any, offset: Any, scale: Any, kept: Any, controls: Any
) -> None:
    """Fill ``controls`` with the samples of robot ``k``'s controls at time ``t``, a row a component, and put the noise
    into ``kept`` ``(P, 2, M / 4)`` from counter number ``first`` on.
    """
    num_controls = offset.shape[0]
    for pair in range((num_controls + 1) // 2):
        key = noise.stream_key(seed[0], seed[1], np.uint32(step), np.uint32(k), np.uint32(t), np.uint32(pair), BIT_OPS)
        row = 2 * pair
        # Of an odd number of components the last leaves its partner in the spare row.
        last = min(row + 1, num_controls - 1)
        rows = controls[row * TILE : (row + 3) * TILE]
        _perturb(key, first, (offset[row], offset[last]), (scale[row], scale[last]), rows)
        for i in range(2):
            _keep(rows[2 * TILE + i * DRAWS : 2 * TILE + (i + 1) * DRAWS], kept[pair, i, first : first + DRAWS])


def _runner(model: Model) -> Any:
    """The compiled step of one robot of this model in every sample of a tile, which adds its reward without
    violations. The controls are the same few rows for every robot: they stay in cache.
    """
    move, dock = make_stepper(model)
    limit_control = inlined(model.functions.limit_control)
    read_x, write_x = READ[model.state_size], WRITE[model.state_size]
    read_u, write_u = READ[model.control_size], WRITE[model.control_size]
    dimension = model.dimension

    @compiled
    def run(limits: Any, h: Any, docking: Any, goal: Any, inverse: Any, controls: Any, w: Any) -> None:
        use_wide_registers()
        goal = goal[:dimension]
        # Three loops for the same reason as in tiles.
        for s in range(TILE):
            write_u(controls, 0, s, limit_control(read_u(controls, 0, s), limits, OPS))
        for s in range(TILE):
            standing = w[DOCKED * TILE + s] > ZERO
            write_x(w, STATE * TILE, s, move(standing, read_x(w, STATE * TILE, s), read_u(controls, 0, s), limits, h))
        for s in range(TILE):
            standing = w[DOCKED * TILE + s] > ZERO
            x, gap2, docked = dock(standing, read_x(w, STATE * TILE, s), read_u(controls, 0, s), goal, docking)
            write_x(w, STATE * TILE, s, x)
            w[DOCKED * TILE + s] = ONE if docked else ZERO
            w[TOTAL * TILE + s] += reward.step_reward(np.sqrt(gap2), inverse, ZERO, ZERO, ONE)

    return run


_run_holonomic2d = _runner(MODELS["holonomic2d"])
_run_holonomic3d = _runner(MODELS["holonomic3d"])
_run_velocity2d = _runner(MODELS["velocity2d"])
_run_differential_drive = _runner(MODELS["differential_drive"])


@inlined
def _run_robot(
    code: Any, limits: Any, h: Any, docking: Any, goal: Any, inverse: Any, k: Any, controls: Any, w: Any
) -> None:
    """Move robot ``k`` one step in every sample of the tile and add its reward, violations aside."""
    robot = w[k * STRIDE : (k + 1) * STRIDE]
    if code == HOLONOMIC2D:
        _run_holonomic2d(limits, h, docking, goal, inverse, controls, robot)
    elif code == HOLONOMIC3D:
        _run_holonomic3d(limits, h, docking, goal, inverse, controls, robot)
    elif code == VELOCITY2D:
        _run_velocity2d(limits, h, docking, goal, inverse, controls, robot)
    else:
        _run_differential_drive(limits, h, docking, goal, inverse, controls, robot)


@inlined
def _add_standing(goal: Any, inverse: Any, count: Any, k: Any, w: Any) -> None:
    """Add the reward, violations aside, of ``count`` steps in which robot ``k`` does not move."""
    robot = w[k * STRIDE : (k + 1) * STRIDE]
    for s in range(TILE):
        gap2 = ZERO
        for axis in range(goal.shape[1]):
            gap = robot[(STATE + axis) * TILE + s] - goal[k, axis]
            gap2 += gap * gap
        robot[TOTAL * TILE + s] += count * reward.step_reward(np.sqrt(gap2), inverse[k], ZERO, ZERO, ONE)


@inlined
def _all_docked(k: Any, w: Any) -> Any:
    robot = w[k * STRIDE : (k + 1) * STRIDE]
    if robot[DOCKED * TILE] == ZERO:
        return False
    total = ZERO
    for s in range(TILE):
        total += robot[DOCKED * TILE + s]
    return total == np.float32(TILE)


@inlined
def _begin_tile(arrays: Any, docked: Any, w: Any) -> None:
    for k in range(arrays.radius.shape[0]):
        robot = w[k * STRIDE : (k + 1) * STRIDE]
        for i in range(arrays.start.shape[1]):
            robot[(STATE + i) * TILE : (STATE + i + 1) * TILE] = arrays.start[k, i]
        robot[DOCKED * TILE : (DOCKED + 1) * TILE] = ONE if docked[k] else ZERO
        robot[TOTAL * TILE : (TOTAL + 1) * TILE] = ZERO


@compiled
def _score_tile(
    arrays: Any, offset: Any, scale: Any, docked: Any, collisions: Any, penalty: Any, moving: Any, moving_radius: Any,
    seed: Any, step: Any, first: Any, kept: Any, w: Any, controls: Any, standing: Any, scratch: Any,
) -> None:  # fmt: skip
    """Roll out a tile of samples, noise beginning with counter ``first``; leave summed rewards in rows TOTAL."""
    num_steps, num_robots, _ = offset.shape
    # Taken out of the tuple once: every access counts a reference, which costs as much as several samples.
    codes, all_limits, goals, inverse = arrays.model_codes, arrays.limits, arrays.goal, arrays.inverse_initial_distance
    h = transition.TimeStep(arrays.time_step[0], arrays.time_step[1], arrays.time_step[2], arrays.time_step[3])
    docking, last = (arrays.squared_goal_radius, arrays.squared_goal_speed), goals.shape[1] - 1
    radius, margin = arrays.radius, arrays.margin
    standing[:] = False
    _begin_tile(arrays, docked, w)
    due, near = scratch.due, scratch.near
    proximity.begin(due)
    for t in range(num_steps):
        for k in range(num_robots):
            _perturb_robot(seed, step, t, first, k, offset[t, k], scale[t, k], kept[k, t], controls)
            if standing[k]:
                # Its noise counts in the mean all the same.
                continue
            limits = (all_limits[k, 0], all_limits[k, 1], all_limits[k, 2])
            goal = (goals[k, 0], goals[k, 1], goals[k, last])
            _run_robot(codes[k], limits, h, docking, goal, inverse[k], k, controls, w)
            count = ONE
            # Once a robot stands in every sample nothing about it changes any more: neither its place nor its flags
            # towards static obstacles.
            if _all_docked(k, w):
                standing[k] = True
                count = np.float32(num_steps - t)
                _add_standing(goals, inverse, count - ONE, k, w)
            if due[k, STATIC] <= t and near_static(arrays, k, t, num_steps, w, scratch):
                near[k, OBSTACLE] = NOWHERE
                tiles.mark_obstacles(arrays, k, margin, w, near)
                subtract_where(w, k * STRIDE + TOTAL * TILE, near[k, OBSTACLE], count * penalty)
        if collisions:
            mark_robots(radius, margin, moving[t], moving_radius, t, num_steps, w, scratch)
            for k in range(num_robots):
                if near[k, ROBOT] != NOWHERE:
                    subtract_where(w, k * STRIDE + TOTAL * TILE, near[k, ROBOT], penalty)


@cached_kernel(SOURCES, **OPTIONS)
def score_tiles(
    arrays: Any, offset: Any, scale: Any, docked: Any, collisions: Any, penalty: Any, moving: Any, moving_radius: Any,
    seed: Any, step: Any, tile_range: Any, kept: Any, rewards: Any,
) -> None:  # fmt: skip
    """Fill the columns of ``rewards`` ``(K, M)`` that a range of tiles covers with mean rewards over time.

    Args:
        arrays: The problem.
        offset: ``(H, K, m)`` base controls plus mean deformation.
        scale: ``(H, K, m)`` standard deviation of the noise.
        docked: ``(K,)`` bool, docked from the beginning.
        collisions: Whether robots count when near each other or near a moving body.
        penalty: What a violation costs per step.
        moving: ``(H, O, d)`` places of moving bodies after every step.
        moving_radius: ``(O,)``.
        seed: Two uint32 words.
        step: Number of the denoising step.
        tile_range: First tile and the one after the last.
        kept: ``(K, H, P, 2, M / 4)`` the noise, in ``P`` pairs of components, output; ``M`` rounded up to whole tiles.
        rewards: Output.
    """
    use_wide_registers()
    num_robots, num_samples = rewards.shape
    w = tiles.aligned_zeros(num_robots * STRIDE)
    controls = tiles.aligned_zeros(5 * TILE)
    standing = np.empty(num_robots, np.bool_)
    scratch = make_scratch(num_robots, moving.shape[1], arrays.goal.shape[1])
    measure_strides(arrays.limits, arrays.time_step[0], moving, scratch.stride)
    for index in range(tile_range[0], tile_range[1]):
        first = index * TILE
        _score_tile(
            arrays, offset, scale, docked, collisions, penalty, moving, moving_radius, seed, step, index * DRAWS,
            kept, w, controls, standing, scratch,
        )  # fmt: skip
        for k in range(num_robots):
            # The last tile may reach beyond the last sample.
            for s in range(min(TILE, num_samples - first)):
                rewards[k, first + s] = w[k * STRIDE + TOTAL * TILE + s] / np.float32(offset.shape[0])


@cached_kernel(SOURCES, **OPTIONS)
def average_noise(kept: Any, odd: Any, even: Any, time_range: Any, first_moment: Any, second_moment: Any) -> None:
    """Weighted mean of the noise, and of its square.

    Args:
        kept: The noise that :func:`score_tiles` kept.
        odd: ``(2, K, M / 4)`` weights summed over the samples that share a counter, times the cosine of their turn and
            times its sine.
        even: ``(2, K, M / 4)`` the same with the squares of cosine and sine.
        time_range: First time step and the one after the last.
        first_moment: ``(H, K, m)``, output.
        second_moment: ``(H, K, m)``, output, or an empty array to do without.
    """
    num_controls = first_moment.shape[2]
    for t in range(time_range[0], time_range[1]):
        for k in range(first_moment.shape[1]):
            for pair in range(kept.shape[2]):
                x, y, last = kept[k, t, pair, 0], kept[k, t, pair, 1], 2 * pair + 1
                first_moment[t, k, last - 1] = _dot(odd[0, k], x) - _dot(odd[1, k], y)
                if last < num_controls:
                    first_moment[t, k, last] = _dot(odd[0, k], y) + _dot(odd[1, k], x)
                if second_moment.size > 0:
                    second_moment[t, k, last - 1] = _dot_squares(even[0, k], x) + _dot_squares(even[1, k], y)
                    if last < num_controls:
                        second_moment[t, k, last] = _dot_squares(even[0, k], y) + _dot_squares(even[1, k], x)


@compiled
def _dot(weight: Any, x: Any) -> Any:
    use_wide_registers()
    total = ZERO
    for i in range(weight.shape[0]):
        total += weight[i] * x[i]
    return total


@compiled
def _dot_squares(weight: Any, x: Any) -> Any:
    use_wide_registers()
    total = ZERO
    for i in range(weight.shape[0]):
        total += weight[i] * x[i] * x[i]
    return total
