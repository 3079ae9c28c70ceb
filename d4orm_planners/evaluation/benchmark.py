"""The benchmark: what a denoising step, an iteration, an environment step and a first plan take on this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence, Set
from functools import partial
from importlib.util import find_spec
from typing import Any, TypeAlias

import numpy as np

from d4orm_env import verify
from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import COMMON
from d4orm_env.engine.choice import resolve_engine
from d4orm_env.engine.threads import available_cores
from d4orm_env.scenarios import make_problem
from d4orm_planners import reference as plain
from d4orm_planners.base.controller import Mode
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.engine.sampling_types import SamplingTask, get_sampling_engine
from d4orm_planners.evaluation import env_steps, probes
from d4orm_planners.evaluation.measuring import BenchmarkSettings, Measurement, Spread, in_turn, measure
from d4orm_planners.sampling.d4orm import D4orm

PRESETS = (None, "paper")

CONTROL_LOOPS: tuple[tuple[str, Mode], ...] = (
    ("holonomic2d", "nominal"), ("holonomic2d", "measured"), ("differential_drive", "measured"), ("car", "measured"),
)  # fmt: skip
"""Models of the robots whose control loops are timed, and the controller's modes."""

FIRST_STEPS = 5  #: Steps at the largest noise that are run together to time one
Run: TypeAlias = Callable[[FloatArray, bool], object]  #: ``(noise_scale, collisions)`` to what is timed
Part = tuple[str, str, Callable[[], Measurement]]


def circle(num_robots: int, model: str, horizon: int) -> Problem:
    """The paper's circle, 5 m wide, and wider from 28 robots on so that all find room."""
    return make_problem("circle", num_robots=num_robots, model=model, horizon=horizon, diameter=diameter(num_robots))


def diameter(num_robots: int) -> float:
    """Return the circle's diameter [m]: 18 m for 100 robots, as in the paper."""
    return max(5.0, 0.18 * num_robots)


def thread_counts() -> list[int]:
    """Two, four and so on, to as many as this process has cores."""
    cores = available_cores()
    return sorted({cores, *(2**power for power in range(1, cores.bit_length()))} - {1})


def parts(settings: BenchmarkSettings) -> Iterator[Part]:
    """``(section, what, measurement)`` for everything that the settings ask for."""
    return (part for part in _parts(settings) if part[0] in settings.sections)


def _parts(settings: BenchmarkSettings) -> Iterator[Part]:
    fast = {"cpu", resolve_engine("auto")}  # JAX where it has an accelerator
    yield from _denoising_parts(settings, fast)
    for num_robots in settings.thread_robots:
        for threads in thread_counts():
            work = partial(_measure_threads, settings, num_robots, threads)
            yield "threads", f"{num_robots} robots on {threads} threads", work
    yield from _environment_parts(settings)
    surroundings: dict[probes.Where, tuple[int, ...]] = {"near": settings.obstacles, "far": settings.far_obstacles}
    for where, counts in surroundings.items():
        for count in counts:
            yield "obstacles", f"{count} boxes {where}", partial(_measure_obstacles, settings, count, where)
    for cells in settings.map_cells:
        yield "index", f"index of {cells} x {cells} cells", partial(probes.measure_index, cells)
    for model, mode in CONTROL_LOOPS:
        yield "robots", f"control loops of {model}, {mode}", partial(probes.measure_robots, settings, model, mode)
    for scenario, size in (("circle", 8), ("warehouse", 16)):
        start = partial(probes.measure_startup, scenario, size, min(settings.repetitions, 5))
        yield "startup", f"first plan of a process, {scenario}", start
    for size in (settings.memory_robots,) if find_spec("resource") else ():  # Windows has none
        memory = partial(probes.measure_memory, size, settings.num_samples, settings.horizon, diameter(size))
        yield "memory", f"memory of {size} robots", memory
    for engine in sorted(fast.intersection(settings.engines)):
        for preset in PRESETS:
            for num_robots in settings.plan_robots:
                work = partial(_measure_plans, settings, engine, preset, num_robots)
                yield "plans", f"first plans of {num_robots} robots on {engine}", work
    yield from _big_team_parts(settings)


