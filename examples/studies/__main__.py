"""Run a study; or make the tables and figures of the docs from the trials in ``examples/studies/data``.

    python -m examples.studies                        # what there is
    python -m examples.studies lifelong --minutes 1   # a study; --help tells its options
    python -m examples.studies all --out docs/tables  # what `make reproduce` runs

All tables are made in one process: to import what a study needs takes longer than most of them.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from unittest.mock import patch

import matplotlib.pyplot as plt
from examples.common import argument_parser
from examples.studies.paper.paper_figures import FIGURES as PAPER_FIGURES
from examples.studies.settings_studies import COMPARISONS
from examples.studies.settings_studies import main as compare

from d4orm_env.core.errors import unknown
from d4orm_planners.cli.app import main as d4orm

FOLDER = Path(__file__).parent
DATA = FOLDER / "data"
BESIDE = {"ablation": "disturbance_study", "cl_mapf": "dynobench"}
"""Studies that are functions in the module of another."""
OWN = {path.stem for path in FOLDER.glob("[a-z]*.py")} - {"settings_studies"}
NAMES = tuple(sorted({*COMPARISONS, "paper", *OWN, *BESIDE}))
FIGURES = (
    "amswarm", "big-teams", "coarseness", "ipopt", "nodes", "noise", "noise-schedule", "selections", "team-size",
)  # fmt: skip
FURTHER = {
    "algorithm_4": ("coarseness",), "ipopt_preset": ("ipopt",), "big-teams_seconds": ("big-teams",),
    "amswarm_seconds": ("amswarm",),
}  # fmt: skip
"""Further trials of these, few: of the paper's presets, and for seconds of one machine."""
TIMED = ("algorithm_4", "amswarm_seconds", "big-teams_seconds", "coarseness", "ipopt")
"""Trials of one machine in one go, whose seconds can be compared."""


def run(name: str, *arguments: object) -> None:
    """Run a study with arguments as those of the command line; exit if it fails."""
    with patch.object(sys, "argv", [f"python -m examples.studies {name}", *map(str, arguments)]):
        if name in COMPARISONS:
            status = compare(name)
        else:
            module = import_module(f"examples.studies.{BESIDE.get(name, name)}")
            status = getattr(module, name if name in BESIDE else "main")()
    plt.close("all")
    if status:
        raise SystemExit(status)


def make_all() -> None:
    """Make all tables and figures."""
    out = argument_parser(__doc__).parse_args().out
    run("one_dimension", "--out", out)
    run("multimodality", "--team", 8, "--trials", DATA / "multimodality_team.parquet", "--out", out)
    for study in NAMES:
        if (trials := DATA / f"{study}.parquet").is_file():
            run(study, "--trials", trials, "--out", out)
    for figure in FIGURES:
        times = () if figure in TIMED else ("--no-times",)
        run("paper", figure, "--trials", DATA / f"{figure}.parquet", *times, "--out", out)
    for name, figures in FURTHER.items():
        times = () if name in TIMED else ("--no-times",)
        for figure in figures:
            run("paper", figure, "--trials", DATA / f"{name}.parquet", *times, "--out", out / name)
    # Of Algorithm 4 trials of big teams are of one machine in one go, but for the one of a hundred robots.
    panels = [f"--section={section.title}" for section in PAPER_FIGURES["big-teams"].sections[:-1]]
    chosen = ("--trials", DATA / "big-teams.parquet", "--policy", "d4orm-c2f", *panels)
    run("paper", "big-teams", *chosen, "--out", out / "algorithm_4")
    d4orm(["leaderboard", str(DATA / "leaderboard.parquet"), "--out", str(out / "leaderboard.md")])


def main() -> None:
    name, *arguments = sys.argv[1:] or ["--help"]
    if name == "all":
        with patch.object(sys, "argv", ["python -m examples.studies all", *arguments]):
            make_all()
    elif name in NAMES:
        run(name, *arguments)
    elif name in ("-h", "--help"):
        print(f"{__doc__}\nStudies: {', '.join(NAMES)}")
    else:
        sys.exit(str(unknown("study", name, NAMES)))


if __name__ == "__main__":
    main()
