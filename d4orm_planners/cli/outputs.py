"""Output of commands, in print and in pictures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from d4orm_env.core.infeasibility import prove_infeasible
from d4orm_planners.base.escaping import one_line

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem
    from d4orm_planners.base.episode import Episode
    from d4orm_planners.base.plan import Plan


def episode_rows(episode: Episode) -> list[tuple[str, str]]:
    """Return the key figures of an episode."""
    metrics = episode.metrics
    return [
        ("success", "yes" if metrics["success"] else "no"),
        ("arrived", f"{metrics['arrived']:.0f}"),
        ("robots in contact", f"{metrics['collided']:.0f}"),
        ("travel time", f"{metrics['travel_time']:.2f} s"),
        ("makespan", f"{metrics['makespan']:.2f} s"),
        ("stretch", f"{episode.stretch:.2f}"),
    ]


def print_plan(plan: Plan) -> None:
    """Print how a plan was found and how good it is."""
    metrics = plan.metrics
    rows = [
        ("solved", "yes" if plan.solved else f"no ({plan.status})"),
        ("planning time", f"{plan.wall_time:.2f} s"),
        ("iterations", f"{plan.iterations}"),
        ("travel time", f"{metrics['travel_time']:.2f} s"),
        ("makespan", f"{metrics['makespan']:.2f} s"),
        ("stretch", f"{plan.stretch:.2f}"),
        ("reward", f"{metrics['reward']:.3f}"),
    ]
    if not plan.solved:
        rows.append(("not arrived", f"{plan.problem.num_robots - metrics['arrived']:.0f}"))
        rows.append(("too close", f"{metrics['margin_violated']:.0f}"))
    print_table(f"Plan by {plan.planner}, {plan.problem.num_robots} robots", rows)


def print_table(title: str, rows: list[tuple[str, str]]) -> None:
    """Rows without a header."""
    table = Table(title=Text(one_line(title)), title_justify="left", show_header=False)
    for row in rows:
        table.add_row(*(Text(one_line(cell)) for cell in row))
    Console().print(table)


def require_solved(plan: Plan) -> None:
    """Say why, and end with status 1, if a plan is no solution."""
    if not plan.solved:
        ended = f"no solution found ({plan.status.replace('_', ' ')} after {plan.iterations} iterations)"
        _tell_reasons("there is no solution" if plan.status == "infeasible" else ended, plan.failures)
        raise typer.Exit(1)


def require_success(episode: Episode, problem: Problem) -> None:
    """End with status 1 if an episode is none, and say so if nothing solves the problem."""
    if not episode.metrics["success"]:
        if proofs := prove_infeasible(problem):
            _tell_reasons("there is no solution", {f"robot_{robot}": proof for robot, proof in sorted(proofs.items())})
        raise typer.Exit(1)


def _tell_reasons(what: str, reasons: Mapping[str, str]) -> None:
    typer.echo(what, err=True)
    for robot, reason in reasons.items():
        typer.echo(f"  {robot} {reason}", err=True)
