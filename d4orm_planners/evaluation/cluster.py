"""Running jobs on a Ray cluster. Results come back to this process, which alone writes the store."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from itertools import count
from typing import Any

from d4orm_planners.evaluation.schedule import Lost, Message, Sign
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.trials import Job, describe_error, run_job

QUEUED = 2
"""Jobs under way per core of the cluster: one that runs, and one that need not be waited for."""

PATIENCE = 10.0
"""Seconds to wait for the head of a cluster to answer."""


class RayCrew:
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
        self._ray: Any = _import_ray()
        self._owner = not self._ray.is_initialized()
        host, port = _host_and_port(address)
        try:
            if host:
                # Ray itself tries for minutes.
                socket.create_connection((host, port), PATIENCE).close()
            if self._owner:
                self._ray.init(address=address, log_to_driver=False, include_dashboard=False)
            cores = int(self._ray.cluster_resources().get("CPU", 1))
        except Exception as error:  # Ray raises errors of many kinds
            raise ConnectionError(
                f"Ray cluster {address!r} cannot be reached ({describe_error(error)}); "
                "start one with `ray start --head`, or leave the address out to run on this machine"
            ) from error
        self._size = size or QUEUED * max(cores, 1)
        # A generator's results come back one by one, so that what is done is not lost with the process.
        self._task = self._ray.remote(num_cpus=1, max_retries=0)(_work)
        self._jobs: dict[Any, int] = {}
        self._tickets = count()

    def free(self) -> bool:
        return len(self._jobs) < self._size

    def start(self, job: Job) -> int:
        ticket = next(self._tickets)
        self._jobs[self._task.remote(job)] = ticket
        return ticket

    def wait(self, timeout: float | None) -> list[Message]:
        running = list(self._jobs)
        ready, _ = self._ray.wait(running, num_returns=1, timeout=timeout)
        return [Message(self._jobs[task], self._next(task)) for task in ready]

    def stop(self, ticket: int) -> None:
        task = next(task for task, number in self._jobs.items() if number == ticket)
        del self._jobs[task]
        self._ray.cancel(task, force=True)

    def close(self) -> None:
        for task in self._jobs:
            self._ray.cancel(task, force=True)
        if self._owner:
            self._ray.shutdown()

    def _next(self, task: Any) -> Trial | Sign | Lost:
        try:
            content: Trial | Sign = self._ray.get(next(task))
        except (self._ray.exceptions.RayError, StopIteration) as error:
            del self._jobs[task]
            return Lost(f"ChildProcessError: the worker was lost ({describe_error(error)})")
        if content is Sign.ENDED:
            del self._jobs[task]
        return content


def _work(job: Job) -> Iterator[Trial | Sign]:
    """Run a job on one core of some machine."""
    os.environ.update(D4ORM_NUM_THREADS="1", OMP_NUM_THREADS="1")
    yield Sign.BEGUN
    yield from run_job(job)
    yield Sign.ENDED


def _host_and_port(address: str) -> tuple[str, int]:
    """What an address names; nothing for one that is no ``host:port``, with ``ray://`` before it or without."""
    if address in ("auto", "local"):
        return "", 0
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(f"Ray address {address!r} is neither auto, nor local, nor of the form host:port")
    return host.strip("[]"), int(port)


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise ImportError(
            'running on a cluster needs ray; install it with pip install "d4orm-env[distributed]"'
        ) from error
    return ray
