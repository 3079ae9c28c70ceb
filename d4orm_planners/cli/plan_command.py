"""``d4orm plan``: a plan for one problem."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from d4orm_planners.base.planner_registry import RECOMMENDED, make_planner
from d4orm_planners.cli.arguments import check_target, parse_settings, refuse_options
from d4orm_planners.cli.common_options import Engine, PictureOptions, ProblemOptions, TimeLimit
from d4orm_planners.cli.dataclass_options import takes
from d4orm_planners.cli.outputs import print_plan, require_solved
from d4orm_planners.cli.progress import solve_progress
from d4orm_planners.cli.warmup import compile_for_planning
from d4orm_planners.engine.select import get_sampling_engine

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem
    from d4orm_planners.base.planner import Callback, Planner


@dataclass(frozen=True, kw_only=True)
class PlanOptions(PictureOptions, ProblemOptions):
    """Options on the planner, and on what to write."""

    planner: Annotated[
        str | None,
        typer.Option(
            "--planner",
            "-p",
            help="Planner (see `d4orm planners`), or package.module:Name.",
            show_default="that of make_planner()",
        ),
    ] = None
    preset: Annotated[
        str | None, typer.Option("--preset", help="`paper`, `authors` or `tuned`; see `d4orm planners NAME`.")
    ] = None
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="A planner setting, as num_samples=512; repeatable.")
    ] = None
    engine: Engine = "auto"
    time_limit: TimeLimit = None
    max_iterations: Annotated[int | None, typer.Option("--max-iterations", help="Iterations for planning.")] = None
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Plan file (.npz) or replay (.html) to write.")] = None


@takes(PlanOptions)
def plan(options: PlanOptions) -> None:
    """Plan for a team; write the plan, a picture or an animation."""
    check_target(options.out, (".npz", ".html"))
    options.check_pictures()
    chosen = parse_settings(options.settings)
    for name in {"engine", "preset", "max_iterations"}.intersection(chosen):
        refuse_options(options.context, (name,), f"and --set {name} say the same; give one of them")
    problem = options.problem()
    planner = make_planner(
        RECOMMENDED if options.planner is None else options.planner,
        **{"engine": options.engine, "preset": options.preset, **chosen},
    )
    with solving(planner, problem, options.max_iterations, options.quiet) as callback:
        found = planner.solve(problem, options.seed, options.time_limit, options.max_iterations, callback)
    if not options.quiet:
        print_plan(found)
    if options.out is not None:
        (found.to_html if options.out.suffix == ".html" else found.save)(options.out)
    options.draw(problem, found.trajectory)
    for path in (options.out, options.picture, options.animation):
        if path is not None and not options.quiet:
            typer.echo(f"wrote {path}")
    require_solved(found)


def solving(
    planner: Planner, problem: Problem, max_iterations: int | None = None, quiet: bool = False
) -> AbstractContextManager[Callback]:
    """Compile what planning needs, and show a live line meanwhile; gives the callback of the solve."""
    if get_sampling_engine(planner.config.engine).name == "cpu":
        compile_for_planning(
            problem.team.models,
            lambda: typer.echo("compiling, once per installation ...", err=True),
            driver=planner.name if planner.drives_straight else "",
            walls=len(problem.arrays.boxes) + len(problem.arrays.triangles) > 0,
        )
    limit = planner.config.max_iterations if max_iterations is None else max_iterations
    return solve_progress(planner.name, problem.num_robots, limit, enabled=not quiet)
