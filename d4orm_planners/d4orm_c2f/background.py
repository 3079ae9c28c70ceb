"""Background work of a controller: a job at a time in a thread of its own."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

Result = TypeVar("Result")


class Background(Generic[Result]):
    """A job at a time in a thread of its own.

    Args:
        yielding: Whether other threads go first, where threads have priorities of their own.
    """

    def __init__(self, yielding: bool = False) -> None:
        self._initializer = _yield_to_others if yielding and sys.platform == "linux" else None
        self._pool: ThreadPoolExecutor | None = None
        self._job: Future[Result] | None = None

    def start(self, work: Callable[[], Result]) -> None:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="d4orm-c2f", initializer=self._initializer)
        self._job = self._pool.submit(work)

    def result(self) -> tuple[bool, Result | None]:
        """True if no job is under way, and the result of the last one, which is given once."""
        if self._job is None:
            return True, None
        if not self._job.done():
            return False, None
        job, self._job = self._job, None
        return True, job.result()

    def run(self, work: Callable[[], Result], timeout: float) -> Result | None:
        """Return the result of the work within the time [s], or ``None``. What is late goes on, and is thrown away."""
        end = time.perf_counter() + timeout
        if timeout <= 0:
            return None
        try:
            if self._job is not None:
                self._job.result(timeout)
            self.start(work)
            assert self._job is not None
            return self._job.result(max(end - time.perf_counter(), 0))
        except TimeoutError:
            return None

    def forget(self) -> None:
        """Wait for what is under way and throw it away."""
        if self._job is not None:
            self._job.exception()
            self._job = None


def _yield_to_others() -> None:
    """Lower the priority of the calling thread; on Linux that is what a thread's number stands for here."""
    thread = threading.get_native_id()
    # Where all of the process yields more than that, only root could take some of it back.
    os.setpriority(os.PRIO_PROCESS, thread, max(10, os.getpriority(os.PRIO_PROCESS, thread)))
