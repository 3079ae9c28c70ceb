"""``d4orm leaderboard``: the page made of a store of trials."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from d4orm_planners.cli.arguments import check_target, decimals
from d4orm_planners.evaluation.leaderboard import leaderboard as page
from d4orm_planners.evaluation.store import TrialStore
from d4orm_planners.evaluation.tables import read_parquet, target


def leaderboard(
    stores: Annotated[
        list[Path],
        typer.Argument(help="Folders that d4orm evaluate wrote to, or their trials.sqlite or trials.parquet."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Page to write, .md.")] = Path("leaderboard.md"),
    deadlines: Annotated[
        str | None, typer.Option("--deadlines", help="Seconds for planning, as 0.1,0.5,1: success within them.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing.")] = False,
) -> None:
    """Write a page with the results of all trials in a store, or in several."""
    check_target(out, (".md",))
    limits = () if deadlines is None else decimals("--deadlines", deadlines)
    trials = [
        trial
        for store in stores
        for trial in (read_parquet(store) if store.suffix == ".parquet" else TrialStore.existing(store).trials())
    ]
    text = page(trials, limits)
    with target(out) as path:
        path.write_text(text, encoding="utf-8")
    if not quiet:
        typer.echo(f"wrote {out}")
