"""The command ``d4orm``.

Exit status 0: done; 1: no solution found in the budget; 2: bad input, with one line on stderr that says what to change.
Heavy imports happen inside the commands, so that ``--help`` is quick.
"""

from __future__ import annotations

import importlib.metadata
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from d4orm_planners.commands.bench import bench
from d4orm_planners.commands.evaluate import evaluate
from d4orm_planners.commands.inputs import check_target, make_folder, parse_settings, refuse_options
from d4orm_planners.commands.leaderboard import leaderboard
from d4orm_planners.commands.node import node
from d4orm_planners.commands.options import (
    Engine,
    MaxIterations,
    Model,
    Obstacles,
    PlannerName,
    Preset,
    Quiet,
    Robots,
    Scenario,
    ScenarioSettings,
    Seed,
    Settings,
    TimeLimit,
)
from d4orm_planners.commands.outputs import draw, episode_rows, print_plan, print_table, require_solved
from d4orm_planners.commands.reproduce import reproduce
from d4orm_planners.commands.robustness import robustness
from d4orm_planners.commands.train import train

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem
    from d4orm_planners.episode import Episode
    from d4orm_planners.plan import Plan

# Typer carries its own copy of click, whose base class it does not export.
ClickException: Any = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")

app = typer.Typer(
    name="d4orm",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

for command in (bench, evaluate, leaderboard, node, reproduce, robustness, train):
    app.command()(command)


def _tell_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"d4orm {importlib.metadata.version('d4orm-env')}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Plan and run teams of robots that cross each other's way without touching."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")] = Path("demo"),
    robots: Annotated[int, typer.Option("--robots", "-k", help="Number of robots.")] = 16,
    seed: Seed = 0,
    engine: Engine = "auto",
) -> None:
    """Plan robots across a circle, execute the plan in the environment, verify it, and write pictures."""
    from d4orm_env.render import save_animation, save_picture

    make_folder(out)
    problem = _problem("circle", robots, None, None, None, seed)
    plan = _solve(problem, "d4orm", {"engine": engine}, seed, None, None, quiet=False)
    print_plan(plan)
    require_solved(plan)
    episode = _execute(plan, seed)
    files = {"plan": out / "plan.npz", "picture": out / "plan.png", "animation": out / "execution.gif"}
    plan.save(files["plan"])
    title = f"{problem.num_robots} robots, planned by D4orm in {plan.wall_time:.2f} s"
    save_picture(problem, episode.trajectory, files["picture"], title=title)
    save_animation(problem, episode.trajectory, files["animation"])
    for name, path in files.items():
        typer.echo(f"{name:<10} {path}")
    if not episode.metrics["success"]:
        raise typer.Exit(1)


@app.command("plan")
def plan_command(
    context: typer.Context,
    scenario: Scenario = "circle",
    robots: Robots = None,
    model: Model = None,
    obstacles: Obstacles = None,
    scenario_settings: ScenarioSettings = None,
    seed: Seed = 0,
    planner: PlannerName = "d4orm",
    preset: Preset = None,
    settings: Settings = None,
    engine: Engine = "auto",
    time_limit: TimeLimit = None,
    max_iterations: MaxIterations = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Plan file to write, .npz.")] = None,
    picture: Annotated[Path | None, typer.Option("--picture", help="Picture to write: .png, .svg or .pdf.")] = None,
    animation: Annotated[Path | None, typer.Option("--animation", help="Animation to write: .gif or .mp4.")] = None,
    quiet: Quiet = False,
) -> None:
    """Plan for a team; write the plan, a picture or an animation."""
    for path, suffixes in ((out, (".npz",)), (picture, (".png", ".svg", ".pdf")), (animation, (".gif", ".mp4"))):
        check_target(path, suffixes)
    chosen = parse_settings(settings)
    for name in {"engine", "preset", "max_iterations"}.intersection(chosen):
        refuse_options(context, (name,), f"and --set {name} say the same; give one of them")
    chosen = {"engine": engine, "preset": preset, **chosen}
    problem = _problem(scenario, robots, model, obstacles, scenario_settings, seed)
    plan = _solve(problem, planner, chosen, seed, time_limit, max_iterations, quiet)
    if not quiet:
        print_plan(plan)
    if out is not None:
        plan.save(out)
    draw(problem, plan.trajectory, picture, animation)
    for path in (out, picture, animation):
        if path is not None and not quiet:
            typer.echo(f"wrote {path}")
    require_solved(plan)


