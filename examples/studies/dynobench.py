"""Instances that others wrote: those of db-CBS and db-LaCAM, as they are, planned by what `make_planner()` gives.

    git clone https://github.com/IMRCLab/db-CBS
    git clone https://github.com/IMRCLab/db-lacam
    python -m examples.studies dynobench --checkouts db-CBS db-lacam

A row for each file, or for all that one generator drew of one size: how many runs solved them within a minute of
planning, compilation not counted, how long that took, and how long robots are under way; medians of those that solved
it. Files that `load_dynobench` refuses have the reason in their row of the trials. Beside them is what db-CBS itself
did, measured apart (`data/db_cbs.csv`).
"""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from examples.common import grouped, save_table, study_parser, study_rows
from examples.denoising import denoising_columns, denoising_of

from d4orm_env import Problem, load_dynobench
from d4orm_env.scenarios import load_cl_mapf
from d4orm_planners import Plan, make_planner

CARS = """\
Cars of CL-CBS's and CSDO's benchmarks, planned by what `make_planner()` gives.

    git clone https://github.com/APRIL-ZJU/CL-CBS
    git clone https://github.com/YangSVM/CSDOTrajectoryPlanning
    python -m examples.studies cl_mapf --cl-cbs CL-CBS --csdo CSDOTrajectoryPlanning

A row for each map's kind and number of cars, of the first files of each folder; else as in the study `dynobench`."""
"""Description of the study of cars."""
LACAM = "db-lacam"
"""Folder of db-LaCAM's files."""
LIMIT = 60.0
"""Time to plan [s]."""
RIVAL = Path(__file__).parent / "data" / "db_cbs.csv"
"""Runs of db-CBS by its own code and settings, one of an instance; see the data's README."""
LARGEST_HITCH = np.pi / 4 + 0.01
"""Hitch angle [rad] up to which its costs are compared with ours: that of its models and ours, and a tolerance."""


