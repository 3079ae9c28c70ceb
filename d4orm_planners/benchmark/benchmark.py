"""The benchmark: what a denoising step, an iteration, an environment step and a first plan take on this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import numpy as np
from pydantic import Field

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.dynamics import COMMON, get_model
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances import Delay, Dropout, StateNoise
from d4orm_env.disturbances.disturbance import AnyDisturbance
from d4orm_env.engine.base import SamplingTask
from d4orm_env.engine.choice import get_engine
from d4orm_env.engine.threads import available_cores
from d4orm_env.scenarios import make_problem
from d4orm_planners.benchmark.probes import measure_memory, measure_startup
from d4orm_planners.benchmark.timing import Row, Spread, in_turn, measure
from d4orm_planners.benchmark.walls import Where, boxed_problem, measure_index, measure_obstacles
from d4orm_planners.d4orm import D4orm
from d4orm_planners.episode import open_env
from d4orm_planners.registry import make_planner
from d4orm_planners.settings import CheckedSettings, Count, Positive, Samples, Steps, Whole

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

ENGINES = ("cpu", "jax", "plain")
MODELS = (*COMMON, "unicycle", "car")
PRESETS = (None, "paper")

Robots = Annotated[Count, Field(le=10_000)]
"""As many as scenarios make."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkSettings(CheckedSettings):
    """What to measure, and how long.

    Attributes:
        num_robots: Team sizes.
        models: Robot models.
        engines: Of :data:`ENGINES`; ``"plain"`` is :mod:`d4orm_planners.benchmark.plain`, which has the common models.
        num_samples: ``M``.
        horizon: ``H``.
        num_steps: Denoising steps in an iteration.
        repetitions: Calls per measurement at most.
        time_limit: Seconds per measurement, after which no further call begins.
        iteration_limit: Whole iterations expected to take longer than this are left out [s].
        most_robots_slow: Largest team for the engines other than the CPU engine.
        env_steps: Environment steps per repetition.
        num_worlds: Worlds in the batched environment.
        plan_robots: Team sizes for the first feasible plan.
        seeds: Seeds ``0, 1, ...`` per team size.
        plan_time_limit: Seconds per plan.
        thread_robots: Team sizes whose iterations are timed with several threads and with one.
        memory_robots: Team size of the memory measurement.
        obstacles: How many boxes stand among the ways of 8 robots.
        far_obstacles: The same of boxes far away; also what environments are stepped among.
        map_cells: Cells along a side of the maps whose index of obstacles is timed.

    Raises:
        ValueError: If a value makes no sense; the message names it.
    """

    num_robots: tuple[Robots, ...] = (4, 8, 16, 32, 64, 100)
    models: tuple[str, ...] = MODELS
    engines: tuple[str, ...] = ENGINES
    num_samples: Samples = 1024
    horizon: Steps = 100
    num_steps: Steps = 100
    repetitions: Count = 20
    time_limit: Positive = 2.0
    iteration_limit: Positive = 20.0
    most_robots_slow: Annotated[Whole, Field(ge=0)] = 16
    env_steps: Count = 2000
    num_worlds: Steps = 1024
    plan_robots: tuple[Robots, ...] = (4, 8, 12, 16)
    seeds: Count = 20
    plan_time_limit: Positive = 20.0
    thread_robots: tuple[Robots, ...] = (8, 16, 64)
    memory_robots: Robots = 64
    obstacles: tuple[Count, ...] = (4, 200, 1000, 5000)
    far_obstacles: tuple[Count, ...] = (200,)
    map_cells: tuple[Count, ...] = (32, 256)

    def __post_init__(self) -> None:
        super().__post_init__()
        for model in self.models:
            get_model(model)
        for engine in self.engines:
            if engine not in ENGINES:
                raise ValueError(f"engine {engine!r} is no engine of the benchmark; choose from {', '.join(ENGINES)}")


QUICK: Mapping[str, object] = {
    "num_robots": (4, 8),
    "models": ("holonomic2d", "differential_drive"),
    "num_steps": 20,
    "repetitions": 3,
    "time_limit": 0.5,
    "iteration_limit": 2.0,
    "most_robots_slow": 8,
    "env_steps": 500,
    "num_worlds": 128,
    "plan_robots": (4, 8),
    "seeds": 2,
    "plan_time_limit": 5.0,
    "thread_robots": (8,),
    "memory_robots": 16,
    "obstacles": (4, 200),
    "map_cells": (32,),
}
"""What differs in a benchmark of about a minute, for a first look."""

FIRST_STEPS = 5
"""Steps at the largest noise that are run together to time one."""