@app.command()
def run(
    context: typer.Context,
    plan_file: Annotated[Path | None, typer.Argument(help="Plan to execute; plans anew without one.")] = None,
    scenario: Scenario = "circle",
    robots: Robots = None,
    model: Model = None,
    obstacles: Obstacles = None,
    scenario_settings: ScenarioSettings = None,
    seed: Seed = 0,
    policy: Annotated[
        str, typer.Option("--policy", "-p", help="Planner, policy or package.module:Name to run.")
    ] = "d4orm",
    noise: Annotated[float, typer.Option("--noise", help="Standard deviation of the execution noise.")] = 0.0,
    picture: Annotated[Path | None, typer.Option("--picture", help="Picture to write: .png, .svg or .pdf.")] = None,
    animation: Annotated[Path | None, typer.Option("--animation", help="Animation to write: .gif or .mp4.")] = None,
    quiet: Quiet = False,
) -> None:
    """Run a plan or a policy in the environment, step by step, and judge what happened."""
    from d4orm_env import navigation_v0
    from d4orm_planners.episode import run_episode
    from d4orm_planners.plan import Plan
    from d4orm_planners.policy import OpenLoop, Policy
    from d4orm_planners.registry import make_policy

    for path, suffixes in ((picture, (".png", ".svg", ".pdf")), (animation, (".gif", ".mp4"))):
        check_target(path, suffixes)
    if plan_file is not None:
        refuse_options(
            context,
            ("scenario", "robots", "model", "obstacles", "scenario_settings", "policy"),
            f"does not go with a plan file; {plan_file} has a problem and controls of its own",
        )
        plan = Plan.load(plan_file)
        problem: Problem = plan.problem
        actor: Policy = OpenLoop(plan=plan)
    else:
        problem, actor = _problem(scenario, robots, model, obstacles, scenario_settings, seed), make_policy(policy)
    env = navigation_v0.parallel_env(problem=problem, control_noise_std=noise)
    episode = run_episode(env, actor, seed=seed)
    env.close()
    draw(problem, episode.trajectory, picture, animation)
    if not quiet:
        print_table("Execution", episode_rows(episode))
    if not episode.metrics["success"]:
        raise typer.Exit(1)


@app.command()
def warmup(quiet: Quiet = False) -> None:
    """Compile ahead what planning and the environments need, so that the next start is quick."""
    from d4orm_planners.commands.warmup import warm_up

    report = warm_up()
    if not quiet:
        typer.echo(
            f"{len(report.compiled)} kernels compiled, {len(report.loaded)} found in the cache, {report.seconds:.1f} s"
        )
        for folder in report.folders:
            typer.echo(f"cache {folder}")
    if not report.folders:
        raise ValueError("no cache folder can be written to; set NUMBA_CACHE_DIR to one that can")


@app.command()
def scenarios() -> None:
    """List the scenarios."""
    from d4orm_env.scenarios import describe_scenario, list_scenarios

    def described(name: str) -> str:
        try:
            return describe_scenario(name)
        except ValueError as error:  # an installed package offers it and cannot be imported
            return str(error)

    print_table("Scenarios", [(name, described(name)) for name in list_scenarios()])


@app.command()
def planners(
    name: Annotated[str | None, typer.Argument(help="List the settings of this one, with their defaults.")] = None,
) -> None:
    """List the planners and policies, or what --set can set of one."""
    from d4orm_planners.names import PLANNERS, POLICIES
    from d4orm_planners.registry import default_settings, describe_planner, describe_policy

    if name is not None:
        settings = default_settings(name).items()
        print_table(name, [(setting, str(value)) for setting, value in settings] or [("no settings", "")])
        return
    for title, table, describe in (("Planners", PLANNERS, describe_planner), ("Policies", POLICIES, describe_policy)):
        print_table(title, [(name, _or_error(describe, name)) for name in table])


