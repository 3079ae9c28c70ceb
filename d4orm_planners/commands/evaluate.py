"""``d4orm evaluate`` and ``d4orm leaderboard``: policies compared, and the page made of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from d4orm_planners.commands.inputs import (
    MOST_SEEDS,
    decimals,
    find_here,
    make_folder,
    names,
    numbers,
    parse_settings,
    require_trials,
)


def evaluate(
    policies: Annotated[
        list[str] | None,
        typer.Option(
            "--policy",
            "--policies",
            "-p",
            help="Names or package.module:Name with commas, or one with settings, d4orm:num_samples=512; repeatable.",
        ),
    ] = None,
    scenario: Annotated[
        str, typer.Option("--scenario", "--scenarios", "-s", help="Scenarios or YAML files, separated by commas.")
    ] = "circle",
    robots: Annotated[
        str | None, typer.Option("--robots", "-k", help="Team sizes, as 4,8; the scenario's own by default.")
    ] = None,
    model: Annotated[
        str | None, typer.Option("--model", "-m", help="Robot model; the scenario's own by default.")
    ] = None,
    seeds: Annotated[
        str, typer.Option("--seeds", "-n", help="How many, or which: 50 for 0 to 49, 10-19, or 3,5,8.")
    ] = "50",
    noise: Annotated[str, typer.Option("--noise", help="Standard deviations of the execution noise, as 0,0.1.")] = "0",
    time_limit: Annotated[float | None, typer.Option("--time-limit", help="Seconds for planning.")] = None,
    trial_timeout: Annotated[
        float | None, typer.Option("--trial-timeout", help="Seconds after which a trial ends with an error.")
    ] = None,
    workers: Annotated[int | None, typer.Option("--workers", "-j", help="Processes; all cores by default.")] = None,
    ray: Annotated[
        str | None, typer.Option("--ray", help="Address of a Ray cluster to run on, or auto; needs ray.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to, and to go on from.")] = Path(
        "evaluation"
    ),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no table.")] = False,
) -> None:
    """Compare policies on scenarios, team sizes, seeds and levels of noise; goes on where it was stopped."""
    from d4orm_planners.evaluation.exports import PARQUET_HINT, write_results
    from d4orm_planners.evaluation.harness import measure
    from d4orm_planners.evaluation.live import PartsProgress
    from d4orm_planners.evaluation.tables import markdown

    given: dict[str, Any] = {
        "policies": _policies(policies or ["d4orm,goal"]),
        "scenarios": names(scenario) or (),
        "seeds": _seeds(seeds),
        "control_noise_std": decimals("--noise", noise),
        "num_robots": numbers("--robots", robots) or (None,),
    }
    make_folder(out)
    limits: dict[str, Any] = {"time_limit": time_limit, "trial_timeout": trial_timeout}
    try:
        with PartsProgress(enabled=not quiet) as progress:
            rates = measure(**given, **limits, model=model, workers=workers, ray=ray, out=out, progress=progress.update)
    except KeyboardInterrupt:
        typer.echo(f"stopped; the finished trials are kept in {out}, the same command goes on from there", err=True)
        raise
    written = write_results(out, rates)
    if not quiet:
        typer.echo(markdown(rates))
        for path in written:
            typer.echo(f"wrote {path}")
    if out / "trials.parquet" not in written:
        typer.echo(PARQUET_HINT, err=True)
    require_trials(rates)


def leaderboard(
    store: Annotated[Path, typer.Argument(help="Folder that d4orm evaluate wrote to, or its trials.sqlite.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Page to write, .md.")] = Path("leaderboard.md"),
    deadlines: Annotated[
        str | None, typer.Option("--deadlines", help="Seconds for planning, as 0.1,0.5,1: success within them.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing.")] = False,
) -> None:
    """Write a page with the results of all trials in a store."""
    from d4orm_planners.evaluation.exports import target
    from d4orm_planners.evaluation.leaderboard import leaderboard as page
    from d4orm_planners.evaluation.store import TrialStore

    if out.suffix != ".md":
        raise ValueError(f"output file {str(out)!r} must end in .md")
    limits = () if deadlines is None else decimals("--deadlines", deadlines)
    text = page(TrialStore.existing(store).trials(), limits)
    with target(out) as path:
        path.write_text(text, encoding="utf-8")
    if not quiet:
        typer.echo(f"wrote {out}")


def _policies(texts: list[str]) -> dict[str, dict[str, Any]]:
    """Settings by label: a name stands for itself, and a configuration is called what was typed."""
    from d4orm_planners.registry import list_policies

    chosen: dict[str, dict[str, Any]] = {}
    for text in texts:
        # The name ends where the first setting begins, for an import path has a colon too.
        policy, colon, _ = text.partition("=")[0].rpartition(":")
        if not colon or ("=" not in text and policy not in list_policies()):
            chosen.update((name, {}) for name in names(text) or ())
            continue
        if "policy" in (values := parse_settings(text.removeprefix(policy + colon).split(","), "--policy")):
            raise ValueError(f"--policy {text!r}: 'policy' is no setting; the name stands before the colon")
        chosen[text] = {"policy": policy, **values}
    find_here(settings.get("policy", label) for label, settings in chosen.items())
    return chosen


def _seeds(text: str) -> list[int]:
    try:
        if "," in text:
            return [int(number) for number in text.split(",")]
        first, last = (int(number) for number in text.split("-")) if "-" in text.strip()[1:] else (0, int(text) - 1)
    except ValueError:
        raise ValueError(f"--seeds {text!r} is neither a number, as 50, nor a range, as 10-19, nor a list") from None
    if last - first >= MOST_SEEDS:
        raise ValueError(f"--seeds {text!r} asks for more than {MOST_SEEDS} seeds; give fewer")
    return list(range(first, last + 1))
