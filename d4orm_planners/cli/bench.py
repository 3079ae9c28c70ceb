"""``d4orm bench``: how fast everything is on this machine."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from typer import Option

from d4orm_planners.cli.options import MOST_SEEDS, Quiet, names, numbers
from d4orm_planners.cli.outputs import output_folder, parts_progress, tell_written
from d4orm_planners.evaluation.bench_report import circumstances, write_report
from d4orm_planners.evaluation.benchmark import parts, run_parts
from d4orm_planners.evaluation.measuring import QUICK, SECTIONS, BenchmarkSettings


def bench(
    out: Annotated[Path, Option("--out", "-o", help="Folder to write bench.json and bench.md to.")] = Path("bench"),
    quick: Annotated[bool, Option("--quick", help="Small sizes, few repetitions on the CPU, about a minute.")] = False,
    num_robots: Annotated[str | None, Option("--num-robots", "--robots", "-k", help="Team sizes, as 4,8,16.")] = None,
    models: Annotated[str | None, Option(help="Robot models, separated by commas.")] = None,
    engines: Annotated[str | None, Option(help="Of cpu, jax and plain, with commas.")] = None,
    sections: Annotated[str | None, Option(help=f"Of {', '.join(SECTIONS)}, with commas; all by default.")] = None,
    seeds: Annotated[int | None, Option(max=MOST_SEEDS, help="Seeds for the first feasible plan.")] = None,
    quiet: Quiet = False,
) -> None:
    """Measure the engines, the environments and the planner on this machine."""
    given = {
        "num_robots": numbers("--num-robots", num_robots),
        "models": names(models),
        "engines": names(engines),
        "sections": names(sections),
        "seeds": seeds,
    }
    chosen = {name: value for name, value in given.items() if value is not None}
    settings = BenchmarkSettings.from_keywords({**(QUICK if quick else {}), **chosen}, "the benchmark")
    begun = circumstances(" ".join(["d4orm", *sys.argv[1:]]))
    with output_folder(out), parts_progress(enabled=not quiet) as progress:
        results = run_parts(list(parts(settings)), progress)
        written = write_report(out, settings, begun, results)
    tell_written(*written, quiet=quiet)
