"""A few threads that share the parts of one kernel call.

numba's own parallel loops need a threading layer that other threads may enter too, which is not there on every
platform. Kernels that release the interpreter's lock need no more than this.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import lru_cache
from queue import SimpleQueue
from threading import Thread, local
from typing import TypeAlias

import numpy as np

from d4orm_env.core.arrays import IntArray

_calling = local()


def keep_to_one_core() -> None:
    """Let the calling thread do by itself, from now on, what it would share with others."""
    _calling.alone = True


def keeps_to_one_core() -> bool:
    """Check whether the calling thread does."""
    return getattr(_calling, "alone", False)


def available_cores() -> int:
    """Cores the calling thread may use; ``D4ORM_NUM_THREADS`` overrides what the process may."""
    if keeps_to_one_core():
        return 1
    wanted = os.environ.get("D4ORM_NUM_THREADS")
    if wanted is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not wanted.isdigit() or int(wanted) < 1:
        raise ValueError(f"D4ORM_NUM_THREADS is {wanted!r}; it must be a positive whole number")
    return int(wanted)


Task: TypeAlias = tuple[Callable[[IntArray], None], IntArray, SimpleQueue[BaseException | None]]
"""A function, its part of the work, and the queue to report on: that it is done, or the exception."""


@lru_cache(maxsize=8)
def _queue(num_threads: int, process: int) -> SimpleQueue[Task]:
    """Return the work queue of the threads that all engines of a process share; a forked child gets its own.

    A denoising step hands out work twice, and an executor takes twice as long to.
    """
    todo: SimpleQueue[Task] = SimpleQueue()
    for _ in range(num_threads):
        Thread(target=_work, args=(todo,), name="d4orm", daemon=True).start()
    return todo


def _work(todo: SimpleQueue[Task]) -> None:
    keep_to_one_core()  # who handed work on and waited for it here might wait for ever
    while True:
        work, part, done = todo.get()
        error = None
        try:
            work(part)
        except BaseException as raised:
            # Whoever waits raises it.
            error = raised
        done.put(error)
        # Waiting keeps nothing alive.
        del work, part, done, error


class Threads:
    """Splits a range over threads; the calling thread takes the first part."""

    def __init__(self, num_threads: int) -> None:
        self.num_threads = num_threads

    def over(self, count: int, work: Callable[[IntArray], None]) -> None:
        """Call ``work(array([first, last]))`` on parts that together make up ``range(count)``, and wait for all."""
        parts = 1 if keeps_to_one_core() else min(self.num_threads, count)
        if parts <= 1:
            work(np.array((0, count)))
            return
        edges = np.array([count * part // parts for part in range(parts + 1)])
        # Engines that share the cores, each in a thread of its own, share these threads too.
        todo = _queue(max(self.num_threads, available_cores()) - 1, os.getpid())
        done: SimpleQueue[BaseException | None] = SimpleQueue()
        for i in range(1, parts):
            todo.put((work, edges[i : i + 2], done))
        work(edges[:2])
        for error in [done.get() for _ in range(1, parts)]:
            if error is not None:
                raise error
