"""Instances that others wrote: db-CBS's examples, as they are, planned by what `make_planner()` gives.

    git clone https://github.com/IMRCLab/db-CBS
    python -m examples.studies dynobench --folder db-CBS/example

A row for each file: who solved it within a minute of planning, compilation not counted, and how long robots are under
way; medians of the seeds that solved it.
Files that `load_dynobench` refuses have the reason in their row.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from examples.common import grouped, save_table, study_parser, study_rows

from d4orm_env import Problem, load_dynobench
from d4orm_planners import Plan, make_planner

LIMIT = 60.0
"""Time to plan [s]."""


def loaded(path: Path) -> Problem | str:
    """The problem of a file, or why there is none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # starts within the margin, which is zero there
            return load_dynobench(path)
    except ValueError as error:
        return str(error).removeprefix(f"{path}: ")


def row_of(path: Path, seed: int) -> dict[str, Any]:
    """The row of a file and a seed."""
    problem = loaded(path)
    row: dict[str, Any] = {"instance": path.stem, "seed": seed, "robots": 0, "models": "", "refused": ""}
    row |= {"solved": False, "seconds": np.nan, "makespan": np.nan, "sum_of_costs": np.nan}
    if isinstance(problem, str):
        return row | {"refused": problem}
    row |= {"robots": problem.num_robots, "models": ", ".join(sorted(set(problem.team.models)))}
    plan: Plan = make_planner().solve(problem, seed=seed, time_limit=LIMIT)
    if plan.solved and plan.verified:
        arrivals = problem.dt * plan.trajectory.arrived.argmax(axis=0)
        row |= {"solved": True, "makespan": float(arrivals.max()), "sum_of_costs": float(arrivals.sum())}
    return row | {"seconds": plan.wall_time}


def main() -> None:
    """Plan all instances and write the tables."""
    parser = study_parser(__doc__, seeds=5)
    parser.add_argument("--folder", type=Path, help="folder with instances as YAML")
    arguments = parser.parse_args()
    paths = sorted(arguments.folder.glob("*.yaml")) if arguments.folder else []
    if not paths and arguments.trials is None:
        parser.error("give --folder with instances, or --trials")
    rows = study_rows(
        arguments, "dynobench", lambda: [row_of(path, seed) for path in paths for seed in range(arguments.seeds)]
    )
    instances = grouped((row for row in rows if not row["refused"]), "instance")
    save_table([described(own) for own in instances.values()], arguments.out / "dynobench.csv")


def described(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The table's row of an instance."""
    solved = [row for row in rows if row["solved"]]

    def median(column: str) -> str:
        return f"{np.median([row[column] for row in solved]):.1f}" if solved else "-"

    return {
        "instance": rows[0]["instance"], "robots": rows[0]["robots"], "models": rows[0]["models"],
        "solved": f"{len(solved)} of {len(rows)}", "planning [s]": median("seconds"),
        "makespan [s]": median("makespan"), "sum of costs [s]": median("sum_of_costs"),
    }  # fmt: skip
