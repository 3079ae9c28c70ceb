"""``d4orm export``: the setpoints of a plan for robots to execute."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from d4orm_planners.base.plan import Plan
from d4orm_planners.cli.arguments import output_folder
from d4orm_planners.cli.outputs import print_table


def export(
    plan_file: Annotated[Path, typer.Argument(help="Plan to export, .npz.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")],
    format: Annotated[
        str, typer.Option("--format", "-f", help="csv, crazyswarm2, rosbag2 or mcap.", show_default=True)
    ] = "csv",
    rate: Annotated[float, typer.Option("--rate", help="Setpoints per second.")] = 100.0,
    height: Annotated[float, typer.Option("--height", help="z of a team that moves in the plane [m].")] = 0.0,
    max_acceleration: Annotated[
        float | None,
        typer.Option("--max-acceleration", help="Limit of the setpoints [m/s^2].", show_default="the team's"),
    ] = None,
    max_jerk: Annotated[
        float | None, typer.Option("--max-jerk", help="Limit of the setpoints [m/s^3].", show_default="none")
    ] = None,
) -> None:
    """Smooth a plan, verify it again, and write setpoints for robots to execute."""
    plan = Plan.load(plan_file)
    with output_folder(out):
        report = plan.export(
            format, out, rate=rate, height=height, max_acceleration=max_acceleration, max_jerk=max_jerk
        )
    rows = [
        ("files", f"{len(report.files)} in {out}"),
        ("duration", f"{report.duration:.2f} s, {report.stretch:.2f} times the plan's"),
        ("least gap between robots", f"{report.min_separation:.3f} m"),
        ("least gap to obstacles", f"{report.min_clearance:.3f} m"),
        ("deviation from the plan", f"{report.deviation:.3f} m"),
    ]
    if report.pieces is not None:
        rows.append(("polynomials a robot", f"{report.pieces}, {report.num_bytes} bytes of 4096"))
    print_table(f"{format} of {plan.title}", rows)
