"""The CPU engine's sampling kernels: perturb, roll out and score a tile of samples in one pass; average in a second.

The first pass makes the noise of a tile where it is used, moves the robots, checks contacts and adds up rewards, with
everything the tile needs in cache. It takes a block of steps at a time, robot by robot, so that a robot's rows stay in
the first level of the cache, and checks contacts once all robots have moved. It keeps the noise for the second pass: a
quarter of a number per sample and control, because samples share it, which is a third of the time of making it again.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core import collision, dynamics, reward, transition
from d4orm_env.core.dynamics import MODELS, Model
from d4orm_env.engine import lanes, noise, proximity, tiles
from d4orm_env.engine.caching import cached_kernel, fingerprint
from d4orm_env.engine.lanes import TILE, copy_chunk, subtract_where, use_wide_registers
from d4orm_env.engine.noise import DRAWS
from d4orm_env.engine.proximity import BLOCK, enclose, make_scratch, mark_robots, near_static, place_of
from d4orm_env.engine.tiles import (
    HOLONOMIC2D,
    HOLONOMIC3D,
    INLINED,
    NOWHERE,
    ONE,
    OPS,
    OPTIONS,
    READ,
    VELOCITY2D,
    WRITE,
    ZERO,
    compiled,
    inlined,
    make_stepper,
)

# First rows of a robot in the workspace: see tiles, which has others because it keeps more of a robot.
STATE, DOCKED, TOTAL, ROWS = 0, 6, 7, 9
STRIDE = ROWS * TILE

HALF = np.float32(0.5)

CONTROL_ROWS = 3
"""Rows of one step's controls."""

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
def _draw(key: Any, first: Any, draws: Any) -> None:
    """Fill two rows with normals, from counter number ``first`` on."""
    use_wide_registers()
    for s in range(DRAWS):
        x, y = noise.normal_pair(np.uint32(first + s), key, BIT_OPS)
        draws[s] = x
        draws[DRAWS + s] = y


@compiled
def _copy(source: Any, target: Any) -> None:
    for i in range(target.shape[0]):
        target[i] = source[i]


@inlined
def _draw_block(keys: Any, first: Any, begin: Any, count: Any, num_pairs: Any, kept: Any, draws: Any) -> None:
    """Draw a robot's noise of a block of ``count`` steps.

    Args:
        keys: ``(2, K H P)`` see :func:`_fill_keys`.
        first: The first counter number.
        begin: Number of the robot's stream at the first step.
        count: Steps in the block.
        num_pairs: ``P``, pairs of components.
        kept: ``(K H P 2 M / 4,)`` where the noise is kept, output.
        draws: ``(BLOCK 4 DRAWS,)`` the same noise, two rows for each of up to two pairs of components, output.
    """
    counters = kept.shape[0] // (2 * keys.shape[1])
    for i in range(count):
        for pair in range(num_pairs):
            stream, row = begin + i * num_pairs + pair, (2 * i + pair) * 2 * DRAWS
            _draw((keys[0, stream], keys[1, stream]), first, draws[row : row + 2 * DRAWS])
            copy_chunk(draws, row, kept, 2 * stream * counters + first)
            copy_chunk(draws, row + DRAWS, kept, (2 * stream + 1) * counters + first)


# The four samples that share their draws, see :func:`noise.turned`, of which ``o`` is the mean and ``c`` the scale.


@compiled
def _turn2(o: Any, c: Any, d: Any, s: Any) -> Any:
    x, y = d[s], d[DRAWS + s]
    a, b, across, along = c[0] * x, c[1] * y, c[0] * y, c[1] * x
    return (o[0] + a, o[1] + b), (o[0] - a, o[1] - b), (o[0] - across, o[1] + along), (o[0] + across, o[1] - along)


@compiled
def _turn3(o: Any, c: Any, d: Any, s: Any) -> Any:
    first, second, third, fourth = _turn2(o, c, d, s)
    # Of the second pair one component is left over.
    a, across = c[2] * d[2 * DRAWS + s], c[2] * d[3 * DRAWS + s]
    z = o[2]
    return (*first, z + a), (*second, z - a), (*third, z - across), (*fourth, z + across)


@compiled
def _vector2(x: Any) -> Any:
    return (x[0], x[1])


