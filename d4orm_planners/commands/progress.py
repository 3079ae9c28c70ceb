"""What a command says: a live line on the terminal while it works, and in the end what it found and wrote."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, TextColumn, TimeElapsedColumn

from d4orm_planners.plan import IterationRecord


class LiveProgress:
    """A progress line on stderr: live on a terminal, and nothing at all elsewhere."""

    def __init__(self, *columns: ProgressColumn, enabled: bool) -> None:
        console = Console(stderr=True)
        hidden = not (enabled and console.is_terminal)
        self._progress = Progress(*columns, TimeElapsedColumn(), console=console, disable=hidden, transient=True)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()


class SolveProgress(LiveProgress):
    """Shows iteration, reward, robots failing and time; the callback of a solve."""

    def __init__(self, planner: str, num_robots: int, max_iterations: int, enabled: bool = True) -> None:
        super().__init__(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("iteration {task.completed}/{task.total}  {task.fields[detail]}"),
            enabled=enabled,
        )
        self._num_robots = num_robots
        self._task = self._progress.add_task(planner, total=max_iterations, detail="compiling and sampling ...")

    def update(self, record: IterationRecord) -> Any:
        """Show one iteration."""
        failing = "solved" if record.solved else f"{record.num_failed} of {self._num_robots} robots failing"
        detail = f"reward {record.reward:.3f}  {failing}"
        self._progress.update(self._task, completed=record.iteration, detail=detail)


class PartsProgress(LiveProgress):
    """Shows what is under way, how much is done, and the time, while a list of measurements is worked off."""

    def __init__(self, enabled: bool = True) -> None:
        super().__init__(
            BarColumn(bar_width=24), TextColumn("{task.completed}/{task.total}  {task.description}"), enabled=enabled
        )
        self._task = self._progress.add_task("", total=None)

    def update(self, what: str, done: int, total: int) -> None:
        """Say what begins now, after how many of how many."""
        self._progress.update(self._task, description=what, completed=done, total=total)


@contextmanager
def resumable(kept: str, enabled: bool) -> Iterator[PartsProgress]:
    """Show progress of what goes on after Ctrl-C where it was, and say so then.

    Args:
        kept: What is kept where, for people.
        enabled: Whether to show progress.
    """
    try:
        with PartsProgress(enabled=enabled) as progress:
            yield progress
    except KeyboardInterrupt:
        typer.echo(f"stopped; {kept}, the same command goes on from there", err=True)
        raise


def tell_results(text: str, written: Iterable[Path]) -> None:
    """Print tables, and which files were written."""
    typer.echo(text)
    for path in written:
        typer.echo(f"wrote {path}")
