"""Start-up and memory of fresh processes, control loops, the index of obstacles, and plans of big teams."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from d4orm_env import navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.footprints import Box, Footprint
from d4orm_env.geometry.world_index import build_index
from d4orm_env.scenarios import make_problem
from d4orm_planners.base.controller import Controller, Mode
from d4orm_planners.base.plan import Plan
from d4orm_planners.base.planner_registry import make_planner, make_policy
from d4orm_planners.d4orm_c2f.receding_horizon import D4ormC2F
from d4orm_planners.evaluation.measuring import BenchmarkSettings, Measurement, Spread, measure
from d4orm_planners.tracking.steering import advanced

_FIRST_PLAN = """
import json, sys, time
begin = time.perf_counter()
from d4orm_env import make_problem
from d4orm_planners import make_planner
from d4orm_planners.hybrid.compile_ahead import compile_for_planning
imported = time.perf_counter()
problem = make_problem(sys.argv[1], num_robots=int(sys.argv[2]))
planner = make_planner(engine="cpu")
compile_for_planning(planner, problem)  # as the command line does
plan = planner.solve(problem, seed=0)
done = time.perf_counter()
print(json.dumps({"import": imported - begin, "solve": done - imported, "planning": plan.wall_time,
                  "solved": plan.solved}))
