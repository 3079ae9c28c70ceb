"""Work of a library that may take too long to wait for its end."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from threading import Event
from typing import TypeVar

Result = TypeVar("Result")

LOOK = 0.01
"""Period of asking the caller whether to stop [s]."""

GRACE = 0.05
"""Time that work which was asked to end is waited for [s]."""


def run_or_abandon(work: Callable[[Callable[[], bool]], Result], should_stop: Callable[[], bool]) -> Result | None:
    """Run in a thread of its own what lets other threads run, and leave it to itself if it does not end in time.

    Ctrl-C reaches the caller at once. What was abandoned ends when it next asks; the process waits for that.

    Args:
        work: Called with a function that says whether to end, to be asked as often as possible.
        should_stop: Asked every hundredth of a second.

    Returns:
        What the work returned, or ``None`` if it was abandoned.
    """
    ending = Event()
    pool = ThreadPoolExecutor(1)
    try:
        future = pool.submit(work, ending.is_set)
        while not should_stop():
            if wait([future], LOOK).done:
                return future.result()
        ending.set()
        return future.result() if wait([future], GRACE).done else None
    finally:
        ending.set()
        pool.shutdown(wait=False)