DISTURBANCES: tuple[AnyDisturbance, ...] = (Delay(2), Dropout(0.3), StateNoise(0.02, 0.05))
"""With what environments are stepped beside those that nothing disturbs."""

RIGID = ("holonomic2d", "differential_drive")
"""Models that are stepped as rigid bodies, where MuJoCo is installed."""

Run: TypeAlias = Callable[[FloatArray, bool], object]
"""``(noise_scale, collisions)`` to what is timed."""

Part = tuple[str, str, Callable[[], Row]]


def circle(num_robots: int, model: str, horizon: int) -> Problem:
    """The paper's circle, 5 m wide, and wider from 28 robots on so that all find room."""
    return make_problem("circle", num_robots=num_robots, model=model, horizon=horizon, diameter=diameter(num_robots))


def diameter(num_robots: int) -> float:
    """Of the circle [m]: 18 m for 100 robots, as in the paper."""
    return max(5.0, 0.18 * num_robots)


def thread_counts() -> list[int]:
    """Two, four and so on, to as many as this process has cores."""
    cores = available_cores()
    return sorted({cores, *(2**power for power in range(1, cores.bit_length()))} - {1})


def parts(settings: BenchmarkSettings) -> Iterator[Part]:
    """``(section, what, measurement)`` for everything that the settings ask for."""
    for model in settings.models:
        for num_robots in settings.num_robots:
            for engine in settings.engines:
                slow = engine != "cpu" and num_robots > settings.most_robots_slow
                if slow or (engine == "plain" and model not in COMMON):
                    continue
                # The default planner's weights, by robot and with a cut-off, on the engine that it is meant for.
                for preset in PRESETS if engine == "cpu" else ("paper",):
                    label = f"{num_robots} {model} on {engine}"
                    yield "denoising", label, partial(_measure_denoising, settings, engine, preset, num_robots, model)
    for num_robots in settings.thread_robots:
        for threads in thread_counts():
            work = partial(_measure_threads, settings, num_robots, threads)
            yield "threads", f"{num_robots} robots on {threads} threads", work
    for num_boxes in (0, *settings.far_obstacles):
        among = f" among {num_boxes} boxes" if num_boxes else ""
        yield "environments", f"one environment{among}", partial(_measure_env, settings, num_boxes)
        yield "environments", f"{settings.num_worlds} worlds{among}", partial(_measure_worlds, settings, num_boxes)
    for what, measurement in (("one environment", _measure_env), (f"{settings.num_worlds} worlds", _measure_worlds)):
        disturbed = partial(measurement, settings, 0, DISTURBANCES)
        yield "environments", f"{what} with {len(DISTURBANCES)} disturbances", disturbed
    yield "environments", "rooms, along ways", partial(_measure_rooms, settings)
    yield "environments", f"{settings.num_worlds} worlds in JAX", partial(_measure_functional, settings)
    for model in RIGID if find_spec("mujoco") else ():
        yield "environments", f"one environment of {model} in MuJoCo", partial(_measure_rigid, settings, model)
    surroundings: dict[Where, tuple[int, ...]] = {"near": settings.obstacles, "far": settings.far_obstacles}
    for where, counts in surroundings.items():
        for count in counts:
            yield "obstacles", f"{count} boxes {where}", partial(_measure_obstacles, settings, count, where)
    for cells in settings.map_cells:
        yield "index", f"index of {cells} x {cells} cells", partial(measure_index, cells)
    yield "startup", "first plan of a process", partial(measure_startup, 8, min(settings.repetitions, 5))
    size = settings.memory_robots
    memory = partial(measure_memory, size, settings.num_samples, settings.horizon, diameter(size))
    yield "memory", f"memory of {size} robots", memory
    for preset in PRESETS:
        for num_robots in settings.plan_robots:
            yield "plans", f"first plans of {num_robots} robots", partial(_measure_plans, settings, preset, num_robots)


def run_parts(todo: Sequence[Part], progress: Callable[[str, int, int], object]) -> dict[str, list[Row]]:
    """Measurements by section; ``progress(what, number done, number in all)`` is called before each."""
    results: dict[str, list[Row]] = {section: [] for section, _, _ in todo}
    for done, (section, what, work) in enumerate(todo):
        progress(what, done, len(todo))
        results[section].append(work())
    progress("done", len(todo), len(todo))
    return results


def _d4orm(preset: str | None = None, **settings: object) -> D4orm:
    planner = make_planner("d4orm", preset=preset, **settings)
    assert isinstance(planner, D4orm)
    return planner


