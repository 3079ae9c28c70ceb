"""Output of commands: where files go, pictures, tables, and lines of progress."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text
from typer import Option

from d4orm_env import render
from d4orm_env.core.files import make_folder, target_of
from d4orm_env.core.infeasibility import prove_infeasible
from d4orm_env.core.problem import Problem
from d4orm_env.core.summary_line import count
from d4orm_env.core.trajectory import DisturbanceEvents, Trajectory
from d4orm_planners.base.display import one_line
from d4orm_planners.base.plan import IterationRecord, Plan
from d4orm_planners.cli.options import Quiet

if TYPE_CHECKING:
    from d4orm_planners.base.episode import Episode

LOG_INTERVAL = 60.0  #: Seconds between lines of progress where there is no terminal
MOST_REASONS = 20  #: Robots of which it is told why they fail


@contextmanager
def output_folder(folder: Path) -> Iterator[None]:
    """Make a folder, unless it is there; what was made is removed again where nothing was written to it."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    make_folder(folder)
    check_writable(folder)
    try:
        yield
    finally:
        with suppress(OSError):  # it is not empty
            for path in made:
                path.rmdir()


def check_writable(folder: Path) -> None:
    """Find out whether files can be made in a folder."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or "refused"
        raise ValueError(f"folder {str(folder)!r} cannot be written to ({reason}); choose another") from None


def check_target(path: Path | None, suffixes: tuple[str, ...]) -> None:
    """Find out before planning whether a file can be written."""
    if path is None:
        return
    if path.suffix not in suffixes:
        raise ValueError(f"output file {str(path)!r} must end in {' or '.join(suffixes)}")
    check_writable(target_of(path).parent)


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """Options on pictures, and on how much to say."""

    picture: Annotated[Path | None, Option(help="Picture to write: .png, .svg or .pdf.")] = None
    animation: Annotated[Path | None, Option(help="Animation to write: .gif or .mp4.")] = None
    quiet: Quiet = False

    def check_pictures(self) -> None:
        """Raise ``ValueError`` if they cannot be written."""
        check_target(self.picture, (".png", ".svg", ".pdf"))
        check_target(self.animation, (".gif", ".mp4"))
        if self.animation is not None:
            render.check_ffmpeg(self.animation)

    def draw(self, problem: Problem, trajectory: Trajectory, events: DisturbanceEvents | None = None) -> None:
        """Write the pictures that were asked for."""
        if self.picture is not None:
            render.save_picture(problem, trajectory, self.picture, events=events)
        if self.animation is not None:
            render.save_animation(problem, trajectory, self.animation, events=events)


def episode_rows(episode: Episode) -> list[tuple[str, str]]:
    metrics = episode.metrics
    return [
        ("success", "yes" if metrics["success"] else "no"),
        ("arrived", f"{metrics['arrived']:.0f}"),
        ("robots in contact", f"{metrics['collided']:.0f}"),
        ("travel time", f"{metrics['travel_time']:.2f} s"),
        ("makespan", f"{metrics['makespan']:.2f} s"),
        ("stretch", _finite(episode.stretch)),
    ]


def _finite(stretch: float) -> str:
    """A stretch, or a dash where none arrived, or the discs round footprints have no path."""
    return f"{stretch:.2f}" if math.isfinite(stretch) else "-"


def print_plan(plan: Plan) -> None:
    metrics = plan.metrics
    rows = [
        ("solved", "yes" if plan.solved else f"no ({plan.status})"),
        ("planning time", f"{plan.wall_time:.2f} s"),
        ("iterations", f"{plan.iterations}"),
        ("travel time", f"{metrics['travel_time']:.2f} s"),
        ("makespan", f"{metrics['makespan']:.2f} s"),
        ("stretch", _finite(plan.stretch)),
        ("reward", f"{metrics['reward']:.3f}"),
    ]
    if not plan.solved:
        rows.append(("not arrived", f"{plan.problem.num_robots - metrics['arrived']:.0f}"))
        rows.append(("too close", f"{metrics['margin_violated']:.0f}"))
    print_table(f"Plan by {plan.planner}, {plan.problem.num_robots} robots", rows)


def print_table(title: str, rows: list[tuple[str, str]]) -> None:
    table = Table(title=Text(one_line(title)), title_justify="left", show_header=False)
    for row in rows:
        table.add_row(*(Text(one_line(cell)) for cell in row))
    Console().print(table)


def require_solved(plan: Plan) -> None:
    """Say why, and end with status 1, if a plan is no solution."""
    if not plan.solved:
        ended = f"no solution found ({plan.status.replace('_', ' ')} after {count(plan.iterations, 'iteration')})"
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
    for robot, reason in islice(reasons.items(), MOST_REASONS):
        typer.echo(f"  {robot} {reason}", err=True)
    if (others := len(reasons) - MOST_REASONS) > 0:
        typer.echo(f"  and {count(others, 'other robot')}; Plan.failures has all", err=True)


@contextmanager
def solve_progress(
    planner: str, num_robots: int, max_iterations: int, enabled: bool = True
) -> Iterator[Callable[[IterationRecord], None]]:
    """Show iteration, reward, robots failing and time; gives the callback of a solve."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("iteration {task.completed}/{task.total}  {task.fields[detail]}"),
    )
    with _live_line(columns, enabled) as line:
        task = line.add_task(planner, total=max_iterations, detail="compiling and sampling ...")

        def show(record: IterationRecord) -> None:
            failing = "solved" if record.solved else f"{record.num_failed} of {num_robots} robots failing"
            line.update(task, completed=record.iteration, detail=f"reward {record.reward:.3f}  {failing}")

        yield show


@contextmanager
def parts_progress(enabled: bool = True) -> Iterator[Callable[[str, int, int], None]]:
    """Show what is under way, how much is done, and the time; gives what is called with these at every part.

    Where stderr is no terminal, a line a minute says so.
    """
    columns = BarColumn(bar_width=24), TextColumn("{task.completed}/{task.total}  {task.description}")
    begin = told = time.monotonic()
    with _live_line(columns, enabled) as line:
        task = line.add_task("", total=None)

        def show(what: str, done: int, total: int) -> None:
            nonlocal told
            line.update(task, description=what, completed=done, total=total)
            if enabled and line.disable and time.monotonic() - told >= LOG_INTERVAL:
                told = time.monotonic()
                typer.echo(f"{done} of {total}, {told - begin:.0f} s: {what}", err=True)

        yield show


@contextmanager
def resumable(folder: Path, what: str, quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """:func:`parts_progress` of what is written to a folder and goes on after Ctrl-C where it was; says so then."""
    try:
        with output_folder(folder), parts_progress(not quiet) as progress:
            yield progress
    except KeyboardInterrupt:
        typer.echo(f"stopped; {what} are kept in {folder}, the same command goes on from there", err=True)
        raise


@contextmanager
def _live_line(columns: Iterable[ProgressColumn], enabled: bool) -> Iterator[Progress]:
    """A progress line on stderr: live on a terminal, and nothing at all elsewhere."""
    console = Console(stderr=True)
    hidden = not (enabled and console.is_terminal)
    with Progress(*columns, TimeElapsedColumn(), console=console, disable=hidden, transient=True) as line:
        yield line


def tell_results(text: str, written: Iterable[Path]) -> None:
    typer.echo(text)
    tell_written(*written)


def tell_written(*paths: Path | None, quiet: bool = False) -> None:
    for path in paths:
        if path is not None and not quiet:
            typer.echo(f"wrote {path}")
