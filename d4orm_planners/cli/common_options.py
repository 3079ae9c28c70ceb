"""Options that several commands share."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from d4orm_env import render
from d4orm_env.scenarios import load_problem, make_problem
from d4orm_env.scenarios.problems import is_scenario_file
from d4orm_planners.base.episode import physics_module
from d4orm_planners.cli.arguments import check_target, parse_settings, refuse_options

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem
    from d4orm_env.core.trajectory import DisturbanceEvents, Trajectory

Model = Annotated[str | None, typer.Option("--model", "-m", help="Robot model; the scenario's own by default.")]
ScenarioSettings = Annotated[
    list[str] | None,
    typer.Option("--scenario-set", help="An argument of the scenario, as diameter=8; repeatable."),
]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the scenario and of the planner.")]
Engine = Annotated[str, typer.Option("--engine", help="auto, cpu or jax.")]
TimeLimit = Annotated[float | None, typer.Option("--time-limit", help="Seconds for planning.")]


def _imported(physics: str) -> str:
    physics_module(physics)  # before SciPy, as crazyflow must be
    return physics


Physics = Annotated[
    str,
    typer.Option(
        "--physics", callback=_imported, help="What moves the robots: model, as planners know them, mujoco, crazyflow."
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no tables.")]


@dataclass(frozen=True, kw_only=True)
class ProblemOptions:
    """Options on the problem."""

    context: typer.Context
    scenario: Annotated[
        str,
        typer.Option(
            "--scenario", "-s", help="Scenario name (see `d4orm scenarios`), a YAML file or package.module:function."
        ),
    ] = "circle"
    num_robots: Annotated[
        int | None,
        typer.Option("--num-robots", "--robots", "-k", help="Number of robots; the scenario's own by default."),
    ] = None
    model: Model = None
    num_obstacles: Annotated[
        int | None, typer.Option("--num-obstacles", "--obstacles", help="Random obstacles to add.")
    ] = None
    scenario_settings: ScenarioSettings = None
    seed: Seed = 0

    def problem(self) -> Problem:
        """The problem.

        Raises:
            ValueError: For an option that makes no sense, or does not go with a scenario file.
        """
        common = ("num_robots", "model", "num_obstacles")
        if is_scenario_file(self.scenario):
            reason = f"does not go with a scenario file; change it in {self.scenario}"
            refuse_options(self.context, (*common, "scenario_settings"), reason)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", ".*nothing solves this problem")  # the commands tell it at their end
                return load_problem(self.scenario)
        own = parse_settings(self.scenario_settings, "--scenario-set")
        for name in (*common, "seed"):
            if name in own:
                raise ValueError(f"--scenario-set {name} is said by --{name.replace('_', '-')}; use that")
        return make_problem(
            self.scenario, self.num_robots, self.seed, model=self.model, num_obstacles=self.num_obstacles, **own
        )


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """Options on pictures, and on how much to say."""

    picture: Annotated[Path | None, typer.Option("--picture", help="Picture to write: .png, .svg or .pdf.")] = None
    animation: Annotated[Path | None, typer.Option("--animation", help="Animation to write: .gif or .mp4.")] = None
    quiet: Quiet = False

    def check_pictures(self) -> None:
        """Raise ``ValueError`` if they cannot be written."""
        check_target(self.picture, (".png", ".svg", ".pdf"))
        check_target(self.animation, (".gif", ".mp4"))

    def draw(self, problem: Problem, trajectory: Trajectory, marks: DisturbanceEvents | None = None) -> None:
        """Write the pictures that were asked for."""
        if self.picture is not None:
            render.save_picture(problem, trajectory, self.picture, marks=marks)
        if self.animation is not None:
            render.save_animation(problem, trajectory, self.animation, marks=marks)