def _measure_denoising(
    settings: BenchmarkSettings, engine: str, preset: str | None, num_robots: int, model: str
) -> Row:
    problem = circle(num_robots, model, settings.horizon)
    run = _plain_run(problem, settings) if engine == "plain" else _engine_run(problem, settings, engine, preset)
    planner = _d4orm(num_steps=settings.num_steps)
    noise_scale = planner.noise_scale()
    timed = partial(measure, repetitions=settings.repetitions, time_limit=settings.time_limit)
    # Steps in a row, because what a run begins with is no part of a step.
    first = np.repeat(noise_scale[:1], FIRST_STEPS)
    step = timed(lambda: run(first, True)).times(1 / FIRST_STEPS)
    free = timed(lambda: run(first, False)).times(1 / FIRST_STEPS)
    expected = step.median * settings.num_steps
    iteration = timed(lambda: run(noise_scale, True)) if expected <= settings.iteration_limit else None
    robot_steps = settings.num_samples * settings.horizon * num_robots
    pairs = robot_steps * (num_robots - 1) / 2
    return {
        "engine": engine,
        "rules": preset or "default",
        "model": model,
        "num_robots": num_robots,
        "step": step,
        "step_without_collisions": free,
        "iteration": iteration,
        "ns_per_robot_step": step.median / robot_steps * 1e9,
        # What pairs add. It comes out near zero, or below, where they cost less than the measurement varies.
        "ns_per_pair": (step.median - free.median) / pairs * 1e9 if pairs else None,
    }


def _engine_run(
    problem: Problem, settings: BenchmarkSettings, name: str, preset: str | None, num_threads: int | None = None
) -> Run:
    planner = _d4orm(preset=preset, num_samples=settings.num_samples)
    engine, rules = get_engine(name, num_threads), planner.rules()
    base = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)

    def run(noise_scale: FloatArray, collisions: bool) -> None:
        # Groups are those of the last plan's conflicts; before there is one, robots have the credit by themselves.
        credit = "team" if planner.config.credit == "team" else "robot"
        task = SamplingTask(problem, base, collisions=collisions, credit=credit, penalty=planner.config.penalty)
        engine.denoise(task, rules, base, noise_scale, settings.num_samples, 0)

    return run


def _plain_run(problem: Problem, settings: BenchmarkSettings) -> Run:
    from d4orm_planners.benchmark import plain

    planner = _d4orm(preset="paper")
    temperature = float(planner.config.temperature)
    return lambda noise_scale, collisions: plain.denoise_around_rest(
        problem, noise_scale, settings.num_samples, temperature, 0, collisions
    )


def _measure_threads(settings: BenchmarkSettings, num_robots: int, threads: int) -> Row:
    """An iteration by the rules of D4orm's defaults on several threads, beside one on a single thread."""
    problem = circle(num_robots, "holonomic2d", settings.horizon)
    noise_scale = _d4orm(num_steps=settings.num_steps).noise_scale()
    several, single = (_engine_run(problem, settings, "cpu", None, count) for count in (threads, 1))
    with_several, with_one = in_turn(
        lambda: several(noise_scale, True), lambda: single(noise_scale, True), settings.repetitions, settings.time_limit
    )
    return {
        "num_robots": num_robots,
        "threads": threads,
        "iteration": Spread.of(with_several),
        "one_thread": Spread.of(with_one),
        "speedup": Spread.of(np.divide(with_one, with_several).tolist()),
    }


def _measure_obstacles(settings: BenchmarkSettings, num_boxes: int, where: Where) -> Row:
    """An iteration of the paper's planner among boxes, beside one in the open."""
    planner = _d4orm(preset="paper", num_steps=settings.num_steps)
    noise_scale = planner.noise_scale()

    def iterate(problem: Problem) -> None:
        _engine_run(problem, settings, "cpu", "paper")(noise_scale, True)

    return measure_obstacles(iterate, num_boxes, where, settings.repetitions, settings.time_limit)


def _measure_env(settings: BenchmarkSettings, num_boxes: int, disturbances: Sequence[AnyDisturbance] = ()) -> Row:
    """One PettingZoo environment of 8 robots under random controls, resets included."""
    from d4orm_env import navigation_v0

    env = navigation_v0.parallel_env(problem=boxed_problem(num_boxes, "near"), disturbances=disturbances)
    return _rate("parallel_env", 1, num_boxes, disturbances, _measure_steps(settings, env, settings.env_steps))


def _measure_rigid(settings: BenchmarkSettings, model: str) -> Row:
    """The same of rigid bodies in MuJoCo."""
    env = open_env(circle(8, model, settings.horizon), "mujoco")
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

    def steps() -> None:
        for index in range(count):
            if not env.agents:
                env.reset()
            env.step(table[index % len(table)])

    spread = measure(steps, settings.repetitions, settings.time_limit)
    env.close()
    return spread.times(1 / count)


