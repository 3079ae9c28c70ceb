"""Measure a figure or table of the paper, and set it beside the paper's numbers.

    python -m examples.studies paper                     # what there is
    python -m examples.studies paper amswarm --quick     # a few seconds: does it work?
    python -m examples.studies paper amswarm --seeds 5

Figure, tables and trials are written to a folder of the figure's name in `--out`, and a call that was broken off goes
on from there. `--trials FILE` makes the figure of a Parquet file of its trials, such as those in
`examples/studies/data`.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence

from examples.common import count, study_trials, trials_parser
from examples.studies.paper.figure import Figure, grouped
from examples.studies.paper.figure_report import write_figure
from examples.studies.paper.paper_figures import FIGURES

from d4orm_planners.cli.warmup import warm_up


def measure(figure: Figure, arguments: Namespace) -> None:
    """Run what a figure compares, or read it, and write the figure."""
    if arguments.quick:
        figure = figure.quick()
    elif arguments.trials is None:
        warm_up()  # the time of a controller would include its compilation
    arguments.out /= f"{figure.name}-quick" if arguments.quick else figure.name
    studies = [study for _, study in figure.studies(arguments.seeds or figure.seeds)]
    groups = grouped(figure, study_trials(arguments, figure.name, studies))
    arguments.out.mkdir(parents=True, exist_ok=True)
    written = write_figure(arguments.out, figure, groups)
    page = next(path for path in written if path.suffix == ".md")
    print(page.read_text(encoding="utf-8"), *(f"wrote {path}" for path in written), sep="\n")


def main(given: Sequence[str] | None = None) -> int:
    parser = trials_parser(__doc__)
    parser.add_argument("figure", nargs="?", choices=FIGURES, metavar="FIGURE", help="without it, what there is")
    parser.add_argument("--seeds", "-n", type=count, help="trials per row, by default 50, and 1 with --quick")
    parser.add_argument("--section", "-s", action="append", default=[], help="only this panel; repeatable")
    parser.add_argument("--policy", "-p", action="append", default=[], help="only the policy of this label; repeatable")
    parser.add_argument("--no-times", action="store_true", help="leave seconds out, of a machine that did other work")
    parser.add_argument("--time-limit", type=float, help="seconds of a planner, in place of a panel's own limit")
    arguments = parser.parse_args(given)
    if arguments.figure is None:
        for figure in FIGURES.values():
            print(f"{figure.name:<15} {figure.title} ({figure.source})")
        return 0
    try:
        chosen = FIGURES[arguments.figure].only(arguments.section, arguments.policy)
        if arguments.time_limit is not None:
            chosen = chosen.limited(arguments.time_limit)
        measure(chosen.without_times() if arguments.no_times else chosen, arguments)
    except (ValueError, OSError, ImportError) as error:
        parser.exit(2, f"{error}\n")
    return 0
