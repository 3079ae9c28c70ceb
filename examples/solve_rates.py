"""How often, how soon and how well the planners solve their problems: the tables in the README and the results page.

    python examples/solve_rates.py --seeds 20
    python examples/solve_rates.py --seeds 20 --cases big --planner d4orm-d
    python examples/solve_rates.py --seeds 20 --cases big --planner d4orm-d --improve 3
    python examples/solve_rates.py --seeds 20 --cases walls --planner d4orm-d
    python examples/solve_rates.py --seeds 20 --cases canonical --planner d4orm-d
    python examples/solve_rates.py --seeds 5 --cases few --planner mmd

Random instances differ by seed; those of the AMSwarm comparison have their starts jittered by 5 mm. Every plan that
counts as solved has passed ``verify()``. Iterations and seconds are those to the first solution, compilation not
counted; with ``--improve`` the search goes on from there until so many seconds have passed in all. No plan takes
less time to travel than "least": that of robots which drive straight home with nobody and nothing in the way.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from d4orm_env import Problem, make_problem, verify
from d4orm_env.core.robot_model import ACCELERATION, SPEED
from d4orm_planners import make_planner

CASES: list[tuple[str, str, dict[str, Any], int]] = [
    ("circle, 4 holonomic", "circle", {"num_robots": 4}, 10),
    ("circle, 8 holonomic", "circle", {"num_robots": 8}, 10),
    ("circle, 12 holonomic", "circle", {"num_robots": 12}, 10),
    ("circle, 16 holonomic", "circle", {"num_robots": 16}, 30),
    ("circle, 8 differential drives", "circle", {"num_robots": 8, "model": "differential_drive"}, 10),
    ("8 heterogeneous", "heterogeneous", {"num_robots": 8}, 10),
    ("circle in space, 8", "circle", {"num_robots": 8, "model": "holonomic3d"}, 10),
    ("circle in space, 12", "circle", {"num_robots": 12, "model": "holonomic3d"}, 10),
]
"""Label, scenario, its arguments, and the iterations allowed."""

BIG: list[tuple[str, str, dict[str, Any], int]] = [
    ("circle, 16", "circle", {"num_robots": 16}, 200),
    ("four obstacles, 16", "four_obstacles", {"num_robots": 16}, 200),
    ("random, 64 on 8 x 8 m", "random", {"num_robots": 64, "size": 8.0}, 200),
    ("random, 64 on 10 x 10 m", "random", {"num_robots": 64, "size": 10.0}, 200),
    *((f"random, {robots}", "random", {"num_robots": robots}, 200) for robots in (100, 200, 500, 1000)),
    ("circle of 18 m, 100", "circle", {"num_robots": 100, "diameter": 18.0}, 200),
    ("sphere, 64", "sphere", {"num_robots": 64}, 200),
    *((f"AMSwarm {i}, 10", f"amswarm_{i}", {"num_robots": 10}, 200) for i in range(1, 6)),
]
WALLS: list[tuple[str, str, dict[str, Any], int]] = [
    *((f"map of 32 x 32 cells, {num}", "map", {"num_robots": num, "cell": 0.6}, 200) for num in (10, 40, 80)),
    *((f"rooms, {num}", "rooms", {"num_robots": num}, 200) for num in (10, 20, 40)),
    *((f"maze, {num}", "maze", {"num_robots": num}, 200) for num in (10, 20)),
    *((f"warehouse, {num}", "warehouse", {"num_robots": num}, 200) for num in (40, 100)),
    ("corridor, 4 + 4", "corridor", {"num_robots": 8}, 200),
    ("doorway, 8", "doorway", {"num_robots": 8}, 200),
    ("forest in space, 16", "forest", {"num_robots": 16, "model": "holonomic3d"}, 200),
    ("forest, 16 differential drives", "forest", {"num_robots": 16, "model": "differential_drive"}, 200),
]
FEW: list[tuple[str, str, dict[str, Any], int]] = [
    ("circle, 8", "circle", {"num_robots": 8}, 60),
    ("random with 4 obstacles, 8", "random", {"num_robots": 8, "num_obstacles": 4}, 60),
    ("random with 4 obstacles, 16", "random", {"num_robots": 16, "num_obstacles": 4}, 60),
    ("forest, 8", "forest", {"num_robots": 8}, 60),
    ("warehouse, 8", "warehouse", {"num_robots": 8}, 60),
    ("warehouse, 16", "warehouse", {"num_robots": 16}, 60),
    ("rooms, 4", "rooms", {"num_robots": 4}, 60),
    ("rooms, 8", "rooms", {"num_robots": 8}, 60),
]
CANONICAL: list[tuple[str, str, dict[str, Any], int]] = [
    ("circle, 16", "paper_circle", {"num_robots": 16}, 60),
    ("sphere, 16", "paper_sphere", {"num_robots": 16}, 60),
    ("heterogeneous, 16", "paper_heterogeneous", {"num_robots": 16}, 60),
    ("4 obstacles, 16", "paper_obstacles", {"num_robots": 16, "num_obstacles": 4}, 60),
    ("random, 16", "paper_random", {"num_robots": 16}, 60),
    ("random, 64", "paper_random", {"num_robots": 64}, 60),
]
SETS = {"paper": CASES, "big": BIG, "walls": WALLS, "few": FEW, "canonical": CANONICAL}
JITTER = 0.005


def instance(scenario: str, settings: dict[str, Any], seed: int) -> Problem:
    """The problem of that seed; of a map, one of 32 x 32 cells of which a fifth is blocked."""
    if scenario == "map":
        blocked = np.random.default_rng(seed).random((32, 32)) < 0.2
        rows = ["".join("@" if cell else "." for cell in row) for row in blocked]
        with TemporaryDirectory() as folder:
            path = Path(folder) / "cells.map"
            path.write_text("\n".join(["type octile", "height 32", "width 32", "map", *rows, ""]))
            return make_problem(scenario, **settings, map=path, seed=seed)
    problem = make_problem(scenario, **settings, seed=seed)
    if not scenario.startswith("amswarm"):
        return problem
    start = problem.start.copy()
    start[:, : problem.dimension] += np.random.default_rng(seed).uniform(-JITTER, JITTER, problem.goal.shape)
    return problem.replace(start=start)


def least_travel_time(problem: Problem) -> float:
    """A bound on the mean travel time of any plan [s]: straight to the edge of the goal, as fast as limits allow."""
    limits, dt = problem.team.limits.astype(float), problem.dt
    left = np.linalg.norm(problem.goal - problem.start[:, : problem.dimension], axis=1) - problem.goal_radius
    speed, times = np.zeros(problem.num_robots), np.zeros(problem.num_robots)
    while (going := left > 1e-4).any():
        after = np.minimum(speed + limits[:, ACCELERATION] * dt, limits[:, SPEED])
        left[going] -= (speed + after)[going] * dt / 2
        times[going] += dt
        speed = after
    return float(times.mean())


def main() -> None:
    """Print one row per case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="seeds per case")
    parser.add_argument("--cases", choices=SETS, default="paper")
    parser.add_argument("--only", default="", help="cases whose label contains this")
    parser.add_argument("--planner", default="d4orm")
    parser.add_argument("--preset", default=None)
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--improve", type=float, default=None, help="seconds in all, solved or not")
    arguments = parser.parse_args()
    cases = [case for case in SETS[arguments.cases] if arguments.only in case[0]]
    improve = arguments.improve is not None
    planner = make_planner(arguments.planner, preset=arguments.preset, engine=arguments.engine, improve=improve)
    print(
        "| team | solved | iterations (median, most) | seconds (median, most) | travel [s] | least [s] "
        "| makespan (median, most) |"
    )
    print("|---|---|---|---|---|---|---|")
    for label, scenario, settings, limit in cases:
        problems = [instance(scenario, settings, seed) for seed in range(arguments.seeds)]
        budget = {"time_limit": arguments.improve} if improve else {"max_iterations": limit}
        plans = [planner.solve(problem, seed=seed, **budget) for seed, problem in enumerate(problems)]
        solved = sum(plan.solved and verify(plan.problem, plan.controls).ok for plan in plans)
        first = [next((record for record in plan.history if record.solved), plan.history[-1]) for plan in plans]
        iterations = [record.iteration for record in first]
        seconds = [record.wall_time for record in first]
        travel = np.mean([plan.metrics["travel_time"] for plan in plans])
        least = np.mean([least_travel_time(problem) for problem in problems])
        makespan = [plan.metrics["makespan"] for plan in plans]
        print(
            f"| {label} | {solved} of {len(plans)} | {np.median(iterations):g}, {max(iterations)} "
            f"| {np.median(seconds):.2f}, {max(seconds):.2f} "
            f"| {travel:.2f} | {least:.2f} | {np.median(makespan):.2f}, {max(makespan):.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
