"""The JAX engine's sampling: a whole denoising run is one compiled loop.

Nothing returns to the host before it ends, or before the next look at whether it is to be stopped. Where there are
several devices each rolls out its share of the samples, and all make the mean of all samples: plans are those of one
device, but for what compilers round differently.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine import noise
from d4orm_env.jax.jax_engine import BIT_OPS, JaxEngine, moving_contacts, obstacle_contacts, rewards_of, robot_contacts
from d4orm_env.jax.jax_footprints import MovingBodies
from d4orm_env.jax.jax_motion import Worlds, roll_out
from d4orm_planners.engine.sampling_types import (
    MovingObstacles,
    SamplingResult,
    SamplingRules,
    SamplingTask,
    StepWatcher,
)

LOOK = 0.03  #: Seconds between looks at whether a run is to be stopped, if longer than a step; at most twice as many


AT_ONCE = 2**24
"""Discs whose rewards are computed at once, each of a robot, a sample and a step; of more, steps are taken in turn."""
FOOTPRINT = 32  #: Discs that a footprint counts as: its corners and edges are compared with those of others


class _Static(NamedTuple):
    """Static inputs of a compiled denoising run, besides shapes."""

    models: tuple[str, ...]
    rules: SamplingRules
    num_samples: int
    collisions: bool
    per_pair: bool
    credit: str
    devices: int


class _Inputs(NamedTuple):
    """Inputs that it is called with."""

    arrays: ProblemArrays
    penalties: Array
    units: Array
    base: Array
    arrived: Array
    moving: MovingObstacles | None
    seed: tuple[Array, Array]


def _replicated(devices: int) -> NamedSharding:
    """The same array on each of the devices."""
    mesh = jax.make_mesh((devices,), ("samples",), (AxisType.Auto,), devices=jax.local_devices()[:devices])
    return NamedSharding(mesh, P())


def _deformations(samples: Array, inputs: _Inputs, step: Array, mean: Array, scale: Array) -> Array:
    """``(H, K, m, M)`` of the deformation's samples of those numbers ``(M,)``."""
    horizon, num_robots, size = mean.shape
    counters, cosine, sine = noise.turned(samples[None, None], BIT_OPS)
    times = jnp.arange(horizon, dtype=jnp.uint32)[:, None, None]
    robots = jnp.arange(num_robots, dtype=jnp.uint32)[None, :, None]
    low, high = inputs.seed
    draws: list[Array] = []
    for pair in range((size + 1) // 2):
        key = noise.stream_key(low, high, step, robots, times, jnp.uint32(pair), BIT_OPS)
        x, y = noise.normal_pair(counters, key, BIT_OPS)
        draws += [cosine * x - sine * y, sine * x + cosine * y]
    return mean[..., None] + scale[..., None] * jnp.stack(draws[:size], axis=2)


def _score(static: _Static, inputs: _Inputs, step: Array, mean: Array, scale: Array) -> tuple[Array, Array]:
    """Roll all samples out; returns rewards ``(K, M)``, means over time, and the deformations ``(H, K, m, M)``."""
    samples = jnp.arange(static.num_samples, dtype=jnp.uint32)
    if static.devices == 1:
        deformations = _deformations(samples, inputs, step, mean, scale)
        return _rewards(static, inputs, deformations), deformations
    all_of_it = _replicated(static.devices)

    def share(samples: Array, inputs: _Inputs, *rest: Array) -> Array:
        return _rewards(static, inputs, _deformations(samples, inputs, *rest))

    by_device = jax.shard_map(
        share,
        mesh=all_of_it.mesh,
        in_specs=(P("samples"), P(), P(), P(), P()),
        out_specs=P(None, "samples"),
        check_vma=False,  # Pallas does not say what varies
    )
    scored = by_device(samples, inputs, step, mean, scale), _deformations(samples, inputs, step, mean, scale)
    rewards, deformations = (jax.lax.with_sharding_constraint(part, all_of_it) for part in scored)
    return rewards, deformations


def _rewards(static: _Static, inputs: _Inputs, deformations: Array) -> Array:
    """``(K, M)`` means over time of deformations ``(H, K, m, M)``."""
    arrays = inputs.arrays
    num_robots, size, num_samples = deformations.shape[1:]
    begin = Worlds(
        jnp.broadcast_to(arrays.start[..., None], (*arrays.start.shape, num_samples)),
        jnp.broadcast_to(inputs.arrived[:, None], (num_robots, num_samples)),
        jnp.zeros((num_robots, size, num_samples), jnp.float32),
    )
    after = roll_out(static.models, arrays, begin, inputs.base[..., None] + deformations)
    obstacles = None if inputs.moving is None else (inputs.moving.positions, inputs.moving.headings)
    bodies = num_robots if arrays.footprints is None else FOOTPRINT * len(arrays.footprints.robot)
    horizon = len(after.state)
    steps = max(
        n for n in range(1, horizon + 1) if horizon % n == 0 and (n == 1 or n * bodies * num_samples <= AT_ONCE)
    )
    reward = partial(_step_rewards, static, inputs)
    rewards: Array
    if steps < horizon:
        rewards = jax.lax.map(lambda step: reward(*step), (after.state, obstacles), batch_size=steps)
    else:
        rewards = jax.vmap(reward)(after.state, obstacles)
    return _sum(rewards) / jnp.float32(len(rewards))


def _sum(rows: Array) -> Array:
    """Sum over the first axis, pair by pair: a compiler's own order changes with the number of samples."""
    while len(rows) > 1:
        half = len(rows) // 2
        rows = jnp.concatenate([rows[:half] + rows[half : 2 * half], rows[2 * half :]])
    return rows[0]


def _step_rewards(
    static: _Static, inputs: _Inputs, state: Array, obstacle: tuple[FloatArray, FloatArray | None] | None
) -> Array:
    """``(K, M)`` rewards of one step, which led to ``state`` ``(K, n, M)``."""
    arrays = inputs.arrays
    near_robot = jnp.zeros((len(state), state.shape[-1]), int)
    if static.collisions:
        near_robot = robot_contacts(arrays, state, arrays.margin)
        if inputs.moving is not None and obstacle is not None:
            bodies = MovingBodies(*obstacle, inputs.moving.radius, inputs.moving.footprints)
            near_robot += moving_contacts(arrays, state, bodies, arrays.margin)
    if not static.per_pair:
        near_robot = near_robot > 0
    near_obstacle = obstacle_contacts(arrays, state, arrays.margin)
    position = state[:, : arrays.goal.shape[1]]
    return rewards_of(arrays, position, near_robot, near_obstacle, inputs.penalties[:, None])


def _weighted_mean(samples: Array, weights: Array) -> Array:
    """``(H, K, m)`` means of samples ``(H, K, m, M)``; a product of matrices would be rounded to 10 bits on a GPU."""
    return (samples * weights[None, :, None]).sum(axis=-1)


class _DenoisingState(NamedTuple):
    """A denoising run on its way: means, factors on the schedule, rewards ``(N,)`` so far, samples left out."""

    mean: Array
    factor: Array
    rewards: Array
    excluded: Array


def _denoise(
    static: _Static, inputs: _Inputs, noise_scale: Array, run: _DenoisingState, begin: Array, end: Array
) -> _DenoisingState:
    """The steps from ``begin`` to before ``end``; both are arguments, so that one compilation serves all parts."""

    def update(step: Array, run: _DenoisingState) -> _DenoisingState:
        mean, factor, scale = run.mean, run.factor, run.factor * noise_scale[step] * inputs.units[None]
        rewards, deformations = _score(static, inputs, step.astype(jnp.uint32), mean, scale)
        if static.credit == "team":
            rewards = _sum(rewards)[None] / jnp.float32(len(rewards))
        finite = jnp.isfinite(rewards)
        # A sample that blew up has weight zero, and zero times infinity must not reach the mean.
        usable = jnp.where(jnp.isfinite(deformations), deformations, 0)
        extra: tuple[Array, ...] = ()
        if static.rules.importance:
            slope = (inputs.base + mean) / scale**2
            ratio = -_sum(((usable - mean[..., None]) * slope[..., None]).sum(axis=2))
            ratio = _sum(ratio)[None] if static.credit == "team" else ratio
            extra = (static.rules.importance * ratio,)
        weights = static.rules.weights(jnp.where(finite, rewards, -jnp.inf), jnp, *extra)
        weights = jnp.broadcast_to(jnp.asarray(weights, jnp.float32), (mean.shape[1], static.num_samples))
        new_mean = _weighted_mean(usable, weights)
        # Nothing to go by: every sample was excluded.
        new_mean = jnp.where((weights.sum(axis=-1) > 0)[None, :, None], new_mean, mean)
        if static.rules.adapt is not None:
            deviation2 = _weighted_mean((usable - new_mean[..., None]) ** 2, weights)
            factor = jnp.asarray(static.rules.adapt(deviation2 / inputs.units[None] ** 2, jnp), jnp.float32)
        usable_samples = finite.sum(dtype=jnp.int32)
        average = jnp.where(finite, rewards, 0).sum() / jnp.maximum(usable_samples, 1).astype(jnp.float32)
        excluded = run.excluded + (finite.size - usable_samples)
        return _DenoisingState(new_mean, factor, run.rewards.at[step].set(average), excluded)

    return jax.lax.fori_loop(begin, end, update, run)


def _devices(num_samples: int) -> int:
    """Devices among which so many samples are shared: all, or one where that does not come out even."""
    devices = jax.local_device_count()
    return devices if num_samples % devices == 0 else 1


@lru_cache(maxsize=256)
def _compiled_denoise(
    static: _Static, treedef: jax.tree_util.PyTreeDef, shapes: tuple[tuple[tuple[int, ...], np.dtype[np.generic]], ...]
) -> jax.stages.Compiled:
    """The denoising run compiled for arguments of these shapes, ahead of the call."""
    sharding = None if static.devices == 1 else _replicated(static.devices)
    leaves = [jax.ShapeDtypeStruct(shape, dtype, sharding=sharding) for shape, dtype in shapes]
    arguments = jax.tree.unflatten(treedef, leaves)
    return jax.jit(partial(_denoise, static)).lower(*arguments).compile()


class JaxSamplingEngine(JaxEngine):
    """The JAX engine that samples as well. Stateless: all instances are alike."""

    def _lower(
        self,
        task: SamplingTask,
        rules: SamplingRules,
        mean: FloatArray,
        noise_scale: FloatArray,
        num_samples: int,
        seed: int,
    ) -> tuple[jax.stages.Compiled, tuple[Any, ...]]:
        problem = task.problem
        arrived = np.zeros(problem.num_robots, bool) if task.arrived is None else task.arrived
        scored: tuple[Any, ...] = (
            task.arrays, task.penalties, problem.team.control_units, task.base, arrived, task.moving,
            noise.seed_words(seed),
        )  # fmt: skip
        counted = task.collisions, task.penalty_per_pair, task.credit
        static = _Static(problem.team.models, rules, num_samples, *counted, _devices(num_samples))
        scale = np.asarray(noise_scale, np.float32)
        begun: tuple[Any, ...] = mean, task.first_factor, np.zeros_like(scale), np.int32(0)
        arguments = _Inputs(*scored), scale, _DenoisingState(*begun), np.int32(0), np.int32(len(scale))
        leaves, treedef = jax.tree.flatten(jax.tree.map(np.asarray, arguments))
        return _compiled_denoise(static, treedef, tuple((leaf.shape, leaf.dtype) for leaf in leaves)), arguments

    def prepare(self, task: SamplingTask, rules: SamplingRules, noise_scale: FloatArray, num_samples: int) -> None:
        self._lower(task, rules, task.base, noise_scale, num_samples, 0)

    def denoise(
        self,
        task: SamplingTask,
        rules: SamplingRules,
        mean: FloatArray,
        noise_scale: FloatArray,
        num_samples: int,
        seed: int,
        should_stop: Callable[[], bool] | None = None,
        watcher: StepWatcher | None = None,
    ) -> SamplingResult:
        """See :meth:`d4orm_planners.engine.sampling_types.SamplingEngine.denoise`.

        Raises:
            ValueError: If there is a watcher: the steps are compiled into one program.
        """
        if watcher is not None:
            raise ValueError("engine 'jax' runs all denoising steps as one program; to watch them, use engine='cpu'")
        compiled, arguments = self._lower(task, rules, mean, noise_scale, num_samples, seed)
        devices = _devices(num_samples)
        inputs, scale, run, *_ = jax.device_put(arguments, None if devices == 1 else _replicated(devices))
        done, total = 0, len(noise_scale)
        part = total if should_stop is None else 1
        while done < total and not (should_stop is not None and should_stop()):
            start, first = time.perf_counter(), done
            done = min(done + part, total)
            run = jax.block_until_ready(compiled(inputs, scale, run, np.int32(first), np.int32(done)))
            if time.perf_counter() - start < LOOK:
                part *= 2
        rewards = np.asarray(run.rewards)[:done]
        return SamplingResult(np.asarray(run.mean), rewards, int(run.excluded), np.asarray(run.factor))