def _big_team_parts(settings: BenchmarkSettings) -> Iterator[Part]:
    limits = settings.big_seeds, settings.big_time_limit
    teams: tuple[tuple[str, str, tuple[int, ...], dict[str, Any]], ...] = (
        ("random", "robots", settings.big_random, {}),
        ("warehouse", "robots", settings.big_warehouse, {}),
        ("warehouse", "differential drives", settings.big_drives, {"model": "differential_drive"}),
        ("warehouse", "boxes", settings.big_boxes, probes.BOXES),
        ("warehouse", "boxes without goal headings", settings.big_free_boxes, {"footprint": probes.BOXES["footprint"]}),
    )
    for scenario, what, sizes, robots in teams:
        for size in sizes:
            plan = partial(probes.measure_big_team, scenario, what, size, *limits, **robots)
            yield "big teams", f"first plans of {size} {what}, {scenario}", plan
    for size in settings.improved_robots:
        work = partial(probes.measure_improvement, "random", size, settings.big_seeds, settings.improving_limit)
        yield "improvement", f"improving plans of {size} robots", work
    for size in settings.loop_robots:
        for share, what in ((None, ""), (probes.DEADLINE, " with a deadline")):
            loops = partial(probes.measure_big_loops, size, settings.loops, share)
            yield "big loops", f"control loops of {size} robots{what}", loops


def _denoising_parts(settings: BenchmarkSettings, fast: Set[str]) -> Iterator[Part]:
    for model in settings.models:
        for num_robots in settings.num_robots:
            for engine in settings.engines:
                slow = engine not in fast and num_robots > settings.most_robots_slow
                if slow or (engine == "plain" and model not in COMMON):
                    continue
                # The default planner's weights, by robot and with a cut-off, on the engine that it is meant for.
                for preset in PRESETS if engine == "cpu" else ("paper",):
                    label = f"{num_robots} {model} on {engine}"
                    yield "denoising", label, partial(_measure_denoising, settings, engine, preset, num_robots, model)


def _environment_parts(settings: BenchmarkSettings) -> Iterator[Part]:
    for batched, what in ((False, "one environment"), (True, f"{settings.num_worlds} worlds")):
        measurement = partial(env_steps.measure_env, settings, batched)
        for num_boxes in (0, *settings.far_obstacles):
            yield "environments", f"{what}{_among(num_boxes)}", partial(measurement, num_boxes)
        disturbed = partial(measurement, 0, env_steps.DISTURBANCES)
        yield "environments", f"{what} with {len(env_steps.DISTURBANCES)} disturbances", disturbed
        yield "environments", f"{what} of rectangles", partial(measurement, footprint=env_steps.RECTANGLE)
        for num_boxes in (0, env_steps.RAY_BOXES):
            sensing = partial(measurement, num_boxes, num_rays=env_steps.RAYS)
            yield "environments", f"{what} with {env_steps.RAYS} rays{_among(num_boxes)}", sensing
    yield "environments", "rooms, along paths", partial(env_steps.measure_rooms, settings)
    yield "environments", f"{settings.num_worlds} worlds in JAX", partial(env_steps.measure_functional, settings)
    for model in env_steps.RIGID if find_spec("mujoco") else ():
        yield "environments", f"one environment of {model} in MuJoCo", partial(env_steps.measure_rigid, settings, model)


def _among(num_boxes: int) -> str:
    return f" among {num_boxes} boxes" if num_boxes else ""


