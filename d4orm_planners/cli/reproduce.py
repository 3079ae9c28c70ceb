"""``d4orm reproduce``: the paper's figures and tables, measured again."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from d4orm_planners.cli.arguments import MOST_SEEDS, output_folder, refuse_options
from d4orm_planners.cli.common_options import Quiet
from d4orm_planners.cli.dataclass_options import takes

if TYPE_CHECKING:
    from d4orm_planners.reproduction.figure import Figure


@dataclass(frozen=True, kw_only=True)
class ReproduceOptions:
    """Options on the figure, and on the part of it."""

    context: typer.Context
    figure: Annotated[str | None, typer.Argument(help="Which; without it, what there is.")] = None
    list_: Annotated[bool, typer.Option("--list", help="List the figures.")] = False
    quick: Annotated[bool, typer.Option("--quick", help="Tiny sizes, to see that it works: under a minute.")] = False
    sections: Annotated[
        list[str] | None, typer.Option("--section", "-s", help="Only this panel; repeatable, all by default.")
    ] = None
    policies: Annotated[
        list[str] | None,
        typer.Option("--policy", "-p", help="Only the policy of this label; repeatable, all by default."),
    ] = None
    seeds: Annotated[
        int | None,
        typer.Option(
            "--seeds", "-n", min=1, max=MOST_SEEDS, help="Trials per row; the paper's 50 by default, 1 with --quick."
        ),
    ] = None
    workers: Annotated[
        int,
        typer.Option("--workers", "-j", min=1, help="Processes of one thread each; with 1, one trial on all cores."),
    ] = 1
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder to make the figure's folder in, and to go on from.")
    ] = Path("reproduction")
    trials: Annotated[
        Path | None, typer.Option("--trials", help="Run nothing; make the figure of a Parquet file of its trials.")
    ] = None
    go_on_from: Annotated[
        Path | None, typer.Option("--go-on-from", help="A Parquet file of trials that need not be run again.")
    ] = None
    times: Annotated[
        bool, typer.Option("--times/--no-times", help="Leave seconds out, of a machine that did other work too.")
    ] = True
    quiet: Quiet = False


@takes(ReproduceOptions)
def reproduce(options: ReproduceOptions) -> None:
    """Measure a figure or table of the paper, and set it beside the paper's numbers; goes on where it was stopped."""
    if options.figure is None or options.list_:
        _list_figures(options.context)
        return
    from d4orm_planners.cli.progress import resumable, tell_results
    from d4orm_planners.cli.warmup import warm_up
    from d4orm_planners.evaluation.store import STORE, TrialStore
    from d4orm_planners.evaluation.tables import read_parquet
    from d4orm_planners.reproduction.figure import reproduce as run
    from d4orm_planners.reproduction.figure_report import markdown, write_reproduction
    from d4orm_planners.reproduction.paper_figures import find_figure

    figure = find_figure(options.figure).only(options.sections or (), options.policies or ())
    if not options.times:
        figure = figure.without_times()
    if options.trials is not None:
        _make_of_trials(figure, options)
        return
    known = [] if options.go_on_from is None else read_parquet(options.go_on_from)
    folder = options.out / (f"{figure.name}-quick" if options.quick else figure.name)
    kept = f"the finished trials are kept in {folder}"
    with output_folder(folder), resumable(kept, enabled=not options.quiet) as progress:
        if known:
            TrialStore(folder / STORE).add(*known)
        if options.quick:
            figure = figure.quick()
        else:
            warm_up()  # the time of a controller would include its compilation
        groups = run(figure, folder, seeds=options.seeds, workers=options.workers, progress=progress)
    written = write_reproduction(folder, figure, groups)
    if not options.quiet:
        tell_results(markdown(figure, groups), written)


def _make_of_trials(figure: Figure, options: ReproduceOptions) -> None:
    """A figure of trials that were made before."""
    from d4orm_planners.cli.progress import tell_results
    from d4orm_planners.evaluation.tables import read_parquet
    from d4orm_planners.reproduction.figure import regrouped
    from d4orm_planners.reproduction.figure_report import markdown, write_reproduction

    running = ("quick", "seeds", "workers", "go_on_from")
    refuse_options(options.context, running, "is about running trials; leave it out beside --trials")
    assert options.trials is not None
    groups = regrouped(figure, read_parquet(options.trials))
    folder = options.out / figure.name
    with output_folder(folder):
        written = write_reproduction(folder, figure, groups, trials=False)
    if not options.quiet:
        tell_results(markdown(figure, groups), written)


def _list_figures(context: typer.Context) -> None:
    from d4orm_planners.reproduction.paper_figures import FIGURES

    others = [field.name for field in fields(ReproduceOptions) if field.name not in ("context", "list_")]
    refuse_options(context, others, "does not go with the list of figures; give a figure, and leave out --list")
    for figure in FIGURES.values():
        typer.echo(f"{figure.name:<15} {figure.title} ({figure.source})")
