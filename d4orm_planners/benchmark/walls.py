"""Cost of obstacles: iterations, environment steps, verify() and the index of obstacles, beside the open world."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

import numpy as np

from d4orm_env import verify
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.geometry.world_index import build_index
from d4orm_env.scenarios import make_problem
from d4orm_planners.benchmark.timing import Measurement, Spread, in_turn

Where = Literal["near", "far"]

NUM_ROBOTS = 8
SIZE = 0.04
"""Side of a box [m]."""

CELL, BLOCKED = 0.6, 0.2
"""Size of the cells of a map [m], and the share of them that is blocked."""


def boxed_problem(num_boxes: int, where: Where, horizon: int = 100) -> Problem:
    """The circle of 8 robots with small boxes in its middle, where all paths cross, or far away from everybody."""
    problem = make_problem("circle", num_robots=NUM_ROBOTS, horizon=horizon)
    random = np.random.default_rng(0)
    if where == "near":
        distance, angle = 2.0 * np.sqrt(random.uniform(0, 1, num_boxes)), random.uniform(0, 2 * np.pi, num_boxes)
        places = distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    else:
        places = random.uniform(8, 20, (num_boxes, 2)) * random.choice([-1, 1], (num_boxes, 2))
    return problem.replace(world=World(boxes=np.hstack([places - SIZE / 2, places + SIZE / 2])))


def measure_obstacles(
    iterate: Callable[[Problem], object], num_boxes: int, where: Where, repetitions: int, time_limit: float
) -> Measurement:
    """Seconds of an iteration among boxes and in the open, in turn, and of verify().

    Args:
        iterate: Function to time.
        num_boxes: Number of boxes.
        where: Near the robots' paths, or far from them.
        repetitions: Pairs at most.
        time_limit: Seconds after which no further pair begins.
    """
    problem = boxed_problem(num_boxes, where)
    open_world = problem.replace(world=World())
    controls = np.zeros((problem.horizon, NUM_ROBOTS, problem.control_size), np.float32)
    controls[:40] = 0.5 * (problem.goal - problem.start[:, :2]) / np.linalg.norm(problem.goal, axis=1)[:, None]
    among, alone = in_turn(lambda: iterate(problem), lambda: iterate(open_world), repetitions, time_limit)
    judging, _ = in_turn(lambda: verify(problem, controls), lambda: None, repetitions, time_limit)
    return {
        "obstacles": num_boxes,
        "where": where,
        "num_robots": NUM_ROBOTS,
        "iteration": Spread.of(among),
        "ratio": Spread.of(np.divide(among, alone).tolist()),
        "verify": Spread.of(judging),
    }


def measure_index(cells: int) -> Measurement:
    """Seconds and bytes of the index of a square map of so many cells along a side."""
    blocked = np.argwhere(np.random.default_rng(0).random((cells, cells)) < BLOCKED) * CELL
    shapes = World(boxes=np.hstack([blocked, blocked + CELL])).shapes
    begin = time.perf_counter()
    index = build_index(shapes, 0.0625, 0.25)
    return {"cells": cells, "obstacles": shapes.count, "seconds": time.perf_counter() - begin, "bytes": index.num_bytes}
