"""``d4orm evaluate``: policies compared; and the options of everything that runs a study."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from d4orm_planners.base.escaping import one_line
from d4orm_planners.base.planner_registry import list_policies, setting_names
from d4orm_planners.cli.arguments import (
    decimals,
    names,
    numbers,
    output_folder,
    parse_levels,
    parse_settings,
    seed_list,
)
from d4orm_planners.cli.common_options import Physics, Quiet, ScenarioSettings, TimeLimit
from d4orm_planners.cli.dataclass_options import takes
from d4orm_planners.cli.progress import resumable, tell_results
from d4orm_planners.evaluation.evaluate import run_shard, run_study
from d4orm_planners.evaluation.robustness import tolerance_tables, write_disturbances
from d4orm_planners.evaluation.study import Study
from d4orm_planners.evaluation.summary import success_rates
from d4orm_planners.evaluation.tables import PARQUET_HINT, markdown, write_results

if TYPE_CHECKING:
    from d4orm_planners.evaluation.summary import SuccessRate, TrialGroup

NoiseLevels = Annotated[
    str | None,
    typer.Option("--control-noise-std", "--noise", help="Standard deviations of the execution noise, as 0,0.1."),
]
DisturbanceLevels = Annotated[
    list[str] | None,
    typer.Option(
        "--disturb", help="Levels of a disturbance, as delay=0,1,2 or push(rate=1).speed=0.2,0.5; repeatable."
    ),
]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to, and to go on from.")]


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Options on a study, and on how to run it."""

    policies: Annotated[
        list[str] | None,
        typer.Option(
            "--policy",
            "--policies",
            "-p",
            help="Names or package.module:Name with commas, or one with settings, d4orm:num_samples=512; repeatable; "
            "d4orm,go-to-goal by default.",
        ),
    ] = None
    scenario: Annotated[
        str, typer.Option("--scenario", "--scenarios", "-s", help="Scenarios or YAML files, separated by commas.")
    ] = "circle"
    num_robots: Annotated[
        str | None,
        typer.Option("--num-robots", "--robots", "-k", help="Team sizes, as 4,8; the scenario's own by default."),
    ] = None
    model: Annotated[
        str | None, typer.Option("--model", "-m", help="Robot models, as car,unicycle; the scenario's own by default.")
    ] = None
    scenario_settings: ScenarioSettings = None
    seeds: Annotated[
        str, typer.Option("--seeds", "--trials", "-n", help="How many, or which: 50 for 0 to 49, 10-19, or 3,5,8.")
    ] = "50"
    control_noise_std: NoiseLevels = "0"
    disturb: DisturbanceLevels = None
    physics: Physics = "model"
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="A setting of all policies that have it, or of one, as orca.time_horizon=2."),
    ] = None
    time_limit: TimeLimit = None
    trial_timeout: Annotated[
        float | None, typer.Option("--trial-timeout", help="Seconds after which a trial ends with an error.")
    ] = None
    workers: Annotated[int | None, typer.Option("--workers", "-j", help="Processes; all cores by default.")] = None
    ray: Annotated[
        str | None, typer.Option("--ray", help="Address of a Ray cluster to run on, or auto; needs ray.")
    ] = None
    shard: Annotated[
        str | None,
        typer.Option(
            "--shard",
            help="Run only a part, as 3/20, the third of twenty, in a job array; afterwards the same command without "
            "it puts all together.",
        ),
    ] = None
    out: Out = Path("evaluation")
    quiet: Quiet = False

    def run(self) -> list[TrialGroup]:
        """Run the trials that are not stored yet, and give all that were asked for.

        Raises:
            ValueError: For an option that makes no sense. Nothing has run then.
        """
        study, kept = self._study(), f"the finished trials are kept in {self.out}"
        with output_folder(self.out), resumable(kept, enabled=not self.quiet) as progress:
            return run_study(
                study, self.out, trial_timeout=self.trial_timeout, workers=self.workers, ray=self.ray, progress=progress
            )

    def run_shard(self, shard: str) -> Path:
        """Run that part of the trials, ``"3/20"``, and give the file that they are in.

        Raises:
            ValueError: As :meth:`run`, or if it is no part.
        """
        index, slash, count = shard.partition("/")
        if not (slash and index.isdecimal() and count.isdecimal()):
            raise ValueError(f"--shard {shard!r} is no part; give its number and how many there are, as 3/20")
        if self.ray is not None:
            raise ValueError("--shard and --ray both spread trials over machines; give one of them")
        study, kept = self._study(), f"the finished trials are kept in {self.out}"
        with output_folder(self.out), resumable(kept, enabled=not self.quiet) as progress:
            return run_shard(
                study, self.out, (int(index), int(count)), trial_timeout=self.trial_timeout, workers=self.workers,
                progress=progress,
            )  # fmt: skip

    def _study(self) -> Study:
        return Study(
            policies=_with_settings(_policies(self.policies or ["d4orm,go-to-goal"]), parse_settings(self.settings)),
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


def _policies(texts: list[str]) -> dict[str, dict[str, object]]:
    """Settings by label: a name stands for itself, and a configuration is called what was typed."""
    chosen: dict[str, dict[str, object]] = {}
    for text in texts:
        # The name ends where the first setting begins, for an import path has a colon too.
        policy, colon, _ = text.partition("=")[0].rpartition(":")
        if not colon or ("=" not in text and policy not in list_policies()):
            chosen.update((name, {}) for name in names(text) or ())
            continue
        if "policy" in (values := parse_settings(text.removeprefix(policy + colon).split(","), "--policy")):
            raise ValueError(f"--policy {text!r}: 'policy' is no setting; the name stands before the colon")
        chosen[text] = {"policy": policy, **values}
    return chosen


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
