"""``d4orm train``: reinforcement learning, and imitation of an expert; ``d4orm dataset``: demonstrations."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from d4orm_env.core.errors import unknown
from d4orm_env.core.lazy import LazyModule
from d4orm_env.disturbances.disturbance_registry import disturbances_at
from d4orm_env.scenarios.problems import is_scenario_file
from d4orm_planners.cli.options import (
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
    parse_settings,
    refuse_options,
    seed_list,
    single_levels,
    takes,
)
from d4orm_planners.cli.outputs import resumable, tell_results
from d4orm_planners.rl.dataset import Demonstrations
from d4orm_planners.rl.dataset.write import checked_id, dataset_folder, write_dataset

if TYPE_CHECKING:
    from d4orm_planners.rl.training import TrainingResult

training: Any = LazyModule("d4orm_planners.rl.training", "training", "rl")
imitation: Any = LazyModule("d4orm_planners.rl.imitation", "training", "rl")
IMITATION = "imitation"


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options on the training, and on its folder."""

    context: typer.Context
    algorithm: Annotated[str, Argument(help="ppo or sac, or imitation of an expert.")]
    scenario: Annotated[str, Option("--scenario", "-s", help="What to learn.")] = "random"
    num_robots: Annotated[int, Option("--num-robots", "--robots", "-k", help="Size of the full team.")] = 4
    steps: Annotated[float, Option(help="Robot-steps, as 5e6.")] = 5e6
    seed: Annotated[int, Option(help="Of everything that is drawn.")] = 0
    model: Annotated[str | None, Option("--model", "-m", help="Robot model of all; the scenario's own by default.")] = (
        None
    )
    num_envs: Annotated[int | None, Option(help="Robots that act at once; 1024 for ppo, 64 for sac.")] = None
    curriculum: Annotated[bool, Option(help="Begin with smaller teams.")] = False
    stages: Annotated[int, Option(help="Parts with a checkpoint and an evaluation each.")] = 50
    start_from: Annotated[Path | None, Option(help="A policy file of the same algorithm that learns on.")] = None
    network: Annotated[str, Option(help="flat, or sets: neighbours in any order and number.")] = "flat"
    observed_robots: Annotated[int, Option(help="Neighbours in observations.")] = 4
    observed_rays: Annotated[
        int, Option(help="Rays of every robot's range sensor; noise: --mixture 'rooms 8 disturb.ray_noise=0.02'.")
    ] = 0
    ray_range: Annotated[float, Option(help="Range of these [m].")] = 5.0
    shortest_paths: Annotated[
        bool, Option("--shortest-paths", help="Robots head along their shortest paths; for worlds with walls.")
    ] = False
    learning_rate: Annotated[float | None, Option(help="At the beginning; it falls to a tenth. 3e-4 for ppo.")] = None
    learner_settings: Annotated[
        list[str] | None,
        Option(
            "--learner-set", help="Some settings of ppo or sac in Stable-Baselines3, as gradient_steps=8; repeatable."
        ),
    ] = None
    reward_settings: Annotated[
        list[str] | None, Option("--reward-set", help="A weight of the reward to learn from, as contact=5; repeatable.")
    ] = None
    mixture: Annotated[
        list[str] | None,
        Option(
            help="A scenario, team size and settings to train on with others at once, as 'random 8 size=4', or the "
            "name of a mixture, crowds; repeatable."
        ),
    ] = None
    validation_worlds: Annotated[int, Option(help="Episodes per evaluation.")] = 100
    expert: Annotated[str, Option(help="Imitation: whom to imitate.")] = "d4orm-c2f"
    expert_settings: Annotated[
        list[str] | None,
        Option("--expert-set", help="Imitation: a setting of the expert, as num_samples=64; repeatable."),
    ] = None
    dataset: Annotated[
        str | None, Option(help="Imitation: folder or name of a dataset to begin with; recorded by default.")
    ] = None
    episodes: Annotated[int, Option(help="Imitation: episodes to record in each round.")] = 100
    rounds: Annotated[int, Option(help="Imitation: the first clones the expert, the others are DAgger's.")] = 5
    epochs: Annotated[int, Option(help="Imitation: how often a round looks at all samples.")] = 20
    scenario_settings: Annotated[
        list[str] | None, Option("--scenario-set", "--set", help="An argument of the scenario, as size=4; repeatable.")
    ] = None
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder to write to, and to go on from; runs/ALGORITHM by default.")
    ] = None
    quiet: Quiet = False