"""

_MEMORY = """
import json, resource, sys
from pathlib import Path
from d4orm_env import make_problem
from d4orm_planners import make_planner
def peak():
    # Linux carries the peak of the parent over into ru_maxrss when a process is started; VmHWM begins anew.
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
num_robots, num_samples, horizon, diameter = int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
problem = make_problem("circle", num_robots=num_robots, diameter=diameter, horizon=horizon)
imported = peak()
planner = make_planner("d4orm", engine="cpu", num_samples=num_samples, num_steps=3, credit="robot")
planner.solve(problem, seed=0, max_iterations=2)
print(json.dumps({"imported": imported, "peak": peak()}))
"""

DEADLINE = 0.9  #: Share of a time step within which controllers answer
CONTROLLED = 10
WARMUP = 10  #: Loops at the beginning that do not count: they may compile
Where = Literal["near", "far"]
NUM_ROBOTS = 8
SIZE = 0.04  #: Side of a box [m]
CELL, BLOCKED = 0.6, 0.2  #: Size of the cells of a map [m], and the share of them that is blocked


def _run(code: str, *arguments: object, cache: str | None = None) -> tuple[float, Measurement]:
    """Seconds from start to exit of a fresh interpreter, and what it printed; RuntimeError if it fails."""
    environment = dict(os.environ) if cache is None else {**os.environ, "NUMBA_CACHE_DIR": cache}
    begin = time.perf_counter()
    process = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, env=environment
    )
    seconds = time.perf_counter() - begin
    if process.returncode != 0:
        raise RuntimeError(f"a measurement in a process of its own failed: {process.stderr.strip().splitlines()[-1:]}")
    result: Measurement = json.loads(process.stdout.splitlines()[-1])
    return seconds, result


def measure_startup(scenario: str, num_robots: int, repetitions: int) -> Measurement:
    """First plan of a process: once with an empty kernel cache, then with a full one.

    ``cold`` are seconds from start to exit of the first process and ``compiling`` the part that was neither importing
    nor planning; ``warm`` is the :class:`Spread` of the processes after it.
    """
    with tempfile.TemporaryDirectory() as cache:
        cold, first = _run(_FIRST_PLAN, scenario, num_robots, cache=cache)
        warm = [_run(_FIRST_PLAN, scenario, num_robots, cache=cache)[0] for _ in range(repetitions)]
    compiling = first["solve"] - first["planning"]
    seconds = {"cold": cold, "compiling": compiling, "warm": Spread.of(warm)}
    return {"scenario": scenario, "num_robots": num_robots, **seconds}


def measure_memory(num_robots: int, num_samples: int, horizon: int, diameter: float) -> Measurement:
    """Peak resident memory of a process that plans, in bytes: after importing, and in all."""
    _, result = _run(_MEMORY, num_robots, num_samples, horizon, diameter)
    return {"num_robots": num_robots, "num_samples": num_samples, "horizon": horizon, **result}


def measure_robots(settings: BenchmarkSettings, model: str, mode: Mode) -> Measurement:
    """Seconds of control loops of D4orm-C2F for ten robots of a model, and of :meth:`Plan.sample` at 100 Hz.

    The loops run at their own pace, because refining and planning anew go on beside them. Once a second all robots are
    moved by up to one and a half radii, and those that are far from the coarse plan then are planned for anew.
    """
    problem = make_problem("circle", num_robots=CONTROLLED, model=model, goal_speed=0.1, horizon=150)
    plan = make_planner().solve(problem, seed=0)
    sampling = measure(settings, plan.sample)
    seconds: list[float] = []
    replanned = held = 0
    for seed in range(min(settings.repetitions, 3)):
        timeout = DEADLINE * problem.dt
        with Controller("d4orm-c2f", mode=mode, reserve=0.0, timeout=timeout, replan_distance=2.0) as controller:
            steps = _driven(problem, controller, seed)
        seconds += [taken for taken, _ in steps[WARMUP:]]
        held += sum(was_held for _, was_held in steps)
        assert isinstance(controller.policy, D4ormC2F)
        replanned += sum(loop.replanned for loop in controller.policy.loops)
    return {
        "model": model,
        "mode": mode,
        "num_robots": CONTROLLED,
        "loop": Spread.of(seconds),
        "loop_95": float(np.percentile(seconds, 95)),
        "replanned": replanned,
        "held": held,
        "sample": sampling,
    }


def _driven(problem: Problem, controller: Controller, seed: int) -> list[tuple[float, bool]]:
    """The seconds of every control loop in real time, and whether the robots were held for want of an answer."""
    states, random, steps = problem.start, np.random.default_rng(seed), list[tuple[float, bool]]()
    controller.begin(problem, states, seed=seed)
    start = time.perf_counter()
    while not controller.over:
        begin, now = time.perf_counter(), len(steps) * problem.dt
        setpoint = controller.step(states, now)
        steps.append((time.perf_counter() - begin, setpoint.held))
        states = advanced(problem, states, setpoint.control)
        if len(steps) % round(1 / problem.dt) == 0:
            shift = 1.5 * problem.team.largest_radius
            states[:, : problem.dimension] += random.uniform(-shift, shift, problem.goal.shape)
        time.sleep(max(start + now + problem.dt - time.perf_counter(), 0.0))
    return steps


def boxed_problem(num_boxes: int, where: Where, footprint: Footprint | None = None) -> Problem:
    """The circle of 8 robots with small boxes in its middle, where all paths cross, or far away from all robots."""
    problem = make_problem("circle", num_robots=NUM_ROBOTS, horizon=100, footprint=footprint)
    random = np.random.default_rng(0)
    if where == "near":
        distance, angle = 2.0 * np.sqrt(random.uniform(0, 1, num_boxes)), random.uniform(0, 2 * np.pi, num_boxes)
        positions = distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    else:
        positions = random.uniform(8, 20, (num_boxes, 2)) * random.choice([-1, 1], (num_boxes, 2))
    return problem.replace(world=World(boxes=np.hstack([positions - SIZE / 2, positions + SIZE / 2])))


def measure_index(cells: int) -> Measurement:
    """Seconds and bytes of the index of a square map of so many cells along a side."""
    blocked = np.argwhere(np.random.default_rng(0).random((cells, cells)) < BLOCKED) * CELL
    shapes = World(boxes=np.hstack([blocked, blocked + CELL])).shapes
    begin = time.perf_counter()
    index = build_index(shapes, 0.0625, 0.25)
    return {"cells": cells, "obstacles": shapes.count, "seconds": time.perf_counter() - begin, "bytes": index.num_bytes}


COMPILING = 12  #: Robots of a problem that is solved first, so that compiling does not count
BOXES: dict[str, Any] = {"model": "differential_drive", "footprint": Box(0.36, 0.24), "goal_heading": 0.0}
"""Robots whose manoeuvres are planned: rectangles with goal headings."""


def measure_big_team(
    scenario: str, what: str, num_robots: int, seeds: int, time_limit: float, **robots: Any
) -> Measurement:
    """Seconds of the recommended planner to its first plan, over so many seeds, for such robots, called ``what``."""
    planner, make = make_planner(), partial(make_problem, scenario, **robots)
    planner.solve(make(num_robots=COMPILING, seed=seeds), seed=0, time_limit=time_limit)
    problems = [make(num_robots=num_robots, seed=seed) for seed in range(seeds)]
    plans = [planner.solve(problem, seed=seed, time_limit=time_limit) for seed, problem in enumerate(problems)]
    return {"scenario": f"{scenario}, {what}" if robots else scenario, "num_robots": num_robots, **figures_of(plans)}


def figures_of(plans: Sequence[Plan]) -> Measurement:
    """Plans of one problem's seeds in numbers; one that is no solution counts with the time that it took to give up."""
    return {
        "seeds": len(plans),
        "solved": sum(plan.solved for plan in plans),
        "seconds": Spread.of([plan.wall_time for plan in plans]),
        "travel_time": Spread.of([plan.metrics["travel_time"] for plan in plans]),
    }


