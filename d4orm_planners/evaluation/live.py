"""A live bar on the terminal while a list of measurements is worked off."""

from __future__ import annotations

from rich.progress import BarColumn, TextColumn

from d4orm_planners.progress import LiveProgress


class PartsProgress(LiveProgress):
    """Shows what is under way, how much is done, and the time."""

    def __init__(self, enabled: bool = True) -> None:
        super().__init__(
            BarColumn(bar_width=24), TextColumn("{task.completed}/{task.total}  {task.description}"), enabled=enabled
        )
        self._task = self._progress.add_task("", total=None)

    def update(self, what: str, done: int, total: int) -> None:
        """Say what begins now, after how many of how many."""
        self._progress.update(self._task, description=what, completed=done, total=total)