@compiled
def _vector3(x: Any) -> Any:
    return (x[0], x[1], x[2])


_TURN = {2: _turn2, 3: _turn3}
_VECTOR = {2: _vector2, 3: _vector3}


def _runner(model: Model) -> Any:
    """The compiled steps of one robot of this model in every sample of a tile, which add its reward without violations.
    The draws and controls are the same few rows for every robot: they stay in cache.
    """
    move, dock = make_stepper(model)
    limit_control = inlined(model.functions.limit_control)
    read_x, write_x = READ[model.state_size], WRITE[model.state_size]
    read_u, write_u = READ[model.control_size], WRITE[model.control_size]
    turn, vector, dimension = _TURN[model.control_size], _VECTOR[model.control_size], model.dimension

    @compiled
    def run(
        limits: Any, h: Any, docking: Any, goal: Any, inverse: Any, offset: Any, scale: Any, draws: Any, controls: Any,
        places: Any, w: Any,
    ) -> None:  # fmt: skip
        use_wide_registers()
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
                standing = w[DOCKED * TILE + s] > ZERO
                x = move(standing, read_x(w, STATE * TILE, s), read_u(u, 0, s), limits, h)
                write_x(w, STATE * TILE, s, x)
            for s in range(TILE):
                standing = w[DOCKED * TILE + s] > ZERO
                x, gap2, docked = dock(standing, read_x(w, STATE * TILE, s), read_u(u, 0, s), goal, docking)
                write_x(w, STATE * TILE, s, x)
                w[DOCKED * TILE + s] = ONE if docked else ZERO
                w[TOTAL * TILE + s] += reward.step_reward(np.sqrt(gap2), inverse, ZERO, ZERO, ONE)
            _copy(w[: dimension * TILE], places[i * dimension * TILE : (i + 1) * dimension * TILE])

    return run


_run_holonomic2d = _runner(MODELS["holonomic2d"])
_run_holonomic3d = _runner(MODELS["holonomic3d"])
_run_velocity2d = _runner(MODELS["velocity2d"])
_run_differential_drive = _runner(MODELS["differential_drive"])


@inlined
def _run_robot(
    code: Any, limits: Any, h: Any, docking: Any, goal: Any, inverse: Any, offset: Any, scale: Any, draws: Any,
    controls: Any, places: Any, w: Any,
) -> None:  # fmt: skip
    """Move one robot a block of steps in every sample of the tile and add its reward, violations aside."""
    if code == HOLONOMIC2D:
        _run_holonomic2d(limits, h, docking, goal, inverse, offset, scale, draws, controls, places, w)
    elif code == HOLONOMIC3D:
        _run_holonomic3d(limits, h, docking, goal, inverse, offset, scale, draws, controls, places, w)
    elif code == VELOCITY2D:
        _run_velocity2d(limits, h, docking, goal, inverse, offset, scale, draws, controls, places, w)
    else:
        _run_differential_drive(limits, h, docking, goal, inverse, offset, scale, draws, controls, places, w)


@inlined
def _add_standing(goal: Any, inverse: Any, count: Any, w: Any) -> None:
    """Add the reward, violations aside, of ``count`` steps in which the robot does not move."""
    for s in range(TILE):
        gap2 = ZERO
        for axis in range(goal.shape[0]):
            gap = w[(STATE + axis) * TILE + s] - goal[axis]
            gap2 += gap * gap
        w[TOTAL * TILE + s] += count * reward.step_reward(np.sqrt(gap2), inverse, ZERO, ZERO, ONE)


@inlined
def _all_docked(w: Any) -> Any:
    if w[DOCKED * TILE] == ZERO:
        return False
    total = ZERO
    for s in range(TILE):
        total += w[DOCKED * TILE + s]
    return total == np.float32(TILE)


@inlined
def _begin_tile(arrays: Any, docked: Any, w: Any) -> None:
    for k in range(arrays.radius.shape[0]):
        robot = w[k * STRIDE : (k + 1) * STRIDE]
        for i in range(arrays.start.shape[1]):
            robot[(STATE + i) * TILE : (STATE + i + 1) * TILE] = arrays.start[k, i]
        robot[DOCKED * TILE : (DOCKED + 1) * TILE] = ONE if docked[k] else ZERO
        robot[TOTAL * TILE : (TOTAL + 1) * TILE] = ZERO


