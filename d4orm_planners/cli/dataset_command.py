"""``d4orm dataset``: demonstrations to learn from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from d4orm_env.disturbances.disturbance_registry import disturbances_at
from d4orm_env.scenarios.problems import is_scenario_file
from d4orm_planners.cli.arguments import output_folder, parse_settings, refuse_options, seed_list, single_levels
from d4orm_planners.cli.common_options import (
    Disturb,
    Model,
    NoiseLevel,
    NumRobots,
    ObservationOptions,
    Quiet,
    ScenarioName,
    ScenarioSettings,
    Settings,
    Workers,
    takes,
)
from d4orm_planners.cli.outputs import resumable
from d4orm_planners.rl.dataset import Demonstrations
from d4orm_planners.rl.dataset.write import checked_id, dataset_folder, write_dataset


@dataclass(frozen=True, kw_only=True)
class DatasetOptions(ObservationOptions):
    """Options on demonstrations and their files."""

    context: typer.Context
    policy: Annotated[str, typer.Option("--policy", "-p", help="Planner, policy or package.module:Name.")] = "d4orm-c2f"
    settings: Settings = None
    scenario: ScenarioName = "random"
    num_robots: NumRobots = None
    model: Model = None
    scenario_settings: ScenarioSettings = None
    seeds: Annotated[
        str,
        typer.Option("--seeds", "--episodes", "-n", help="How many, or which: 50 for 0 to 49, 10-19, or 3,5,8."),
    ] = "100"
    reward: Annotated[str, typer.Option(help="paper or training.")] = "paper"
    control_noise_std: NoiseLevel = 0.0
    disturb: Disturb = None
    agents: Annotated[
        str, typer.Option(help="An episode for the whole team, or one for each robot: team or robot.")
    ] = "team"
    only_success: Annotated[
        bool, typer.Option("--only-success", help="Leave out episodes with a contact or a robot that does not arrive.")
    ] = False
    dataset_id: Annotated[
        str | None, typer.Option("--id", help="Name in Minari, as d4orm/mine-v0; made of what it holds by default.")
    ] = None
    shard_size: Annotated[int, typer.Option(help="Seeds whose episodes go into one file.")] = 1000
    workers: Workers = None
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder; by default where Minari finds the name.")] = (
        None
    )
    quiet: Quiet = False

    def demonstrations(self) -> Demonstrations:
        """Return the demonstrations to record."""
        own = parse_settings(self.scenario_settings, "--scenario-set")
        if is_scenario_file(self.scenario):
            reason = f"does not go with a scenario file; change it in {self.scenario}"
            refuse_options(self.context, ("num_robots", "model", "scenario_settings"), reason)
        environment: dict[str, object] = {"scenario": self.scenario, **own}
        for name in ("num_robots", "model"):
            if name in own:
                raise ValueError(f"--scenario-set {name} is said by --{name.replace('_', '-')}; use that")
            if getattr(self, name) is not None:
                environment[name] = getattr(self, name)
        for name, default in (("reward", "paper"), ("control_noise_std", 0.0)):
            if getattr(self, name) != default:
                environment[name] = getattr(self, name)
        if self.disturb:
            environment["disturbances"] = disturbances_at(single_levels(self.disturb))
        environment |= self.observation
        return Demonstrations(
            policy=self.policy,
            settings=parse_settings(self.settings),
            environment=environment,
            seeds=seed_list(self.seeds),
            agents=self.agents,
            only_success=self.only_success,
        )


@takes(DatasetOptions)
def dataset(options: DatasetOptions) -> None:
    """Record demonstrations of a planner or policy as a Minari dataset; goes on where it was stopped."""
    demonstrations = options.demonstrations()
    name = checked_id(demonstrations.dataset_id if options.dataset_id is None else options.dataset_id)
    folder = options.out or dataset_folder(name)
    kept = f"the finished episodes are kept in {folder}"
    with output_folder(folder), resumable(kept, enabled=not options.quiet) as progress:
        written = write_dataset(
            demonstrations,
            folder,
            dataset_id=name,
            shard_size=options.shard_size,
            workers=options.workers,
            progress=progress,
        )
    if not options.quiet:
        typer.echo(f"wrote {written.total_episodes} episodes, {written.total_steps} steps, to {folder}")
        how = f"minari.MinariDataset({str(folder / 'data')!r})" if options.out else f"minari.load_dataset({name!r})"
        typer.echo(f"use it: {how}")
    if not written.total_episodes:
        typer.echo("every episode was left out; try another policy, or without --only-success", err=True)
        raise typer.Exit(1)
