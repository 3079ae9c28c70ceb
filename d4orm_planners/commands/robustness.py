"""``d4orm robustness``: success rates against execution noise."""

from __future__ import annotations

from collections.abc import Sequence
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


def robustness(
    policies: Annotated[
        str,
        typer.Option(
            "--policies", "--policy", "-p", help="Planners, policies and package.module:Name, separated by commas."
        ),
    ] = "d4orm,goal",
    scenario: Annotated[str, typer.Option("--scenario", "-s", help="Scenarios, separated by commas.")] = "circle",
    robots: Annotated[
        str | None, typer.Option("--robots", "-k", help="Team sizes, as 4,8; the scenario's own by default.")
    ] = None,
    model: Annotated[
        str | None, typer.Option("--model", "-m", help="Robot model; the scenario's own by default.")
    ] = None,
    noise: Annotated[
        str, typer.Option("--noise", help="Standard deviations of the execution noise, as 0,0.1.")
    ] = "0,0.05,0.1,0.2",
    trials: Annotated[
        int, typer.Option("--trials", "-n", max=MOST_SEEDS, help="Trials per policy and level of noise.")
    ] = 50,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="A setting of all policies that have it, or of one, as orca.time_horizon=2."),
    ] = None,
    workers: Annotated[int | None, typer.Option("--workers", "-j", help="Processes; all cores by default.")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to, and to go on from.")] = Path(
        "robustness"
    ),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no table.")] = False,
) -> None:
    """Measure how often policies succeed when their controls are executed with noise."""
    from d4orm_planners.evaluation.live import PartsProgress
    from d4orm_planners.evaluation.robustness import robustness as measure
    from d4orm_planners.evaluation.robustness_report import markdown, write_robustness

    chosen = _settings_by_policy(names(policies) or (), parse_settings(settings))
    levels, sizes = decimals("--noise", noise), numbers("--robots", robots) or (None,)
    make_folder(out)
    try:
        with PartsProgress(enabled=not quiet) as progress:
            rates = measure(
                chosen,
                out,
                scenarios=names(scenario) or (),
                robots=sizes,
                noise=levels,
                trials=trials,
                model=model,
                workers=workers,
                progress=progress.update,
            )
    except KeyboardInterrupt:
        typer.echo(f"stopped; the finished trials are kept in {out}, the same command goes on from there", err=True)
        raise
    written = write_robustness(out, rates)
    if not quiet:
        typer.echo(markdown(rates))
        for path in written:
            typer.echo(f"wrote {path}")
    require_trials(rates)


def _settings_by_policy(policies: Sequence[str], settings: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What ``--set`` says, for each policy: ``orca.time_horizon`` for one, ``num_samples`` for all that have it."""
    from d4orm_planners.registry import setting_names

    find_here(policies)
    known = {
        policy: setting_names(policy, {name.removeprefix(f"{policy}."): value for name, value in settings.items()})
        for policy in policies
    }
    chosen: dict[str, dict[str, Any]] = {policy: {} for policy in policies}
    # A setting of one policy counts more than one of all, whichever was given first.
    for name, value in sorted(settings.items(), key=lambda setting: "." in setting[0]):
        policy, separator, setting = name.rpartition(".")
        if separator and policy not in chosen:
            raise ValueError(f"--set {name}: {policy!r} is not among the policies; they are {', '.join(policies)}")
        owners = [policy] if separator else [policy for policy in policies if name in known[policy]]
        if not owners:
            raise ValueError(f"--set {name}: {name!r} is a setting of none of the policies {', '.join(policies)}")
        for owner in owners:
            chosen[owner][setting] = value
    return chosen
