"""``d4orm plan`` and ``d4orm export``: a plan for one problem, and what robots execute of it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from typer import Argument, Option

from d4orm_env.core.problem import Problem
from d4orm_env.core.registry import load_reference
from d4orm_planners.base.plan import Plan
from d4orm_planners.base.planner import Callback, Planner
from d4orm_planners.base.planner_registry import RECOMMENDED, make_planner
from d4orm_planners.cli.options import (
    Engine,
    ProblemOptions,
    Settings,
    TimeLimit,
    parse_settings,
    refuse_options,
    takes,
)
from d4orm_planners.cli.outputs import (
    PictureOptions,
    check_target,
    output_folder,
    print_plan,
    print_table,
    require_solved,
    solve_progress,
    tell_written,
)
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.hybrid.compile_ahead import compile_for_planning


@dataclass(frozen=True, kw_only=True)
class PlanOptions(PictureOptions, ProblemOptions):
    """Options on the planner, and on what to write."""

    planner: Annotated[
        str | None,
        Option(
            "--planner",
            "-p",
            help="Planner (see `d4orm planners`), or package.module:Name.",
            show_default="that of make_planner()",
        ),
    ] = None
    preset: Annotated[str | None, Option(help="`paper`, `authors` or `tuned`; see `d4orm planners NAME`.")] = None
    settings: Settings = None
    engine: Engine = "auto"
    time_limit: TimeLimit = None
    max_iterations: Annotated[int | None, Option(help="Iterations for planning.")] = None
    out: Annotated[Path | None, Option("--out", "-o", help="Plan file (.npz) or replay (.html) to write.")] = None


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
    tell_written(options.out, options.picture, options.animation, quiet=options.quiet)
    require_solved(found)


def solving(
    planner: Planner, problem: Problem, max_iterations: int | None = None, quiet: bool = False
) -> AbstractContextManager[Callback]:
    """Compile what planning needs, and show a live line meanwhile; gives the callback of the solve."""
    if get_sampling_engine(planner.config.engine).name == "cpu":
        compile_for_planning(planner, problem, lambda: typer.echo("compiling, once per robot model ...", err=True))
    limit = planner.config.max_iterations if max_iterations is None else max_iterations
    return solve_progress(planner.name, problem.num_robots, limit, enabled=not quiet)


def read_plan(path: Path, scenario: str | None) -> Plan:
    """The plan of a file, whose robots the module of a user's scenario, if one is given, registers."""
    if scenario is not None:
        load_reference(scenario)
    return Plan.load(path)


def export(
    plan_file: Annotated[Path, Argument(help="Plan to export, .npz.")],
    out: Annotated[Path, Option("--out", "-o", help="Folder for the files.")],
    format: Annotated[
        str, Option("--format", "-f", help="csv, crazyswarm2, rosbag2, mcap.", show_default=True)
    ] = "csv",
    rate: Annotated[float | None, Option(help="Setpoints a second; polynomials have none.", show_default="100")] = None,
    height: Annotated[float, Option(help="z of a team that moves in the plane [m].")] = 0.0,
    max_acceleration: Annotated[
        float | None, Option(help="Limit of the setpoints [m/s^2].", show_default="the team's")
    ] = None,
    scenario: Annotated[
        str | None, Option("--scenario", "-s", help="package.module:function whose module registers its robots.")
    ] = None,
    max_jerk: Annotated[float | None, Option(help="Limit of the setpoints [m/s^3].", show_default="none")] = None,
) -> None:
    """Smooth a plan, verify it again, and write setpoints for robots to execute."""
    if rate is not None and format == "crazyswarm2":
        raise ValueError(f"--rate {rate:g} would count for nothing: {format} takes polynomials; leave it out")
    plan, rates = read_plan(plan_file, scenario), {} if rate is None else {"rate": rate}
    with output_folder(out):
        report = plan.export(format, out, height=height, max_acceleration=max_acceleration, max_jerk=max_jerk, **rates)
    gaps = {"least gap between robots": report.min_separation, "least gap to obstacles": report.min_clearance}
    rows = [
        ("files", f"{len(report.files)} in {out}"),
        ("duration", f"{report.duration:.2f} s, {report.stretch:.2f} times the plan's"),
        *((name, f"{gap:.3f} m") for name, gap in gaps.items() if gap < np.inf),
        ("deviation from the plan", f"{report.deviation:.3f} m"),
    ]
    if plan.problem.dimension == 3:
        rows.append(("heights", "{:.2f} to {:.2f} m".format(*report.heights)))
    if report.min_overhead < np.inf:
        rows.append(("least height above another", f"{report.min_overhead:.3f} m; mind the downwash"))
    if report.pieces is not None:
        rows.append(("polynomials a robot", f"{report.pieces}, {report.num_bytes} bytes of 4096"))
    print_table(f"{format} of {plan.title}", rows)