def _measure_worlds(settings: BenchmarkSettings, num_boxes: int, disturbances: Sequence[AnyDisturbance] = ()) -> Row:
    """The batched environment of 8 robots per world under random controls, auto-reset included."""
    size, problem = settings.num_worlds, boxed_problem(num_boxes, "near")
    seconds = _measure_batch(settings, size, problem=problem, disturbances=disturbances)
    return _rate("make_vec", size, num_boxes, disturbances, seconds)


def _measure_rooms(settings: BenchmarkSettings) -> Row:
    """The same in eight rooms that worlds draw from, where robots see their ways and are paid along them."""
    size = max(1, settings.num_worlds // 8)
    along = {"observed_way": True, "progress": "way", "reward": "training"}
    seconds = _measure_batch(settings, size, scenario="rooms", num_robots=8, num_instances=8, **along)
    num_boxes = make_problem("rooms", num_robots=8).world.num_obstacles
    return _rate("make_vec, rooms along ways", size, num_boxes, (), seconds)


def _measure_batch(settings: BenchmarkSettings, size: int, **options: Any) -> Spread:
    """Seconds per step of a world of the batched environment, of ``size`` worlds."""
    import gymnasium

    env = gymnasium.make_vec("d4orm/Navigation-v0", num_envs=size, vectorization_mode="vector_entry_point", **options)
    env.reset(seed=0)
    space = env.single_action_space
    assert isinstance(space, gymnasium.spaces.Box)
    low, high = space.low, space.high
    random = np.random.default_rng(0)
    table = [random.uniform(low, high, (size, *low.shape)).astype(np.float32) for _ in range(16)]
    calls = max(1, settings.env_steps // 10)

    def steps() -> None:
        for index in range(calls):
            env.step(table[index % len(table)])

    spread = measure(steps, settings.repetitions, settings.time_limit)
    env.close()
    return spread.times(1 / (calls * size))


def _measure_functional(settings: BenchmarkSettings) -> Row:
    """Worlds of 8 robots as pure functions of JAX, all in one program: random controls, observations, auto-reset."""
    import jax

    from d4orm_env.functional_env import EnvState, FunctionalEnv

    size, calls = settings.num_worlds, max(1, settings.env_steps // 10)
    env = FunctionalEnv(problem=boxed_problem(0, "near"))
    limits, begin = env.action_limits, jax.jit(jax.vmap(env.reset))

    def move(carry: tuple[EnvState, Any], key: jax.Array) -> tuple[tuple[EnvState, Any], None]:
        (state, total), keys = carry, jax.random.split(key, 1 + size)
        controls = jax.random.uniform(keys[0], (size, *limits.shape), minval=-limits, maxval=limits)
        state, transition = jax.vmap(env.step)(keys[1:], state, controls)
        # What nobody reads would not be computed.
        return (state, total + transition.rewards.sum() + transition.observations.sum()), None

    @jax.jit
    def steps(state: EnvState, key: jax.Array) -> tuple[EnvState, float]:
        return jax.lax.scan(move, (state, 0.0), jax.random.split(key, calls))[0]

    state, _ = begin(jax.random.split(jax.random.key(0), size))
    spread = measure(
        lambda: jax.block_until_ready(steps(state, jax.random.key(1))), settings.repetitions, settings.time_limit
    )
    return _rate("FunctionalEnv", size, 0, (), spread.times(1 / (calls * size)))


def _rate(
    environment: str, num_worlds: int, num_boxes: int, disturbances: Sequence[AnyDisturbance], seconds: Spread
) -> Row:
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


def _measure_plans(settings: BenchmarkSettings, preset: str | None, num_robots: int) -> Row:
    """Planning time to the first feasible plan; a seed without one counts with the time it took to give up."""
    planner = make_planner("d4orm", preset=preset)
    problem = make_problem("circle", num_robots=num_robots)
    plans = [
        planner.solve(problem, seed=seed, time_limit=settings.plan_time_limit) for seed in range(settings.seeds)
    ]  # fmt: skip
    return {
        "planner": "d4orm",
        "rules": preset or "default",
        "num_robots": num_robots,
        "seeds": settings.seeds,
        "solved": sum(plan.solved for plan in plans),
        "seconds": Spread.of([plan.wall_time for plan in plans]),
        "iterations": Spread.of([plan.iterations for plan in plans]),
        "travel_time": Spread.of([plan.metrics["travel_time"] for plan in plans]),
    }
