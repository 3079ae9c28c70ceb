"""Steps of environments: one, worlds in a batch, pure functions of JAX, and rigid bodies, under random controls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from d4orm_env import navigation_v0
from d4orm_env.core.lazy import LazyModule
from d4orm_env.disturbances import Delay, Dropout, StateNoise
from d4orm_env.disturbances.disturbance import AnyDisturbance
from d4orm_env.footprints import Box, Footprint
from d4orm_env.scenarios import make_problem
from d4orm_planners.base.episode import open_env
from d4orm_planners.evaluation.measuring import BenchmarkSettings, Measurement, Spread, measure
from d4orm_planners.evaluation.probes import boxed_problem

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

    from d4orm_env.jax import functional_env
else:
    functional_env = LazyModule("d4orm_env.jax.functional_env")

jax: Any = LazyModule("jax")
jnp: Any = LazyModule("jax.numpy")

DISTURBANCES: tuple[AnyDisturbance, ...] = (Delay(2), Dropout(0.3), StateNoise(0.02, 0.05))
"""Disturbances of environments that are stepped beside those that nothing disturbs."""

RIGID = ("holonomic2d", "differential_drive")  #: Models that are stepped as rigid bodies, where MuJoCo is installed
RECTANGLE = Box(0.36, 0.24)  #: Footprint of robots that are stepped beside discs
RAYS, RAY_BOXES = 32, 100  #: Rays of range sensors of environments stepped with them, and boxes that they meet


def measure_env(
    settings: BenchmarkSettings,
    batched: bool,
    num_boxes: int = 0,
    disturbances: Sequence[AnyDisturbance] = (),
    num_rays: int = 0,
    footprint: Footprint | None = None,
) -> Measurement:
    """One PettingZoo environment of 8 robots, or the batched one, under random controls, resets included."""
    problem, size = boxed_problem(num_boxes, "near", footprint), settings.num_worlds if batched else 1
    options: dict[str, Any] = {"problem": problem, "disturbances": disturbances, "observed_rays": num_rays}
    if batched:
        seconds = _measure_batch(settings, size, **options)
    else:
        seconds = _measure_steps(settings, navigation_v0.parallel_env(**options), settings.env_steps)
    variant = (f", {num_rays} rays" if num_rays else "") + (", rectangles" if footprint else "")
    return _rate(("make_vec" if batched else "parallel_env") + variant, size, num_boxes, disturbances, seconds)


def measure_rigid(settings: BenchmarkSettings, model: str) -> Measurement:
    env = open_env(make_problem("circle", num_robots=8, model=model, horizon=settings.horizon), "mujoco")
    seconds = _measure_steps(settings, env, max(1, settings.env_steps // 10))
    return _rate(f"mujoco, {model}", 1, 0, (), seconds)


def _measure_steps(settings: BenchmarkSettings, env: ParallelEnv, count: int) -> Spread:
    """Seconds per step of an environment, ``count`` of them with each repetition."""
    env.reset(seed=0)
    space = env.action_space(env.possible_agents[0])
    random = np.random.default_rng(0)
    table = [
        {agent: random.uniform(space.low, space.high).astype(np.float32) for agent in env.possible_agents}
        for _ in range(64)
    ]
    return _measure_table(settings, env, table, count)


def measure_rooms(settings: BenchmarkSettings) -> Measurement:
    """The batched one in eight rooms that worlds draw from, where robots see their paths and are paid along them."""
    size = max(1, settings.num_worlds // 8)
    along = {"observed_path": True, "progress": "path", "reward": "training"}
    seconds = _measure_batch(settings, size, scenario="rooms", num_robots=8, num_instances=8, **along)
    num_boxes = make_problem("rooms", num_robots=8).world.num_obstacles
    return _rate("make_vec, rooms along paths", size, num_boxes, (), seconds)


def _measure_batch(settings: BenchmarkSettings, size: int, **options: Any) -> Spread:
    """Seconds per step of a world of the batched environment, of ``size`` worlds."""
    env = gymnasium.make_vec("d4orm/Navigation-v0", num_envs=size, vectorization_mode="vector_entry_point", **options)
    env.reset(seed=0)
    space = env.single_action_space
    assert isinstance(space, gymnasium.spaces.Box)
    low, high = space.low, space.high
    random = np.random.default_rng(0)
    table = [random.uniform(low, high, (size, *low.shape)).astype(np.float32) for _ in range(16)]
    return _measure_table(settings, env, table, max(1, settings.env_steps // 10)).times(1 / size)


def _measure_table(settings: BenchmarkSettings, env: Any, actions: Sequence[object], count: int) -> Spread:
    """Seconds per step of an environment under these actions, again and again; a batched one resets itself."""

    def steps() -> None:
        for index in range(count):
            if not getattr(env, "agents", True):
                env.reset()
            env.step(actions[index % len(actions)])

    spread = measure(settings, steps)
    env.close()
    return spread.times(1 / count)


def measure_functional(settings: BenchmarkSettings) -> Measurement:
    """Worlds of 8 robots as pure functions of JAX, all in one program: random controls, observations, auto-reset."""
    size, calls = settings.num_worlds, max(1, settings.env_steps // 10)
    env = functional_env.FunctionalEnv(problem=boxed_problem(0, "near"))
    limits, begin = env.action_limits, jax.jit(jax.vmap(env.reset))

    def move(
        carry: tuple[functional_env.EnvState, Any], key: jax.Array
    ) -> tuple[tuple[functional_env.EnvState, Any], None]:
        (state, total), keys = carry, jax.random.split(key, 1 + size)
        controls = jax.random.uniform(keys[0], (size, *limits.shape), jnp.float32, minval=-limits, maxval=limits)
        state, transition = jax.vmap(env.step)(keys[1:], state, controls)
        # The compiler leaves out results that are not used.
        return (state, total + transition.rewards.sum() + transition.observations.sum()), None

    @jax.jit
    def steps(state: functional_env.EnvState, key: jax.Array) -> tuple[functional_env.EnvState, jax.Array]:
        return jax.lax.scan(move, (state, jnp.float32(0)), jax.random.split(key, calls))[0]

    state, _ = begin(jax.random.split(jax.random.key(0), size))
    spread = measure(settings, lambda: jax.block_until_ready(steps(state, jax.random.key(1))))
    return _rate("FunctionalEnv", size, 0, (), spread.times(1 / (calls * size)))


def _rate(
    environment: str, num_worlds: int, num_boxes: int, disturbances: Sequence[AnyDisturbance], seconds: Spread
) -> Measurement:
    """Seconds per environment step, and steps per second at the median."""
    return {
        "environment": environment,
        "num_worlds": num_worlds,
        "num_robots": 8,
        "obstacles": num_boxes,
        "disturbances": len(disturbances),
        "seconds_per_step": seconds,
        "steps_per_second": 1 / seconds.median,
    }
