"""``d4orm train``: reinforcement learning."""

from __future__ import annotations

import math
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from d4orm_planners.commands.dataclass_options import takes
from d4orm_planners.commands.inputs import make_folder, parse_settings
from d4orm_planners.commands.options import Model


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """What to learn, and where to write it."""

    algorithm: Annotated[str, typer.Argument(help="ppo or sac.")]
    scenario: Annotated[str, typer.Option("--scenario", "-s", help="What to learn.")] = "random"
    num_robots: Annotated[int, typer.Option("--num-robots", "--robots", "-k", help="Size of the full team.")] = 4
    steps: Annotated[float, typer.Option("--steps", help="Robot-steps, as 5e6.")] = 5e6
    seed: Annotated[int, typer.Option("--seed", help="Of everything that is drawn.")] = 0
    model: Model = None
    num_envs: Annotated[
        int | None, typer.Option("--num-envs", help="Robots that act at once; 1024 for ppo, 64 for sac.")
    ] = None
    curriculum: Annotated[bool, typer.Option(help="Begin with smaller teams.")] = False
    lessons: Annotated[int, typer.Option("--lessons", help="Parts with a checkpoint and an evaluation each.")] = 50
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
    """Train a policy that all robots share, with Stable-Baselines3; run again to go on where it was broken off."""
    training = _training()
    steps = options.steps
    if not (math.isfinite(steps) and steps == int(steps) >= 1):
        raise ValueError(f"--steps is {steps:g}; it must be a whole number of at least 1")
    same = ("algorithm", "scenario", "num_robots", "seed", "model", "num_envs", "curriculum", "lessons")
    settings = training.TrainingSettings(
        **{name: getattr(options, name) for name in same},
        steps=int(steps),
        scenario_settings=parse_settings(options.scenario_settings, "--scenario-set"),
    )
    folder = options.out or Path("runs") / options.algorithm
    make_folder(folder)
    from d4orm_planners.commands.progress import resumable, tell_results

    with resumable(f"the checkpoints are kept in {folder}", enabled=not options.quiet) as progress:
        command = shlex.join(["d4orm", *sys.argv[1:]])
        result = training.train(settings, folder, progress=progress, command=command)
    if not options.quiet:
        best = max(result.curve, key=lambda evaluation: evaluation.rank)
        tell_results(
            f"best validation: success {best.success_rate:.0%}, travel time {best.travel_time:.2f} s after "
            f"{best.steps} steps",
            (result.policy_path, folder / "curve.csv", folder / "curve.png"),
        )
        typer.echo(f"use it: make_policy({options.algorithm!r}, path={str(result.policy_path)!r})")


def _training() -> ModuleType:
    try:
        from d4orm_planners.rl import training
    except ModuleNotFoundError as error:
        raise ImportError(f"training needs {error.name}; install it with: pip install 'd4orm-env[rl]'") from None
    return training
