"""Wall time of a solve, without the time spent compiling."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Wall time since it was made, what was left out not counted."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._paused = 0.0
        self._paused_since: float | None = None

    @property
    def elapsed(self) -> float:
        """Seconds so far."""
        return time.perf_counter() - self._start - self._paused

    @property
    def paused_seconds(self) -> float:
        """Seconds left out so far, those of a pause that lasts included; other threads may look."""
        since = self._paused_since
        return self._paused if since is None else self._paused + time.perf_counter() - since

    def leave_out(self, seconds: float) -> None:
        """Leave out some seconds of the time so far."""
        self._paused += seconds

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Leave the time of the block out."""
        begin = self._paused_since = time.perf_counter()
        try:
            yield
        finally:
            self._paused_since = None
            self._paused += time.perf_counter() - begin
