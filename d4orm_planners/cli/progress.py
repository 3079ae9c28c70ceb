"""Messages of a command: a live line on the terminal while it works, and in the end what it found and wrote."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, TextColumn, TimeElapsedColumn

from d4orm_planners.base.plan import IterationRecord


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
    """Show what is under way, how much is done, and the time; gives what is called with these at every part."""
    columns = BarColumn(bar_width=24), TextColumn("{task.completed}/{task.total}  {task.description}")
    with _live_line(columns, enabled) as line:
        task = line.add_task("", total=None)
        yield lambda what, done, total: line.update(task, description=what, completed=done, total=total)


@contextmanager
def resumable(kept: str, enabled: bool) -> Iterator[Callable[[str, int, int], None]]:
    """:func:`parts_progress` of what goes on after Ctrl-C where it was; says so then.

    Args:
        kept: Place of the results, for people.
        enabled: Whether to show progress.
    """
    try:
        with parts_progress(enabled) as progress:
            yield progress
    except KeyboardInterrupt:
        typer.echo(f"stopped; {kept}, the same command goes on from there", err=True)
        raise


@contextmanager
def _live_line(columns: Iterable[ProgressColumn], enabled: bool) -> Iterator[Progress]:
    """A progress line on stderr: live on a terminal, and nothing at all elsewhere."""
    console = Console(stderr=True)
    hidden = not (enabled and console.is_terminal)
    with Progress(*columns, TimeElapsedColumn(), console=console, disable=hidden, transient=True) as line:
        yield line


def tell_results(text: str, written: Iterable[Path]) -> None:
    """Print tables, and which files were written."""
    typer.echo(text)
    for path in written:
        typer.echo(f"wrote {path}")
