"""Read what `d4orm evaluate` stored with pandas: a table by policy and scenario, and success by deadline for planning.

    d4orm evaluate --policy d4orm,orca --scenario circle,random --num-robots 8 --seeds 20 --out evaluation
    python -m examples.studies read_results --results evaluation

Without `--results` it makes a small evaluation of its own. `--format` chooses which of the files is read; all hold the
same rows, described in docs/tutorials/evaluation.md. Needs pandas, pyarrow for Parquet, and pyrvo for its own
evaluation.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
from examples.common import argument_parser, plt, require, save_figure, save_table

require("dev", "pandas")
import pandas as pd

from d4orm_planners import evaluate
from d4orm_planners.evaluation.store import TrialStore
from d4orm_planners.evaluation.summary import success_by

POLICIES = {"d4orm": {"improve": True}, "d4orm, few samples": {"policy": "d4orm", "num_samples": 128}, "orca": {}}


def read(folder: Path, kind: str) -> pd.DataFrame:
    """All trials of an evaluation, one per row."""
    if kind == "parquet":
        return pd.read_parquet(folder / "trials.parquet")
    if kind == "csv":
        return pd.read_csv(folder / "trials.csv")
    with closing(sqlite3.connect(folder / "trials.sqlite")) as connection:
        return pd.read_sql_query("SELECT * FROM trials", connection)


def summary(trials: pd.DataFrame) -> pd.DataFrame:
    """Success, travel time of the successes, and seconds of computing per second of motion."""
    trials = trials.assign(
        success=trials["success"].astype(float),
        travelled=trials["travel_time"].where(trials["success"].astype(bool)),
        compute=trials["wall_time"] / (trials["steps"] * trials["dt"]),
    )
    table = trials.groupby(["label", "scenario", "control_noise_std"]).agg(
        trials=("seed", "size"),
        success=("success", "mean"),
        travelled=("travelled", "mean"),
        compute=("compute", "mean"),
    )
    return table.reset_index()


def draw(folder: Path, out: Path) -> None:
    """Success against the time for planning, computed from the histories of the solves."""
    trials = [trial for trial in TrialStore.existing(folder).trials() if trial.control_noise_std == 0]
    deadlines = np.geomspace(0.01, 10, 60)
    figure, axes = plt.subplots(figsize=(5.2, 3.4), layout="constrained")
    for label in sorted({trial.label for trial in trials}):
        chosen = [trial for trial in trials if trial.label == label]
        within = [success_by(chosen, float(deadline)) for deadline in deadlines]
        (line,) = axes.plot(deadlines, [result.rate for result in within], label=label, drawstyle="steps-post")
        ends = [result.lower for result in within], [result.upper for result in within]
        axes.fill_between(deadlines, *ends, step="post", alpha=0.15, linewidth=0, color=line.get_color())
    axes.set(xscale="log", xlabel="deadline for planning [s]", ylabel="success rate", ylim=(0, 1))
    axes.legend(loc="best")
    save_figure(figure, out / "read_results.png")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--results", type=Path, help="folder that `d4orm evaluate` wrote to")
    parser.add_argument("--format", choices=("parquet", "csv", "sqlite"), default="parquet")
    arguments = parser.parse_args()
    if arguments.format == "parquet":
        require("evaluate", "pyarrow")
    folder = arguments.results
    if folder is None:
        require("orca", "pyrvo")
        folder = arguments.out / "evaluation"
        seeds = range(2 if arguments.quick else 10)
        evaluate(POLICIES, ["circle", "random"], num_robots=4, seeds=seeds, time_limit=1.0, out=folder, workers=1)
    rows = [
        {
            "policy": row.label,
            "scenario": row.scenario,
            "noise": f"{row.control_noise_std:g}",
            "trials": row.trials,
            "success": f"{row.success:.2f}",
            "travel time [s]": "" if np.isnan(row.travelled) else f"{row.travelled:.2f}",
            "computing per s of motion": f"{row.compute:.4f}",
        }
        for row in summary(read(folder, arguments.format)).itertuples()
    ]
    save_table(rows, arguments.out / "read_results.csv")
    draw(folder, arguments.out)