def measure_improvement(scenario: str, num_robots: int, seeds: int, time_limit: float) -> Measurement:
    """Reward that improving the first plan gains within a time limit, and how long that takes in truth."""
    planner, improver, gains, seconds = make_planner(), make_planner(improve=True), [], []
    for seed in range(-1, seeds):  # the first one compiles
        problem = make_problem(scenario, num_robots=num_robots, seed=max(seed, 0))
        plan = planner.solve(problem, seed=max(seed, 0))
        limit = time_limit if seed >= 0 else None
        better = improver.solve(problem, initial_controls=plan.controls, time_limit=limit, max_iterations=1)
        if seed >= 0:
            gains.append(better.metrics["reward"] - plan.metrics["reward"])
            seconds.append(better.wall_time)
    gained = sum(gain > 0 for gain in gains)
    limits = {"scenario": scenario, "num_robots": num_robots, "seeds": seeds, "limit": time_limit}
    return {**limits, "gained": gained, "gain": Spread.of(gains), "seconds": Spread.of(seconds)}


def measure_big_loops(num_robots: int, loops: int, share: float | None) -> Measurement:
    """Seconds of control loops of D4orm-C2F for a big team on open ground, from where it starts, and contacts.

    With a deadline, which is a ``share`` of the time step, the loops run at their own pace.
    """
    env = navigation_v0.parallel_env("random", num_robots=num_robots)
    dt = env.problem.dt
    deadline = None if share is None else share * dt
    policy = make_policy("d4orm-c2f", deadline=deadline, refine="background")
    assert isinstance(policy, D4ormC2F)
    seconds, contacts = [], 0
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    for _ in range(loops + 1):
        begin = time.perf_counter()
        actions = policy.act(observations, env.state())
        seconds.append(time.perf_counter() - begin)
        observations, _, _, _, infos = env.step(actions)
        contacts += sum(info["collided"] for info in infos.values())
        if share is not None:
            time.sleep(max(begin + dt - time.perf_counter(), 0.0))
    # The first loop may compile.
    return {
        "num_robots": num_robots,
        "deadline": "none" if share is None else f"{share * dt * 1e3:.0f} ms",
        "start": policy.coarse_time,
        "loop": Spread.of(seconds[1:]),
        "loop_95": float(np.percentile(seconds[1:], 95)),
        "late": policy.missed,
        "contacts": contacts,
    }