def loaded(path: Path, load: Callable[[Path], Problem]) -> Problem | str:
    """The problem of a file, or why there is none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # starts within the margin, which is zero there
            return load(path)
    except ValueError as error:
        return str(error).removeprefix(f"{path}: ")


def row_of(benchmark: str, path: Path, seed: int, load: Callable[[Path], Problem] = load_dynobench) -> dict[str, Any]:
    """The row of a file and a seed."""
    problem = loaded(path, load)
    row: dict[str, Any] = {"benchmark": benchmark, "instance": path.stem, "seed": seed, "refused": ""}
    row |= {"robots": 0, "models": "", "solved": False}
    row |= {"seconds": np.nan, "makespan": np.nan, "sum_of_costs": np.nan, **dict.fromkeys(denoising_of([]))}
    if isinstance(problem, str):
        return row | {"refused": problem}
    row |= {"robots": problem.num_robots, "models": ", ".join(sorted(set(problem.team.models)))}
    plan: Plan = make_planner().solve(problem, seed=seed, time_limit=LIMIT)
    if plan.solved and plan.verified:
        arrivals = problem.dt * plan.trajectory.arrived.argmax(axis=0)
        row |= {"solved": True, "makespan": float(arrivals.max()), "sum_of_costs": float(arrivals.sum())}
    return row | {"seconds": plan.wall_time, **denoising_of(plan.history)}


def main() -> None:
    parser = study_parser(__doc__, seeds=5)
    parser.add_argument("--checkouts", type=Path, nargs="+", default=(), help="checkouts with instances in example/")
    arguments = parser.parse_args()
    paths = [
        (folder.name, path) for folder in arguments.checkouts for path in sorted((folder / "example").rglob("*.yaml"))
    ]
    if not paths and arguments.trials is None:
        parser.error("give --checkouts with instances in example/, or --trials")
    rows = study_rows(
        arguments, "dynobench", lambda: [row_of(*found, seed) for found in paths for seed in range(arguments.seeds)]
    )
    # Without the number of one that was drawn.
    accepted = [row | {"kind": re.sub(r"(_n\d+)_\d+", r"\1", row["instance"])} for row in rows if not row["refused"]]
    kinds = grouped(accepted, "benchmark", "kind")
    # A table each: their stored seconds are of different machines.
    for name, is_lacam in (("dynobench", False), ("dynobench_db_lacam", True)):
        own = {kind: rows for kind, rows in kinds.items() if (kind[0] == LACAM) == is_lacam}
        if own:
            table = [described(*kind, rows) | ({} if is_lacam else beside_rival(rows)) for kind, rows in own.items()]
            save_table(table, arguments.out / f"{name}.csv")


def beside_rival(rows: list[dict[str, Any]]) -> dict[str, str]:
    """Columns of what db-CBS did: how many it solved, seconds of the processor, and our costs by its.

    Costs are left out where one of its trailers bends further than its models let it.
    """
    instances = {(row["benchmark"], row["instance"]) for row in rows}
    with RIVAL.open(encoding="utf-8", newline="") as file:
        runs = [run for run in csv.DictReader(file) if (run["benchmark"], run["instance"]) in instances]
    solved = [run for run in runs if run["solved"] == "True"]
    seconds = [float(run["seconds"]) for run in solved]
    costs = {
        run["instance"]: float(run["sum_of_costs"]) for run in solved if float(run["hitch"] or 0.0) <= LARGEST_HITCH
    }
    ratios = [
        row["sum_of_costs"] / costs[row["instance"]] for row in rows if row["solved"] and row["instance"] in costs
    ]
    return {
        "db-CBS": f"{len(solved)} of {len(runs)}" if runs else "-",
        "its planning [s]": f"{np.median(seconds):.1f}" if seconds else "-",
        "costs by its": f"{np.median(ratios):.2f}" if ratios else "-",
    }


def described(benchmark: str, kind: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The table's row of an instance, or of all of one size."""
    solved = [row for row in rows if row["solved"]]

    def median(column: str) -> str:
        return f"{np.median([row[column] for row in solved]):.2f}" if solved else "-"

    robots = sorted({row["robots"] for row in rows})
    models = sorted({model for row in rows for model in row["models"].split(", ")})
    return {
        "benchmark": benchmark, "instances": kind, "files": len({row["instance"] for row in rows}),
        "robots": " to ".join(map(str, robots[:: max(len(robots) - 1, 1)])), "models": ", ".join(models),
        "solved": f"{len(solved)} of {len(rows)}", **denoising_columns(rows), "planning [s]": median("seconds"),
        "longest [s]": f"{max(row['seconds'] for row in rows):.1f}",
        "makespan [s]": median("makespan"), "sum of costs [s]": median("sum_of_costs"),
    }  # fmt: skip


def map_of(path: Path) -> str:
    """The map's size in metres, and whether it has rooms."""
    return path.stem.removeprefix("map_").split("_")[0] + " m" + (", rooms" if "room" in path.parts else "")


def cl_mapf() -> None:
    """Plan the first instances of all folders of cars and write the table."""
    parser = study_parser(CARS)
    parser.add_argument("--cl-cbs", type=Path, help="a checkout with instances in benchmark/")
    parser.add_argument("--csdo", type=Path, help="a checkout with instances in benchmark/")
    parser.add_argument("--files", type=int, default=2, help="instances of each folder")
    arguments = parser.parse_args()
    found = [
        (benchmark, path)
        for benchmark, checkout in (("CL-CBS", arguments.cl_cbs), ("CSDO", arguments.csdo))
        for number in range(arguments.files if checkout else 0)
        for path in sorted((checkout / "benchmark").rglob(f"*_ex{number}.yaml"))
    ]
    if not found and arguments.trials is None:
        parser.error("give --cl-cbs, --csdo or both with instances in benchmark/, or --trials")

    rows = study_rows(arguments, "cl_mapf", lambda: [_row(*one) for one in found])
    accepted = [row | {"kind": f"{row['map']}, {row['robots']:3} cars"} for row in rows if not row["refused"]]
    table = [described(*kind, own) for kind, own in sorted(grouped(accepted, "benchmark", "kind").items())]
    save_table([{k: v for k, v in row.items() if k != "models"} for row in table], arguments.out / "cl_mapf.csv")


def _row(benchmark: str, path: Path) -> dict[str, Any]:
    load = partial(load_cl_mapf, clockwise=benchmark == "CL-CBS")
    return row_of(benchmark, path, 0, load) | {"map": map_of(path)}
