"""Make the tables and figures of the docs from the trials in ``examples/studies/data``: what ``make results`` runs.

    python -m examples.studies --out docs/tables

All in one process: to import what a study needs takes longer than most of the tables.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from unittest.mock import patch

import matplotlib.pyplot as plt
from examples.outputs import argument_parser

from d4orm_planners.cli.app import main as d4orm

DATA = Path(__file__).parent / "data"
STUDIES = (
    "ablation", "amswarm_gaps", "contact_penalty", "credit_by_update", "disturbance_study", "fewer_samples",
    "gradient_dilution", "head_to_head", "imitate_expert", "lifelong", "multimodality", "multimodality_team",
    "paper_differences", "policy_rates", "scaling", "solve_rates", "tune_learners", "tuned_rivals", "warm_start",
    "zero_shot",
)  # fmt: skip
"""Studies whose trials are in a file of their name."""
TIMED = ("big-teams", "coarseness", "ipopt")
"""Figures of the paper that were measured on a machine that did nothing else."""
FIGURES = ("amswarm", "nodes", "noise-schedule", "robustness", "selections", "team-size", *TIMED)


def run(module: str, *arguments: object) -> None:
    """Run a script of this folder, as from the command line."""
    with patch.object(sys, "argv", [module, *map(str, arguments)]):
        status = import_module(f"examples.studies.{module}").main()
    plt.close("all")
    if status:
        raise SystemExit(f"{module} ended with exit status {status}")


def main() -> int:
    """Make them all."""
    out = argument_parser(__doc__).parse_args().out
    run("one_dimension", "--out", out)
    run("tune_rivals", "--trials", DATA / "tuning.parquet", "--out", out)
    for study in STUDIES:
        run(study, "--trials", DATA / f"{study}.parquet", "--out", out)
    run("training_seeds", "--curves", DATA / "training_curves.csv", "--out", out)
    for figure in FIGURES:
        times = () if figure in TIMED else ("--no-times",)
        run("paper.__main__", figure, "--trials", DATA / f"{figure}.parquet", *times, "--out", out)
    for figure in ("big-teams", "coarseness"):
        run(
            "paper.__main__",
            figure,
            "--trials",
            DATA / "algorithm_4.parquet",
            "--no-times",
            "--out",
            out / "algorithm_4",
        )
    d4orm(["leaderboard", str(DATA / "leaderboard.parquet"), "--out", str(out / "leaderboard.md")])
    return 0


if __name__ == "__main__":
    sys.exit(main())
