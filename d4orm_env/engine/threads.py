"""A few threads that share the parts of one kernel call.

numba's own parallel loops need a threading layer that other threads may enter too, which is not there on every
platform. Kernels that release the interpreter's lock need no more than this.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numpy as np


def available_cores() -> int:
    """Cores this process may use; ``D4ORM_NUM_THREADS`` overrides it.

    Raises:
        ValueError: If ``D4ORM_NUM_THREADS`` is not a positive whole number.
    """
    wanted = os.environ.get("D4ORM_NUM_THREADS")
    if wanted is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not wanted.isdigit() or int(wanted) < 1:
        raise ValueError(f"D4ORM_NUM_THREADS is {wanted!r}; it must be a positive whole number")
    return int(wanted)


@lru_cache(maxsize=8)
def _pool(num_threads: int, process: int) -> ThreadPoolExecutor:
    """Shared by all engines of a process; a forked child gets its own."""
    return ThreadPoolExecutor(num_threads, thread_name_prefix="d4orm")


class Threads:
    """Splits a range over threads; the calling thread takes the first part."""

    def __init__(self, num_threads: int) -> None:
        self.num_threads = num_threads

    def over(self, count: int, work: Callable[[Any], None]) -> None:
        """Call ``work(array([first, last]))`` on parts that together make up ``range(count)``, and wait for all."""
        parts = min(self.num_threads, count)
        edges = np.array([count * part // parts for part in range(parts + 1)])
        if parts == 1:
            work(edges)
            return
        # Engines that share the cores, each in a thread of its own, share this pool too.
        pool = _pool(max(self.num_threads, available_cores()) - 1, os.getpid())
        futures = [pool.submit(work, edges[i : i + 2]) for i in range(1, parts)]
        work(edges[:2])
        for future in futures:
            future.result()