def _or_error(describe: Callable[[str], str], name: str) -> str:
    """A description, or why there is none: what another package brings may be broken."""
    try:
        return describe(name)
    except ValueError as error:
        return f"unusable: {error}"


def _problem(
    scenario: str,
    robots: int | None,
    model: str | None,
    obstacles: int | None,
    settings: list[str] | None,
    seed: int,
) -> Problem:
    from d4orm_env.scenarios import load_problem, make_problem
    from d4orm_env.scenarios.problems import is_scenario_file

    if is_scenario_file(scenario):
        given = {"--robots": robots, "--model": model, "--obstacles": obstacles, "--scenario-set": settings}
        for option, value in given.items():
            if value is not None:
                shown = " ".join(value) if isinstance(value, list) else value
                raise ValueError(f"{option} {shown} does not go with a scenario file; change it in {scenario}")
        return load_problem(scenario)
    own = parse_settings(settings, "--scenario-set")
    for name, option in (
        ("num_robots", "robots"),
        ("seed", "seed"),
        ("model", "model"),
        ("num_obstacles", "obstacles"),
    ):
        if name in own:
            raise ValueError(f"--scenario-set {name} is said by --{option}; use that")
    return make_problem(scenario, num_robots=robots, seed=seed, model=model, num_obstacles=obstacles, **own)


def _solve(
    problem: Problem,
    planner: str,
    settings: dict[str, Any],
    seed: int,
    time_limit: float | None,
    max_iterations: int | None,
    quiet: bool,
) -> Plan:
    from d4orm_env.engine.choice import get_engine
    from d4orm_planners.commands.progress import solve_progress
    from d4orm_planners.commands.warmup import compile_for_planning
    from d4orm_planners.registry import make_planner

    chosen = make_planner(planner, **settings)
    if get_engine(chosen.config.engine).name == "cpu":
        compile_for_planning(
            problem.team.models,
            lambda: typer.echo("compiling, once per installation ...", err=True),
            drives=chosen.drives_straight,
        )
    limit = max_iterations if max_iterations is not None else chosen.config.max_iterations
    with solve_progress(planner, problem.num_robots, limit, enabled=not quiet) as progress:
        return chosen.solve(problem, seed=seed, time_limit=time_limit, max_iterations=max_iterations, callback=progress)


def _execute(plan: Plan, seed: int) -> Episode:
    from d4orm_env import navigation_v0, verify
    from d4orm_planners.episode import run_episode
    from d4orm_planners.policy import OpenLoop

    env = navigation_v0.parallel_env(problem=plan.problem)
    episode = run_episode(env, OpenLoop(plan=plan), seed=seed)
    env.close()
    report = verify(plan.problem, plan.controls)
    rows = [
        *episode_rows(episode),
        ("verified", "yes" if report.ok else "no: " + "; ".join(str(violation) for violation in report.violations[:3])),
        ("closest approach", f"{report.min_separation * 100:.1f} cm between surfaces"),
    ]
    print_table("Executed in the environment", rows)
    return episode


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit."""
    try:
        status = app(arguments, standalone_mode=False)
    except ClickException as error:
        status = _complain(error.format_message())
    except (ValueError, OSError, ImportError) as error:  # ImportError: an extra that is not installed
        status = _complain(_message(error))
    except (KeyboardInterrupt, typer.Abort):
        status = 130
    sys.exit(status if isinstance(status, int) else 0)


def _message(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'file'}: {error.strerror}"
    return str(error)


def _complain(message: str) -> int:
    line = " ".join(message.split())
    sys.stderr.write(f"d4orm: {line}{os.linesep}")
    return 2


if __name__ == "__main__":
    main()
