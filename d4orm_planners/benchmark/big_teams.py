"""Plans and control loops of big teams, and what improving a plan gains in little time."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np

from d4orm_env import navigation_v0
from d4orm_env.footprints import Box
from d4orm_env.scenarios import make_problem
from d4orm_planners.base.planner_registry import make_planner, make_policy
from d4orm_planners.benchmark.timing import Measurement, Spread

COMPILING = 12
"""Robots of a problem that is solved first, so that compiling does not count."""


BOXES: dict[str, Any] = {"model": "differential_drive", "footprint": Box(0.36, 0.24), "goal_heading": 0.0}
"""Robots whose manoeuvres are planned: rectangles with goal headings."""


def measure_big_team(scenario: str, num_robots: int, seeds: int, time_limit: float, **robots: Any) -> Measurement:
    """Seconds of the recommended planner to its first plan, over so many seeds, for such robots."""
    planner, make = make_planner(), partial(make_problem, scenario, **robots)
    planner.solve(make(num_robots=COMPILING, seed=seeds), seed=0, time_limit=time_limit)
    problems = [make(num_robots=num_robots, seed=seed) for seed in range(seeds)]
    plans = [planner.solve(problem, seed=seed, time_limit=time_limit) for seed, problem in enumerate(problems)]
    return {
        "scenario": f"{scenario}, boxes" if robots else scenario,
        "num_robots": num_robots,
        "seeds": seeds,
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


def measure_big_loops(num_robots: int, loops: int) -> Measurement:
    """Seconds of control loops of D4orm-C2F for a big team on open ground, from where it starts, and contacts."""
    env = navigation_v0.parallel_env("random", num_robots=num_robots)
    policy, seconds, contacts = make_policy("d4orm-c2f"), [], 0
    observations, _ = env.reset(seed=0)
    begin = time.perf_counter()
    policy.reset(env, seed=0)
    start = time.perf_counter() - begin
    for _ in range(loops + 1):
        begin = time.perf_counter()
        actions = policy.act(observations, env.state())
        seconds.append(time.perf_counter() - begin)
        observations, _, _, _, infos = env.step(actions)
        contacts += sum(info["collided"] for info in infos.values())
    # The first loop may compile.
    return {
        "num_robots": num_robots,
        "start": start,
        "loop": Spread.of(seconds[1:]),
        "loop_95": float(np.percentile(seconds[1:], 95)),
        "contacts": contacts,
    }
