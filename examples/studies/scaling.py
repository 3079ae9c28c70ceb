"""Planning time of `hybrid` by team size at constant density.

    python -m examples.studies scaling --seeds 3

Random starts and goals on a square with 1.5625 square metres per robot: 10 m x 10 m for 64 of them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from examples.common import COLOURS, count, each_row, grouped, plt, save_figure, save_table, study_parser, study_rows
from examples.denoising import denoising_columns, denoising_of

from d4orm_env import make_problem
from d4orm_planners import make_planner

ROBOTS = (8, 16, 32, 64, 100, 200, 500, 1000, 2000)
AREA = 10.0**2 / 64
"""Square metres per robot."""


def draw(rows: list[dict[str, Any]], out: Any) -> None:
    """Planning time against robots."""
    robots = [row["robots"] for row in rows]
    figure, ax = plt.subplots(figsize=(4.4, 3.2), layout="constrained")
    ax.plot(robots, [float(row["seconds, median"]) for row in rows], "o-", color=COLOURS["d4orm"])
    ax.set(xlabel="robots", ylabel="first solution [s], median", xscale="log", yscale="log")
    ax.set_xticks(robots, [f"{number}" for number in robots])
    ax.minorticks_off()
    save_figure(figure, out / "scaling.png")


def solve(time_limit: float, robots: int, seed: int) -> dict[str, Any]:
    """The row of a team size and problem."""
    problem = make_problem("random", num_robots=robots, seed=seed, size=(robots * AREA) ** 0.5)
    plan = make_planner("hybrid", max_iterations=1000).solve(problem, seed=seed, time_limit=time_limit)
    outcome = {"solved": plan.solved, "iterations": plan.iterations, "seconds": plan.wall_time}
    return {"robots": robots, "seed": seed, **outcome, **denoising_of(plan.history)}


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row per team size."""
    table = []
    for (robots,), team in grouped(rows, "robots").items():
        seconds = [row["seconds"] for row in team]
        table.append(
            {
                "robots": robots,
                "side [m]": f"{(robots * AREA) ** 0.5:.1f}",
                "solved": f"{sum(row['solved'] for row in team)} of {len(team)}",
                "iterations, median": f"{np.median([row['iterations'] for row in team]):g}",
                **denoising_columns(team),
                "seconds, median": f"{np.median(seconds):.2f}",
                "seconds, most": f"{max(seconds):.2f}",
                "ms per robot": f"{1000 * np.median(seconds) / robots:.1f}",
            }
        )
    return table


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--num-robots", "--robots", type=count, nargs="+", default=ROBOTS)
    parser.add_argument("--seeds", type=count, default=3, help="problems per team size")
    parser.add_argument("--time-limit", type=float, default=120.0, help="seconds per plan")
    arguments = parser.parse_args()
    sizes, seeds = ((4, 8), 1) if arguments.quick else (arguments.num_robots, arguments.seeds)
    plans = partial(each_row, partial(solve, arguments.time_limit), sizes, range(seeds))
    rows = summary(study_rows(arguments, "scaling", plans))
    save_table(rows, arguments.out / "scaling.csv")
    draw(rows, arguments.out)
