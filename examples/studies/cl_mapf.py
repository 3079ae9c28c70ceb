"""Cars of CL-CBS's and CSDO's benchmarks, planned by what `make_planner()` gives.

    git clone https://github.com/APRIL-ZJU/CL-CBS
    git clone https://github.com/YangSVM/CSDOTrajectoryPlanning
    python -m examples.studies cl_mapf --cl-cbs CL-CBS --csdo CSDOTrajectoryPlanning

A row for each map's kind and number of cars, of the first files of each folder; else as in the study `dynobench`.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from examples.common import grouped, save_table, study_parser, study_rows
from examples.studies.dynobench import described, row_of

from d4orm_env.scenarios import load_cl_mapf


def map_of(path: Path) -> str:
    """The map's size in metres, and whether it has rooms."""
    return path.stem.removeprefix("map_").split("_")[0] + " m" + (", rooms" if "room" in path.parts else "")


def main() -> None:
    """Plan the first instances of all folders and write the table."""
    parser = study_parser(__doc__)
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