@takes(TrainOptions)
def train(options: TrainOptions) -> None:
    """Train a policy that all robots share, by reinforcement or imitation; run again to go on where it stopped."""
    learn = _learning(options)
    folder = options.out or Path("runs") / options.algorithm
    with resumable(folder, "the checkpoints", options.quiet) as progress:
        result = learn(folder, progress=progress, command=shlex.join(["d4orm", *sys.argv[1:]]))
    if not options.quiet:
        best = max(result.curve, key=lambda evaluation: evaluation.rank)
        tell_results(
            f"best validation: success {best.success_rate:.0%}, travel time {best.travel_time:.2f} s after "
            f"{best.steps} steps",
            (result.policy_path, folder / "curve.csv", folder / "curve.png"),
        )
        name = result.network.header.algorithm
        typer.echo(f"use it: make_policy({name!r}, path={str(result.policy_path)!r})")


def _learning(options: TrainOptions) -> Callable[..., TrainingResult]:
    if options.algorithm == IMITATION:
        learn, kind, other = imitation.imitate, imitation.ImitationSettings, training.TrainingSettings
        reason = "is for ppo and sac; leave it out"
    elif options.algorithm in training.ALGORITHMS:
        learn, kind, other = training.train, training.TrainingSettings, imitation.ImitationSettings
        reason = f"is for imitation; use it with 'd4orm train {IMITATION}'"
    else:
        raise unknown("algorithm", options.algorithm, (*training.ALGORITHMS, IMITATION))
    # The settings of both have the names of options.
    own, foreign = ({field.name for field in fields(one)} for one in (kind, other))
    refuse_options(options.context, foreign - own - {"algorithm"}, reason)
    given = {name: getattr(options, name) for name in own}
    for name in own:
        if name.endswith("_settings"):
            given[name] = parse_settings(given[name], f"--{name.removesuffix('_settings')}-set")
    if "steps" in own:
        steps = options.steps
        if not (math.isfinite(steps) and steps == int(steps) >= 1):
            raise ValueError(f"--steps is {steps:g}; it must be a whole number of at least 1")
        given |= {"steps": int(steps), "mixture": tuple(options.mixture or ())}
    return partial(learn, kind(**given))


@dataclass(frozen=True, kw_only=True)
class DatasetOptions(ObservationOptions):
    """Options on demonstrations and their files."""

    context: typer.Context
    policy: Annotated[str, Option("--policy", "-p", help="Planner, policy or package.module:Name.")] = "d4orm-c2f"
    settings: Settings = None
    scenario: ScenarioName = "random"
    num_robots: NumRobots = None
    model: Model = None
    scenario_settings: ScenarioSettings = None
    seeds: Annotated[
        str, Option("--seeds", "--episodes", "-n", help="How many, or which: 50 for 0 to 49, 10-19, or 3,5,8.")
    ] = "100"
    reward: Annotated[str, Option(help="paper or training.")] = "paper"
    control_noise_std: NoiseLevel = 0.0
    disturb: Disturb = None
    agents: Annotated[str, Option(help="An episode for the whole team, or one for each robot: team or robot.")] = "team"
    only_success: Annotated[
        bool, Option("--only-success", help="Leave out episodes with a contact or a robot that does not arrive.")
    ] = False
    dataset_id: Annotated[
        str | None, Option("--id", help="Name in Minari, as d4orm/mine-v0; made of what it holds by default.")
    ] = None
    shard_size: Annotated[int, Option(help="Seeds whose episodes go into one file.")] = 1000
    workers: Workers = None
    out: Annotated[Path | None, Option("--out", "-o", help="Folder; by default where Minari finds the name.")] = None
    quiet: Quiet = False

    def demonstrations(self) -> Demonstrations:
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
    with resumable(folder, "the finished episodes", options.quiet) as progress:
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