def run_parts(todo: Sequence[Part], progress: Callable[[str, int, int], object]) -> dict[str, list[Measurement]]:
    """Measurements by section; ``progress(what, number done, number in all)`` is called before each."""
    results: dict[str, list[Measurement]] = {section: [] for section, _, _ in todo}
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
) -> Measurement:
    problem = circle(num_robots, model, settings.horizon)
    run = _plain_run(problem, settings) if engine == "plain" else _engine_run(problem, settings, engine, preset)
    noise_scale = _d4orm(num_steps=settings.num_steps).noise_scale()
    timed = partial(measure, settings)
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
    engine, rules = get_sampling_engine(name, num_threads), planner.rules()
    base = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)

    def run(noise_scale: FloatArray, collisions: bool) -> None:
        # Groups are those of the last plan's conflicts; before there is one, robots have the credit by themselves.
        credit = "team" if planner.config.credit == "team" else "robot"
        task = SamplingTask(problem, base, collisions=collisions, credit=credit, penalty=planner.config.penalty)
        engine.denoise(task, rules, base, noise_scale, settings.num_samples, 0)

    return run


def _plain_run(problem: Problem, settings: BenchmarkSettings) -> Run:
    planner = _d4orm(preset="paper")
    temperature = float(planner.config.temperature)
    return lambda noise_scale, collisions: plain.denoise_around_rest(
        problem, noise_scale, settings.num_samples, temperature, 0, collisions
    )


def _measure_threads(settings: BenchmarkSettings, num_robots: int, threads: int) -> Measurement:
    """An iteration by the rules of D4orm's defaults on several threads, beside one on a single thread."""
    problem = circle(num_robots, "holonomic2d", settings.horizon)
    noise_scale = _d4orm(num_steps=settings.num_steps).noise_scale()
    several, single = (_engine_run(problem, settings, "cpu", None, count) for count in (threads, 1))
    works = [partial(run, noise_scale, True) for run in (several, single)]
    with_several, with_one = in_turn(settings, *works)
    return {
        "num_robots": num_robots,
        "threads": threads,
        "iteration": Spread.of(with_several),
        "one_thread": Spread.of(with_one),
        "speedup": Spread.of(np.divide(with_one, with_several).tolist()),
    }


def _measure_obstacles(settings: BenchmarkSettings, num_boxes: int, where: probes.Where) -> Measurement:
    """An iteration of the paper's planner among boxes, beside one in the open, and verify()."""
    problem = probes.boxed_problem(num_boxes, where)
    noise_scale = _d4orm(preset="paper", num_steps=settings.num_steps).noise_scale()
    controls = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    controls[:40] = 0.5 * (problem.goal - problem.start[:, :2]) / np.linalg.norm(problem.goal, axis=1)[:, None]

    def iterate(chosen: Problem) -> None:
        _engine_run(chosen, settings, "cpu", "paper")(noise_scale, True)

    among, alone = in_turn(settings, *(partial(iterate, one) for one in (problem, problem.replace(world=World()))))
    return {
        "obstacles": num_boxes,
        "where": where,
        "num_robots": problem.num_robots,
        "iteration": Spread.of(among),
        "ratio": Spread.of(np.divide(among, alone).tolist()),
        "verify": measure(settings, lambda: verify(problem, controls)),
    }


def _measure_plans(settings: BenchmarkSettings, engine: str, preset: str | None, num_robots: int) -> Measurement:
    """Planning time to the first feasible plan; a seed without one counts with the time it took to give up."""
    planner = make_planner("d4orm", preset=preset, engine=engine)
    problem = make_problem("circle", num_robots=num_robots, goal_speed=np.inf)  # as in the paper
    planner.solve(problem, seed=settings.seeds, time_limit=settings.plan_time_limit)  # compiles
    plans = [
        planner.solve(problem, seed=seed, time_limit=settings.plan_time_limit) for seed in range(settings.seeds)
    ]  # fmt: skip
    return {
        "planner": "d4orm",
        "engine": engine,
        "rules": preset or "default",
        "num_robots": num_robots,
        "iterations": Spread.of([plan.iterations for plan in plans]),
        **probes.figures_of(plans),
    }
