"""``d4orm reproduce``: the paper's figures and tables, measured again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from d4orm_planners.commands.inputs import MOST_SEEDS, make_folder, refuse_options


def reproduce(
    context: typer.Context,
    figure: Annotated[str | None, typer.Argument(help="Which; without it, what there is.")] = None,
    list_: Annotated[bool, typer.Option("--list", help="List the figures.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Tiny sizes, to see that it works: under a minute.")] = False,
    sections: Annotated[
        list[str] | None, typer.Option("--section", "-s", help="Only this panel; repeatable, all by default.")
    ] = None,
    policies: Annotated[
        list[str] | None,
        typer.Option("--policy", "-p", help="Only the policy of this label; repeatable, all by default."),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            "--seeds", "-n", max=MOST_SEEDS, help="Trials per row; the paper's 50 by default, 1 with --quick."
        ),
    ] = None,
    workers: Annotated[
        int, typer.Option("--workers", "-j", help="Processes of one thread each; with 1, one trial on all cores.")
    ] = 1,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder to make the figure's folder in, and to go on from.")
    ] = Path("reproduction"),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no tables.")] = False,
) -> None:
    """Measure a figure or table of the paper, and set it beside the paper's numbers; goes on where it was stopped."""
    from d4orm_planners.evaluation.figures import FIGURES, find_figure

    if figure is None or list_:
        refuse_options(
            context,
            ("figure", "quick", "sections", "policies", "seeds", "workers", "out", "quiet"),
            "does not go with the list of figures; give a figure, and leave out --list",
        )
        for chosen in FIGURES.values():
            typer.echo(f"{chosen.name:<15} {chosen.title} ({chosen.source})")
        return
    from d4orm_planners.evaluation.live import PartsProgress
    from d4orm_planners.evaluation.reproduction import reproduce as run
    from d4orm_planners.evaluation.reproduction_report import markdown, write_reproduction
    from d4orm_planners.evaluation.warmup import warm_up

    chosen = find_figure(figure).only(sections or (), policies or ())
    if quick:
        chosen = chosen.quick()
    folder = out / (f"{chosen.name}-quick" if quick else chosen.name)
    make_folder(folder)
    if not quick:
        warm_up()  # the time of a controller would include its compilation
    try:
        with PartsProgress(enabled=not quiet) as progress:
            groups = run(chosen, folder, seeds=seeds, workers=workers, progress=progress.update)
    except KeyboardInterrupt:
        typer.echo(f"stopped; the finished trials are kept in {folder}, the same command goes on from there", err=True)
        raise
    written = write_reproduction(folder, chosen, groups)
    if not quiet:
        typer.echo(markdown(chosen, groups))
        for path in written:
            typer.echo(f"wrote {path}")
