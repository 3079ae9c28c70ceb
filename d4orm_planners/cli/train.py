"""``d4orm train``: reinforcement learning, and imitation of an expert."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated

import typer

from d4orm_env.core.errors import unknown
from d4orm_planners.cli.arguments import output_folder, parse_settings, refuse_options
from d4orm_planners.cli.common_options import Model
from d4orm_planners.cli.dataclass_options import takes
from d4orm_planners.cli.progress import resumable, tell_results

if TYPE_CHECKING:
    from d4orm_planners.rl.training import TrainingResult


IMITATION = "imitation"
_REINFORCEMENT_ONLY = (
    "steps", "num_envs", "curriculum", "stages", "start_from", "network", "observed_robots", "shortest_paths",
    "learning_rate", "learner_settings", "reward_settings", "mixture",
)  # fmt: skip
_IMITATION_ONLY = ("expert", "expert_settings", "dataset", "episodes", "rounds", "epochs")


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options on the training, and on its folder."""

    context: typer.Context
    algorithm: Annotated[str, typer.Argument(help="ppo or sac, or imitation of an expert.")]
    scenario: Annotated[str, typer.Option("--scenario", "-s", help="What to learn.")] = "random"
    num_robots: Annotated[int, typer.Option("--num-robots", "--robots", "-k", help="Size of the full team.")] = 4
    steps: Annotated[float, typer.Option("--steps", help="Robot-steps, as 5e6.")] = 5e6
    seed: Annotated[int, typer.Option("--seed", help="Of everything that is drawn.")] = 0
    model: Model = None
    num_envs: Annotated[
        int | None, typer.Option("--num-envs", help="Robots that act at once; 1024 for ppo, 64 for sac.")
    ] = None
    curriculum: Annotated[bool, typer.Option(help="Begin with smaller teams.")] = False
    stages: Annotated[int, typer.Option("--stages", help="Parts with a checkpoint and an evaluation each.")] = 50
    start_from: Annotated[
        Path | None, typer.Option("--start-from", help="A policy file of the same algorithm that learns on.")
    ] = None
    network: Annotated[str, typer.Option("--network", help="flat, or sets: neighbours in any order and number.")] = (
        "flat"
    )
    observed_robots: Annotated[int, typer.Option("--observed-robots", help="Neighbours in observations.")] = 4
    shortest_paths: Annotated[
        bool, typer.Option("--shortest-paths", help="Robots head along their shortest paths; for worlds with walls.")
    ] = False
    learning_rate: Annotated[
        float | None, typer.Option("--learning-rate", help="At the beginning; it falls to a tenth. 3e-4 for ppo.")
    ] = None
    learner_settings: Annotated[
        list[str] | None,
        typer.Option(
            "--learner-set", help="A setting of ppo or sac in Stable-Baselines3, as gradient_steps=8; repeatable."
        ),
    ] = None
    reward_settings: Annotated[
        list[str] | None,
        typer.Option("--reward-set", help="A weight of the reward to learn from, as contact=5; repeatable."),
    ] = None
    mixture: Annotated[
        list[str] | None,
        typer.Option(
            "--mixture",
            help="A scenario, team size and settings to train on with others at once, as 'random 8 size=4', or the "
            "name of a mixture, crowds; repeatable.",
        ),
    ] = None
    validation_worlds: Annotated[int, typer.Option("--validation-worlds", help="Episodes per evaluation.")] = 100
    expert: Annotated[str, typer.Option("--expert", help="Imitation: whom to imitate.")] = "d4orm-c2f"
    expert_settings: Annotated[
        list[str] | None,
        typer.Option("--expert-set", help="Imitation: a setting of the expert, as num_samples=64; repeatable."),
    ] = None
    dataset: Annotated[
        str | None,
        typer.Option("--dataset", help="Imitation: folder or name of a dataset to begin with; recorded by default."),
    ] = None
    episodes: Annotated[int, typer.Option("--episodes", help="Imitation: episodes to record in each round.")] = 100
    rounds: Annotated[
        int, typer.Option("--rounds", help="Imitation: the first clones the expert, the others are DAgger's.")
    ] = 5
    epochs: Annotated[int, typer.Option("--epochs", help="Imitation: how often a round looks at all samples.")] = 20
    scenario_settings: Annotated[
        list[str] | None,
        typer.Option("--scenario-set", "--set", help="An argument of the scenario, as size=4; repeatable."),
    ] = None
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder to write to, and to go on from; runs/ALGORITHM by default."),
    ] = None
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no summary.")] = False


@takes(TrainOptions)
def train(options: TrainOptions) -> None:
    """Train a policy that all robots share, by reinforcement or imitation; run again to go on where it stopped."""
    learn = _imitation(options) if options.algorithm == IMITATION else _reinforcement(options)
    folder = options.out or Path("runs") / options.algorithm
    kept = f"the checkpoints are kept in {folder}"
    with output_folder(folder), resumable(kept, enabled=not options.quiet) as progress:
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


def _reinforcement(options: TrainOptions) -> Callable[..., TrainingResult]:
    """The training that was asked for."""
    training = _library("training")
    if options.algorithm not in training.ALGORITHMS:
        raise unknown("algorithm", options.algorithm, (*training.ALGORITHMS, IMITATION))
    refuse_options(options.context, _IMITATION_ONLY, f"is for imitation; use it with 'd4orm train {IMITATION}'")
    steps = options.steps
    if not (math.isfinite(steps) and steps == int(steps) >= 1):
        raise ValueError(f"--steps is {steps:g}; it must be a whole number of at least 1")
    same = (
        "algorithm", "num_envs", "curriculum", "stages", "start_from", "network", "observed_robots", "shortest_paths",
        "learning_rate",
    )  # fmt: skip
    own = {name: getattr(options, name) for name in same}
    own |= {"steps": int(steps), "mixture": tuple(options.mixture or ())}
    own["learner_settings"] = parse_settings(options.learner_settings, "--learner-set")
    own["reward_settings"] = parse_settings(options.reward_settings, "--reward-set")
    settings = training.TrainingSettings(**_config_options(options), **own)
    return partial(training.train, settings)


def _imitation(options: TrainOptions) -> Callable[..., TrainingResult]:
    """The same, from an expert."""
    imitation = _library("imitation")
    refuse_options(options.context, _REINFORCEMENT_ONLY, "is for ppo and sac; leave it out")
    own = {name: getattr(options, name) for name in ("expert", "dataset", "episodes", "rounds", "epochs")}
    expert_settings = parse_settings(options.expert_settings, "--expert-set")
    settings = imitation.ImitationSettings(**_config_options(options), **own, expert_settings=expert_settings)
    return partial(imitation.imitate, settings)


def _config_options(options: TrainOptions) -> dict[str, object]:
    """Return the settings that both have in common."""
    return {
        **{name: getattr(options, name) for name in ("scenario", "num_robots", "seed", "model", "validation_worlds")},
        "scenario_settings": parse_settings(options.scenario_settings, "--scenario-set"),
    }


def _library(name: str) -> ModuleType:
    try:
        return import_module(f"d4orm_planners.rl.{name}")
    except ModuleNotFoundError as error:
        raise ImportError(f"training needs {error.name}; install it with: pip install 'd4orm-env[rl]'") from None
