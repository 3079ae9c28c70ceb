"""Jobs on a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import count

from d4orm_env.core.errors import describe
from d4orm_planners.d_d4orm.ray_connection import RayConnection
from d4orm_planners.evaluation.pool import JobEvent, WorkerLost, WorkerMessage
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.trials import Job, run_job

QUEUED = 2
"""Jobs under way per core of the cluster: one that runs, and one that need not be waited for."""


class RayPool:
    """Tasks on a Ray cluster, one per job and core, never tried again by Ray itself.

    Args:
        address: ``"auto"`` for the cluster that this machine belongs to, an address, or ``"local"`` for a new one on
            this machine.
        size: Jobs under way at most; by default twice as many as the cluster has cores.

    Raises:
        ValueError: If the address is none.
        ImportError: If Ray is not installed.
        ConnectionError: If there is no cluster.
    """

    def __init__(self, address: str, size: int | None = None) -> None:
        self._connection = RayConnection(address, "running on a cluster")
        self._ray = self._connection.ray
        cores = int(self._ray.cluster_resources().get("CPU", 1))
        self._size = size or QUEUED * max(cores, 1)
        # A generator's results come back one by one, so that what is done is not lost with the process.
        self._task = self._ray.remote(num_cpus=1, max_retries=0)(_work_remotely)
        self._jobs: dict[Iterator[object], int] = {}
        self._tickets = count()

    def free(self) -> bool:
        return len(self._jobs) < self._size

    def start(self, job: Job) -> int:
        ticket = next(self._tickets)
        self._jobs[self._task.remote(job)] = ticket
        return ticket

    def wait(self, timeout: float | None) -> list[WorkerMessage]:
        running = list(self._jobs)
        ready, _ = self._ray.wait(running, num_returns=1, timeout=timeout)
        return [WorkerMessage(self._jobs[task], self._next(task)) for task in ready]

    def stop(self, ticket: int) -> None:
        task = next(task for task, number in self._jobs.items() if number == ticket)
        del self._jobs[task]
        self._ray.cancel(task, force=True)

    def close(self) -> None:
        for task in self._jobs:
            self._ray.cancel(task, force=True)
        self._connection.close()

    def _next(self, task: Iterator[object]) -> Trial | JobEvent | WorkerLost:
        try:
            content: Trial | JobEvent = self._ray.get(next(task))
        except (self._ray.exceptions.RayError, StopIteration) as error:
            del self._jobs[task]
            return WorkerLost(f"ChildProcessError: the worker was lost ({describe(error)})")
        if content is JobEvent.ENDED:
            del self._jobs[task]
        return content


def _work_remotely(job: Job) -> Iterator[Trial | JobEvent]:
    """Run a job on one core of some machine."""
    os.environ.update(D4ORM_NUM_THREADS="1", OMP_NUM_THREADS="1")
    yield JobEvent.BEGUN
    yield from run_job(job)
    yield JobEvent.ENDED
