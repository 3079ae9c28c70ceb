"""``d4orm evaluate``, ``robustness`` and ``leaderboard``: policies compared by trials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from typer import Argument, Option

from d4orm_env.core.files import replaced_when_done
from d4orm_planners.base.display import one_line
from d4orm_planners.base.planner_registry import setting_names
from d4orm_planners.cli.options import (
    ObservationOptions,
    Physics,
    Quiet,
    ScenarioSettings,
    TimeLimit,
    Workers,
    decimals,
    names,
    numbers,
    parse_levels,
    parse_settings,
    policies_by_label,
    seed_list,
    takes,
)
from d4orm_planners.cli.outputs import check_target, resumable, tell_results, tell_written
from d4orm_planners.evaluation.evaluate import run_shard, run_study
from d4orm_planners.evaluation.leaderboard import leaderboard as page
from d4orm_planners.evaluation.robustness import tolerance_tables, write_disturbances, write_robustness
from d4orm_planners.evaluation.store import TrialStore
from d4orm_planners.evaluation.study import Study
from d4orm_planners.evaluation.summary import SuccessRate, TrialGroup, success_rates
from d4orm_planners.evaluation.tables import PARQUET_HINT, markdown, read_parquet, write_results

T = TypeVar("T")

NoiseLevels = Annotated[
    str | None, Option("--control-noise-std", "--noise", help="Standard deviations of the execution noise, as 0,0.1.")
]
DisturbanceLevels = Annotated[
    list[str] | None,
    Option("--disturb", help="Levels of a disturbance, as delay=0,1,2 or push(rate=1).speed=0.2,0.5; repeatable."),
]
Out = Annotated[Path, Option("--out", "-o", help="Folder to write to, and to go on from.")]

STANDARD = (
    "control_noise=0,0.1,0.2,0.3",
    "correlated_noise=0,0.1,0.2,0.3",
    "bias=0,0.05,0.1,0.2",
    "delay=0,1,2,4",
    "dropout=0,0.1,0.3,0.5",
    "gain=0,0.1,0.2,0.4",
    "state_noise=0,0.01,0.02,0.05",
    "state_delay=0,1,2,4",
    "push.speed=0,0.2,0.3,0.5",
    "stall=0,0.1,0.3",
    "intruder=0,1,2",
    "limit_mismatch=1,0.9,0.8,0.7",
)
"""Levels that are run where none are named, from harmless to bad; all robot models have these disturbances."""

OF_RAYS = "ray_noise=0,0.02,0.05,0.1"  #: One more where robots have range sensors


@dataclass(frozen=True, kw_only=True)
class StudyOptions(ObservationOptions):
    """Options on a study, and on how to run it."""

    policies: Annotated[
        list[str] | None,
        Option(
            "--policy",
            "--policies",
            "-p",
            help="Names or package.module:Name with commas, or one with settings, d4orm:num_samples=512 "
            "(label=ours names it); repeatable; d4orm,go-to-goal by default.",
        ),
    ] = None
    scenario: Annotated[
        str, Option("--scenario", "--scenarios", "-s", help="Scenarios or YAML files, separated by commas.")
    ] = "circle"
    num_robots: Annotated[
        str | None, Option("--num-robots", "--robots", "-k", help="Team sizes, as 4,8; the scenario's own by default.")
    ] = None
    model: Annotated[
        str | None, Option("--model", "-m", help="Robot models, as car,unicycle; the scenario's own by default.")
    ] = None
    scenario_settings: ScenarioSettings = None
    seeds: Annotated[
        str, Option("--seeds", "--trials", "-n", help="How many, or which: 50 for 0 to 49, 10-19, or 3,5,8.")
    ] = "50"
    control_noise_std: NoiseLevels = "0"
    disturb: DisturbanceLevels = None
    physics: Physics = "model"
    settings: Annotated[
        list[str] | None,
        Option("--set", help="A setting of all policies that have it, or of one, as orca.time_horizon=2."),
    ] = None
    time_limit: TimeLimit = None
    trial_timeout: Annotated[float | None, Option(help="Seconds after which a trial ends with an error.")] = None
    workers: Workers = None
    ray: Annotated[str | None, Option(help="Address of a Ray cluster to run on, or auto; needs ray.")] = None
    shard: Annotated[
        str | None,
        Option(
            help="Run only a part, as 3/20, the third of twenty, in a job array; afterwards the same command without "
            "it puts all together."
        ),
    ] = None
    out: Out = Path("evaluation")
    quiet: Quiet = False

    def run(self) -> list[TrialGroup]:
        """Run the trials that are not stored yet, and give all that were asked for."""
        return self._run(run_study, ray=self.ray)

    def run_shard(self, shard: str) -> Path:
        """Run that part of the trials, ``"3/20"``, and give the file that they are in."""
        index, slash, count = shard.partition("/")
        if not (slash and index.isdecimal() and count.isdecimal()):
            raise ValueError(f"--shard {shard!r} is no part; give its number and how many there are, as 3/20")
        if self.ray is not None:
            raise ValueError("--shard and --ray both spread trials over machines; give one of them")
        return self._run(run_shard, shard=(int(index), int(count)))

    def _run(self, run: Callable[..., T], **own: object) -> T:
        study = self._study()
        with resumable(self.out, "the finished trials", self.quiet) as progress:
            return run(
                study, self.out, trial_timeout=self.trial_timeout, workers=self.workers, progress=progress, **own
            )

    def _study(self) -> Study:
        return Study(
            policies=_with_settings(
                policies_by_label(self.policies or ["d4orm,go-to-goal"]), parse_settings(self.settings)
            ),
            scenarios=names(self.scenario) or (),
            seeds=seed_list(self.seeds),
            control_noise_std=decimals(
                "--control-noise-std", "0" if self.control_noise_std is None else self.control_noise_std
            ),
            disturbances=parse_levels(self.disturb),
            num_robots=numbers("--num-robots", self.num_robots) or (None,),
            model=names(self.model),
            scenario_settings=parse_settings(self.scenario_settings, "--scenario-set"),
            time_limit=self.time_limit,
            physics=self.physics,
            observation=self.observation,
        )


@takes(StudyOptions)
def evaluate(options: StudyOptions) -> None:
    """Compare policies on scenarios, team sizes, seeds, noise and disturbances; goes on where it was stopped."""
    rates, written = report(options, write_results)
    if options.out / "trials.parquet" not in written:
        typer.echo(PARQUET_HINT, err=True)
    require_trials(rates)


def report(
    options: StudyOptions, write: Callable[[Path, list[SuccessRate]], list[Path]]
) -> tuple[list[SuccessRate], list[Path]]:
    """Run the trials and write what they came to; the success rates and what was written. A shard ends here."""
    if options.shard is not None:
        path = options.run_shard(options.shard)
        if not options.quiet:
            typer.echo(f"wrote {path}; once all shards have ended, the same command without --shard puts them together")
        raise typer.Exit
    groups = options.run()
    rates = success_rates(groups)
    written = write(options.out, rates)
    if options.disturb is not None:
        written += write_disturbances(options.out, groups)
    if not options.quiet:
        tell_results(markdown(rates) if options.disturb is None else tolerance_tables(rates), written)
    return rates, written


def require_trials(rates: list[SuccessRate]) -> None:
    """Say so, and end with status 1, if every trial ended with an error."""
    if all(rate.errors == rate.trials for rate in rates):
        trials = sum(rate.trials for rate in rates)
        typer.echo(f"every trial ({trials}) ended with an error; the first: {one_line(rates[0].error)}", err=True)
        raise typer.Exit(1)


def _with_settings(chosen: dict[str, dict[str, object]], settings: dict[str, object]) -> dict[str, dict[str, object]]:
    """Add what ``--set`` says: ``orca.time_horizon`` to one policy, ``num_samples`` to all that have it."""
    policies = {label: str(given.get("policy", label)) for label, given in chosen.items()}
    known = {
        label: setting_names(
            own, {name.removeprefix(f"{own}."): value for name, value in settings.items()} | chosen[label]
        )
        for label, own in policies.items()
    }
    # What is said of one configuration counts most, then what is said of one policy, whichever was given first.
    for name, value in sorted(settings.items(), key=lambda setting: "." not in setting[0]):
        policy, separator, setting = name.rpartition(".")
        owners = [label for label, own in policies.items() if (own == policy if separator else name in known[label])]
        if not owners:
            listed = ", ".join(policies.values())
            one, several = f"{policy!r} is not among the policies; they are", f"{name!r} is a setting of none of the"
            raise ValueError(f"--set {name}: {one if separator else several + ' policies'} {listed}")
        for label in owners:
            chosen[label].setdefault(setting, value)
    return chosen


@dataclass(frozen=True, kw_only=True)
class RobustnessOptions(StudyOptions):
    """Options of ``d4orm evaluate``; without levels of noise or disturbances :data:`STANDARD`."""

    control_noise_std: NoiseLevels = None
    out: Out = Path("robustness")


@takes(RobustnessOptions)
def robustness(options: RobustnessOptions) -> None:
    """Measure how often policies succeed when something goes wrong: noise, delays, pushes and others."""
    if options.control_noise_std is None and options.disturb is None:
        options = replace(options, disturb=[*STANDARD, *[OF_RAYS] * bool(options.observed_rays)])
    rates, _ = report(options, write_robustness)
    require_trials(rates)


def leaderboard(
    stores: Annotated[
        list[Path], Argument(help="Folders that d4orm evaluate wrote to, or their trials.sqlite or trials.parquet.")
    ],
    out: Annotated[Path, Option("--out", "-o", help="Page to write, .md.")] = Path("leaderboard.md"),
    deadlines: Annotated[str | None, Option(help="Seconds for planning, as 0.1,0.5,1: success within them.")] = None,
    quiet: Quiet = False,
) -> None:
    """Write a page with the results of all trials in a store, or in several."""
    check_target(out, (".md",))
    limits = () if deadlines is None else decimals("--deadlines", deadlines)
    trials = chain.from_iterable(
        read_parquet(store) if store.suffix == ".parquet" else TrialStore.existing(store).trials() for store in stores
    )
    # A trial that several of them have is one.
    text = page([*{trial.key: trial for trial in trials}.values()], limits)
    with replaced_when_done(out) as path:
        path.write_text(text, encoding="utf-8")
    tell_written(out, quiet=quiet)
