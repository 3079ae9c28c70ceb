"""D4orm by the paper's preset beside MMD: processor seconds to a solution, and how smooth it is.

    python -m examples.studies against_mmd --seeds 10

The paper says (section IV-B) that D4orm takes far less time than MMD and is smoother; its scene is not in the text.
Here both meet on the paper's circle and on the maps that MMD was published with. MMD is this project's, with what it
takes from its authors' code (``mmd``) and by its defaults (``mmd, ours``). Seconds are the processor's, of the whole
solve, what is compiled or loaded first left out. Jerk and acceleration are mean squared norms over the solutions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import process_time
from typing import Any

import numpy as np
from examples.common import grouped, mean_text, save_table, study_parser, study_rows
from examples.denoising import denoising_columns, denoising_of

from d4orm_env import Problem, make_problem
from d4orm_env.core.trajectory import accelerations
from d4orm_planners import make_planner

Row = dict[str, Any]

PLANNERS: Mapping[str, dict[str, Any]] = {
    "d4orm": {"name": "d4orm", "preset": "paper", "max_iterations": 20},
    "mmd": {"name": "mmd", "preset": "paper", "max_iterations": 60},
    "mmd, ours": {"name": "mmd", "max_iterations": 60},
}
"""Settings by label."""
TEAMS: Sequence[tuple[str, int]] = (
    *(("paper_circle", size) for size in (4, 8, 12, 16)),
    *((f"mmd_{name}", 6) for name in ("conveyor", "highways", "drop_region")),
)
FEW = 2
"""Most seeds on maps, where D4orm uses up its iterations."""


def row_of(label: str, problem: Problem, seed: int, planner: Any) -> Row:
    began = process_time()
    plan = planner.solve(problem, seed=seed)
    spent = process_time() - began
    moving = accelerations(problem, plan.trajectory)[~plan.trajectory.arrived[:-1]].astype(float)
    return {
        "scenario": problem.name, "robots": problem.num_robots, "planner": label, "seed": seed, "solved": plan.solved,
        "iterations": plan.iterations, "processor_seconds": spent, "travel_time": plan.metrics["travel_time"],
        "jerk": plan.metrics["mean_squared_jerk"], "acceleration": float((moving**2).sum(axis=1).mean()),
        **denoising_of(plan.history),
    }  # fmt: skip


def measure(teams: Sequence[tuple[str, int]], seeds: int) -> list[Row]:
    """A row of every team, seed and planner; planners take turns."""
    planners = {label: make_planner(**own, engine="cpu") for label, own in PLANNERS.items()}
    rows = []
    for scenario, size in teams:
        for planner in planners.values():
            planner.solve(make_problem(scenario, num_robots=size, seed=0), seed=0, max_iterations=1)  # compiles, loads
        for seed in range(seeds if scenario == "paper_circle" else min(seeds, FEW)):
            problem = make_problem(scenario, num_robots=size, seed=seed)
            for label, planner in planners.items():
                rows.append(row_of(label, problem, seed, planner))
                print(rows[-1], flush=True)
    return rows


def summary(rows: Sequence[Row]) -> list[Row]:
    """A row per team and planner; all but the seconds are of solutions."""
    table = []
    for (scenario, robots, planner), own in grouped(rows, "scenario", "robots", "planner").items():
        solved = [row for row in own if row["solved"]]
        travel, jerk, moving = (
            mean_text([row[name] for row in solved], ".3g") for name in ("travel_time", "jerk", "acceleration")
        )
        seconds = [row["processor_seconds"] if row["solved"] else np.inf for row in own]
        table.append(
            {"team": f"{scenario}, {robots}", "planner": planner, "solved": f"{len(solved)} of {len(own)}",
             **denoising_columns(own),
             "processor [s], median": f"{np.median(seconds):.2f}".replace("inf", "never"),
             "travel time [s]": travel, "jerk [m²/s⁶]": jerk, "acceleration [m²/s⁴]": moving}
        )  # fmt: skip
    return table


def main() -> None:
    arguments = study_parser(__doc__, seeds=10).parse_args()
    teams, seeds = (TEAMS, arguments.seeds) if not arguments.quick else ((("paper_circle", 2),), 1)
    rows = study_rows(arguments, "against_mmd", lambda: measure(teams, seeds))
    save_table(summary(rows), arguments.out / "against_mmd.csv")
