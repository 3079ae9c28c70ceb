"""Cost of what robots are told: loops of the controller, and the smooth motion of a plan."""

from __future__ import annotations

import time

import numpy as np

from d4orm_env.scenarios import make_problem
from d4orm_planners.base.controller import Controller, Mode
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.benchmark.timing import Measurement, Spread, measure

NUM_ROBOTS = 10
WARMUP = 10
"""Loops at the beginning that do not count: they may compile."""


def measure_robots(mode: Mode, repetitions: int, time_limit: float) -> Measurement:
    """Seconds of a control loop of D4orm-C2F for ten robots, and of :meth:`Plan.sample` at 100 Hz for as many."""
    problem = make_problem("circle", num_robots=NUM_ROBOTS, goal_speed=0.1, horizon=150)
    plan = make_planner().solve(problem, seed=0)
    sampling = measure(plan.sample, repetitions, time_limit)
    seconds: list[float] = []
    states = problem.start
    with Controller("d4orm-c2f", mode=mode, reserve=0.0) as controller:
        controller.begin(problem, states)
        while not controller.over:
            begin = time.perf_counter()
            said = controller.step(states, len(seconds) * problem.dt)
            seconds.append(time.perf_counter() - begin)
            states = np.hstack([said.position, said.velocity]).astype(np.float32)
    return {
        "mode": mode,
        "num_robots": NUM_ROBOTS,
        "loop": Spread.of(seconds[WARMUP:]),
        "loop_95": float(np.percentile(seconds[WARMUP:], 95)),
        "sample": sampling,
    }