@inlined
def _stay(dimension: Any, w: Any, places: Any) -> None:
    """Fill the places of every step of a block with where the robot is."""
    for step in range(BLOCK):
        _copy(w[: dimension * TILE], places[step * dimension * TILE : (step + 1) * dimension * TILE])


@compiled
def _score_tile(
    arrays: Any, offset: Any, scale: Any, docked: Any, collisions: Any, penalty: Any, moving: Any, moving_radius: Any,
    keys: Any, counter: Any, kept: Any, w: Any, places: Any, draws: Any, controls: Any, standing: Any, scratch: Any,
) -> None:  # fmt: skip
    """Roll out a tile of samples, noise beginning with this counter; leave summed rewards in rows TOTAL."""
    num_steps, num_robots, num_controls = offset.shape
    num_pairs = (num_controls + 1) // 2
    # Taken out of the tuple once: every access counts a reference, which costs as much as several samples.
    codes, all_limits, goals, inverse = arrays.model_codes, arrays.limits, arrays.goal, arrays.inverse_initial_distance
    h = transition.TimeStep(arrays.time_step[0], arrays.time_step[1], arrays.time_step[2], arrays.time_step[3])
    docking, dimension = (arrays.squared_goal_radius, arrays.squared_goal_speed), goals.shape[1]
    radius, margin = arrays.radius, arrays.margin
    standing[:] = False
    _begin_tile(arrays, docked, w)
    near, boxes = scratch.near, scratch.boxes
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
            limits = (all_limits[k, 0], all_limits[k, 1], all_limits[k, 2])
            goal = (goals[k, 0], goals[k, 1], goals[k, dimension - 1])
            last = first + count
            _run_robot(
                codes[k], limits, h, docking, goal, inverse[k], offset[first:last, k], scale[first:last, k], draws,
                controls, own_places, robot,
            )  # fmt: skip
            # Once a robot stands in every sample nothing about it changes any more: neither its place nor its flags
            # towards static obstacles.
            rest = 0
            if _all_docked(robot):
                standing[k] = True
                rest = num_steps - (first + count)
                _add_standing(goals[k], inverse[k], np.float32(rest), robot)
            enclose(k, radius[k] + HALF * margin, dimension, places, boxes)
            if near_static(k, dimension, scratch):
                for step in range(count):
                    touch = tiles.near_obstacles(
                        arrays, radius[k] + margin, place_of(k, step, dimension), place_of(num_robots, 0, dimension),
                        places,
                    )  # fmt: skip
                    steps = np.float32(1 + rest if step == count - 1 else 1)
                    subtract_where(robot, TOTAL * TILE, touch, steps * penalty)
        if collisions:
            mark_robots(radius, margin, moving, moving_radius, first, count, places, scratch)
            for k in range(num_robots):
                for step in range(count):
                    if near[k, step] != NOWHERE:
                        subtract_where(w, k * STRIDE + TOTAL * TILE, near[k, step], penalty)


@compiled
def _fill_keys(seed: Any, step: Any, num_robots: Any, num_steps: Any, num_pairs: Any, keys: Any) -> None:
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
    dimension = arrays.goal.shape[1]
    w = tiles.aligned_zeros(num_robots * STRIDE)
    places = tiles.aligned_zeros(place_of(num_robots, 0, dimension) + TILE)
    draws = tiles.aligned_zeros(BLOCK * 4 * DRAWS)
    controls = tiles.aligned_zeros(BLOCK * CONTROL_ROWS * TILE)
    num_steps, num_pairs = kept.shape[1], kept.shape[2]
    keys = np.empty((2, num_robots * num_steps * num_pairs), np.uint32)
    _fill_keys(seed, step, num_robots, num_steps, num_pairs, keys)
    standing = np.empty(num_robots, np.bool_)
    scratch = make_scratch(arrays, moving.shape[1])
    for index in range(tile_range[0], tile_range[1]):
        first = index * TILE
        _score_tile(
            arrays, offset, scale, docked, collisions, penalty, moving, moving_radius, keys, index * DRAWS,
            kept.reshape(-1), w, places, draws, controls, standing, scratch,
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
