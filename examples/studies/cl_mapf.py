"""Cars of CL-CBS's and CSDO's benchmarks, as they are, planned by what `make_planner()` gives.

    git clone https://github.com/APRIL-ZJU/CL-CBS
    git clone https://github.com/YangSVM/CSDOTrajectoryPlanning
    python -m examples.studies cl_mapf --checkouts CL-CBS CSDOTrajectoryPlanning

A row for each map's size and number of cars, of the first files of each folder; else as in the study `dynobench`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from examples.common import grouped, save_table, study_parser, study_rows
from examples.studies.dynobench import described, row_of


def kind_of(row: dict[str, Any]) -> str:
    """The map of a file, without its number of obstacles and its own number."""
    return str(row["instance"]).removeprefix("map_").split("_")[0]


def main() -> None:
    """Plan the first instances of all folders and write the table."""
    parser = study_parser(__doc__)
    parser.add_argument("--checkouts", type=Path, nargs="+", default=(), help="checkouts with instances in benchmark/")
    parser.add_argument("--files", type=int, default=2, help="instances of each folder")
    arguments = parser.parse_args()
    names = [f"*_ex{number}.yaml" for number in range(arguments.files)]
    paths = [(one, path) for one in arguments.checkouts for name in names for path in (one / "benchmark").rglob(name)]
    if not paths and arguments.trials is None:
        parser.error("give --checkouts with instances in benchmark/, or --trials")
    rows = study_rows(arguments, "cl_mapf", lambda: [row_of(*found, seed=0) for found in sorted(paths)])
    accepted = [row | {"kind": f"{kind_of(row)}, {row['robots']:3} cars"} for row in rows if not row["refused"]]
    kinds = grouped(accepted, "benchmark", "kind")
    table = [described(*kind, own) for kind, own in sorted(kinds.items())]
    save_table([{k: v for k, v in row.items() if k != "models"} for row in table], arguments.out / "cl_mapf.csv")
