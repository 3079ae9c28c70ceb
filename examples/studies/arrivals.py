"""Iterations of D4orm until all robots arrive and until none collides, against the number of robots.

    python -m examples.studies arrivals --seeds 10

The paper says (section IV-C) that more iterations are needed until all arrive as teams grow, and that some robots may
then collide for the sake of the team's reward. D4orm with the paper's preset on the paper's scenes, forty iterations at
most; it ends with the first solution.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from examples.common import each_row, grouped, mean_text, save_table, study_parser, study_rows
from examples.denoising import denoising_columns, denoising_of

from d4orm_env import make_problem
from d4orm_planners import make_planner

Rows = list[dict[str, Any]]

TEAMS = (
    *(("paper_circle", size) for size in (2, 4, 8, 12, 16)),
    *(("paper_random", size) for size in (16, 32, 64)),
)
MAX_ITERATIONS = 40


def solve(team: tuple[str, int], seed: int, **settings: Any) -> dict[str, Any]:
    """The row of a solve: iterations until all arrived and until it was solved, and the state in the end."""
    scenario, num_robots = team
    plan = make_planner("d4orm", preset="paper", **settings).solve(
        make_problem(scenario, num_robots=num_robots, seed=seed), seed=seed, max_iterations=settings["max_iterations"]
    )
    arrived = [record.iteration for record in plan.history if not record.num_not_arrived]
    last = plan.history[-1]
    return {
        "scenario": scenario, "robots": num_robots, "seed": seed, "solved": plan.solved,
        "iterations": plan.iterations, "arrived_after": arrived[0] if arrived else None,
        "not_arrived": last.num_not_arrived, "in_violation": last.num_margin_violated, **denoising_of(plan.history),
    }  # fmt: skip


def median(values: list[int], count: int) -> str:
    """Median of the values of ``count`` trials, those that are missing counted as never."""
    return f"{np.median([*values, *[np.inf] * (count - len(values))]):.3g}".replace("inf", "never")


def summary(rows: Rows) -> Rows:
    """A row per team."""
    table = []
    for (scenario, robots), of in grouped(rows, "scenario", "robots").items():
        left = [row for row in of if not row["solved"]]
        colliding = [row["in_violation"] for row in left if not row["not_arrived"]]
        arrived = [row["arrived_after"] for row in of if row["arrived_after"]]
        table.append(
            {
                "scenario": scenario,
                "robots": robots,
                "iterations until all arrive": median(arrived, len(of)),
                "until solved": median([row["iterations"] for row in of if row["solved"]], len(of)),
                **denoising_columns(of),
                "solved": f"{len(of) - len(left)} of {len(of)}",
                "all arrive and some collide": f"{len(colliding)} of {len(of)}",
                "robots in violation": mean_text(colliding, ".3g"),
            }
        )
    return table


def main() -> None:
    arguments = study_parser(__doc__, seeds=10).parse_args()
    teams, seeds, solved = TEAMS, arguments.seeds, partial(solve, max_iterations=MAX_ITERATIONS)
    if arguments.quick:
        teams, seeds, solved = TEAMS[:1], 1, partial(solve, max_iterations=2, num_samples=64, num_steps=10)
    rows = study_rows(arguments, "arrivals", lambda: each_row(solved, teams, range(seeds)))
    save_table(summary(rows), arguments.out / "arrivals.csv")
