"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

Scenario = Annotated[
    str,
    typer.Option(
        "--scenario", "-s", help="Scenario name (see `d4orm scenarios`), a YAML file or package.module:function."
    ),
]
Robots = Annotated[int | None, typer.Option("--robots", "-k", help="Number of robots; the scenario's own by default.")]
Model = Annotated[str | None, typer.Option("--model", "-m", help="Robot model; the scenario's own by default.")]
Obstacles = Annotated[int | None, typer.Option("--obstacles", help="Random obstacles to add.")]
ScenarioSettings = Annotated[
    list[str] | None,
    typer.Option("--scenario-set", help="An argument of the scenario, as diameter=8; repeatable."),
]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the scenario and of the planner.")]
PlannerName = Annotated[
    str, typer.Option("--planner", "-p", help="Planner (see `d4orm planners`), or package.module:Name.")
]
Preset = Annotated[str | None, typer.Option("--preset", help="`paper` for the paper's parameters.")]
Settings = Annotated[list[str] | None, typer.Option("--set", help="A planner setting, as num_samples=512; repeatable.")]
Engine = Annotated[str, typer.Option("--engine", help="auto, cpu or jax.")]
TimeLimit = Annotated[float | None, typer.Option("--time-limit", help="Seconds for planning.")]
MaxIterations = Annotated[int | None, typer.Option("--max-iterations", help="Iterations for planning.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no tables.")]
