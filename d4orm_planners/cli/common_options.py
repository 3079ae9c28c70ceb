"""Options that several commands share, and commands that take a dataclass of options."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import typer

from d4orm_env import render, scenarios
from d4orm_env.core.lazy import LazyModule
from d4orm_env.scenarios.problems import is_scenario_file
from d4orm_planners.cli.arguments import check_target, names, parse_settings, refuse_options

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem
    from d4orm_env.core.trajectory import DisturbanceEvents, Trajectory

T = TypeVar("T")
_episode: Any = LazyModule("d4orm_planners.base.episode")


Model = Annotated[
    str | None,
    typer.Option("--model", "-m", help="Robot model, or one a robot, as car,unicycle; the scenario's own by default."),
]
ScenarioSettings = Annotated[
    list[str] | None,
    typer.Option("--scenario-set", help="An argument of the scenario, as diameter=8; repeatable."),
]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the scenario and of the planner.")]
Engine = Annotated[str, typer.Option("--engine", help="auto, cpu or jax.")]
TimeLimit = Annotated[float | None, typer.Option("--time-limit", help="Seconds for planning.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no tables.")]
ScenarioName = Annotated[
    str,
    typer.Option(
        "--scenario", "-s", help="Scenario name (see `d4orm scenarios`), a YAML file or package.module:function."
    ),
]
NumRobots = Annotated[
    int | None, typer.Option("--num-robots", "--robots", "-k", help="Number of robots; the scenario's own by default.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="A setting of the planner or policy, as num_samples=512; repeatable."),
]
NoiseLevel = Annotated[
    float, typer.Option("--control-noise-std", "--noise", help="Standard deviation of the execution noise.")
]
Disturb = Annotated[
    list[str] | None,
    typer.Option("--disturb", help="A disturbance at a level, as delay=2 or push.speed=0.3; repeatable."),
]
Workers = Annotated[int | None, typer.Option("--workers", "-j", help="Processes; all cores by default.")]


def takes(options: type[T]) -> Callable[[Callable[[T], None]], Callable[..., None]]:
    """Make a command of a function of one argument: a dataclass, whose fields are the command's options.

    Args:
        options: The dataclass; the fields' types are annotated as those of parameters are for Typer.
    """

    def decorate(function: Callable[[T], None]) -> Callable[..., None]:
        @wraps(function)
        def command(**given: object) -> None:
            function(options(**given))

        hints = get_type_hints(options, include_extras=True)
        fields = inspect.signature(options).parameters.values()
        command.__annotations__ = hints
        command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [field.replace(annotation=hints[field.name]) for field in fields]
        )
        return command

    return decorate


@dataclass(frozen=True, kw_only=True)
class ObservationOptions:
    """Options on what robots observe; what is not given is as the environment has it."""

    observed_robots: Annotated[int | None, typer.Option(help="Nearest robots in an observation.")] = None
    observed_obstacles: Annotated[int | None, typer.Option(help="Nearest obstacles in an observation.")] = None
    observed_rays: Annotated[
        int | None, typer.Option(help="Rays of every robot's range sensor; noise: --disturb ray_noise=0.02.")
    ] = None
    ray_range: Annotated[float | None, typer.Option(help="Range of these [m].")] = None
    observed_path: Annotated[
        bool | None, typer.Option("--observed-path", help="Direction and length of the shortest path.")
    ] = None
    communication_range: Annotated[
        float | None, typer.Option(help="Distance beyond which no neighbour is observed [m].")
    ] = None
    line_of_sight: Annotated[
        bool | None, typer.Option("--line-of-sight", help="Neighbours behind obstacles are not observed either.")
    ] = None

    @property
    def observation(self) -> dict[str, Any]:
        """Arguments of an environment."""
        given = {field.name: getattr(self, field.name) for field in fields(ObservationOptions)}
        return {name: value for name, value in given.items() if value is not None}


def _imported(physics: str) -> str:
    _episode.physics_module(physics)  # before SciPy, as crazyflow must be
    return physics


Physics = Annotated[
    str,
    typer.Option(
        "--physics", callback=_imported, help="What moves the robots: model, as planners know them, mujoco, crazyflow."
    ),
]


@dataclass(frozen=True, kw_only=True)
class ProblemOptions:
    """Options on the problem."""

    context: typer.Context
    scenario: ScenarioName = "circle"
    num_robots: NumRobots = None
    model: Model = None
    num_obstacles: Annotated[
        int | None, typer.Option("--num-obstacles", "--obstacles", help="Random obstacles to add.")
    ] = None
    scenario_settings: ScenarioSettings = None
    seed: Seed = 0

    def problem(self) -> Problem:
        """The problem."""
        common = ("num_robots", "model", "num_obstacles")
        if is_scenario_file(self.scenario):
            reason = f"does not go with a scenario file; change it in {self.scenario}"
            refuse_options(self.context, (*common, "scenario_settings"), reason)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", ".*nothing solves this problem")  # the commands tell it at their end
                return scenarios.load_problem(self.scenario)
        own = parse_settings(self.scenario_settings, "--scenario-set")
        for name in (*common, "seed"):
            if name in own:
                raise ValueError(f"--scenario-set {name} is said by --{name.replace('_', '-')}; use that")
        models = names(self.model) or ()
        own["model"] = models if len(models) > 1 else self.model
        return scenarios.make_problem(
            self.scenario, self.num_robots, self.seed, num_obstacles=self.num_obstacles, **own
        )


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """Options on pictures, and on how much to say."""

    picture: Annotated[Path | None, typer.Option(help="Picture to write: .png, .svg or .pdf.")] = None
    animation: Annotated[Path | None, typer.Option(help="Animation to write: .gif or .mp4.")] = None
    quiet: Quiet = False

    def check_pictures(self) -> None:
        """Raise ``ValueError`` if they cannot be written."""
        check_target(self.picture, (".png", ".svg", ".pdf"))
        check_target(self.animation, (".gif", ".mp4"))

    def draw(self, problem: Problem, trajectory: Trajectory, events: DisturbanceEvents | None = None) -> None:
        """Write the pictures that were asked for."""
        if self.picture is not None:
            render.save_picture(problem, trajectory, self.picture, events=events)
        if self.animation is not None:
            render.save_animation(problem, trajectory, self.animation, events=events)
