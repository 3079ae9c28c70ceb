"""How often, how soon and how well D4orm solves its problems: the table in the README.

    python examples/solve_rates.py --seeds 20

Every plan that counts as solved has passed ``verify()``. Times are wall times of the solve, compilation not counted.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from d4orm_env import make_problem, verify
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


def main() -> None:
    """Print one row per case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="seeds per case")
    parser.add_argument("--planner", default="d4orm")
    parser.add_argument("--preset", default=None)
    parser.add_argument("--engine", default="auto")
    arguments = parser.parse_args()
    planner = make_planner(arguments.planner, preset=arguments.preset, engine=arguments.engine)
    print("| team | solved | iterations (median, most) | seconds (median, most) | travel time [s] |")
    print("|---|---|---|---|---|")
    for label, scenario, settings, limit in CASES:
        problem = make_problem(scenario, **settings)
        plans = [planner.solve(problem, seed=seed, max_iterations=limit) for seed in range(arguments.seeds)]
        solved = sum(plan.solved and verify(problem, plan.controls).ok for plan in plans)
        iterations = [plan.iterations for plan in plans]
        seconds = [plan.wall_time for plan in plans]
        travel = np.mean([plan.metrics["travel_time"] for plan in plans])
        print(
            f"| {label} | {solved} of {len(plans)} | {np.median(iterations):g}, {max(iterations)} "
            f"| {np.median(seconds):.2f}, {max(seconds):.2f} | {travel:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
