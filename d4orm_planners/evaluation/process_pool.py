"""Pools of processes that can be stopped one by one, which executors of ``concurrent.futures`` cannot: here, on Ray."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from d4orm_env.core.errors import describe
from d4orm_planners.d_d4orm.ray_planner import RayConnection
from d4orm_planners.evaluation.pool import JobEvent, Work, WorkerLost, WorkerMessage, events

QUEUED = 2
"""Jobs under way per core of the cluster: one that runs, and one that need not be waited for."""


@dataclass
class _Worker:
    """A process, this end of the pipe to it, its present job, and whether it has ever begun one."""

    process: BaseProcess
    pipe: Connection
    ticket: int | None = None
    proven: bool = False


class ProcessPool:
    """Worker processes. They stop at once when the pool is closed, or when this process dies."""

    def __init__(self, size: int, threads: int = 1) -> None:
        self._size, self._threads = size, threads
        self._context = multiprocessing.get_context("spawn")
        # Nobody else holds the sending end: when this process dies, the workers notice.
        self._receiver, self._sender = self._context.Pipe(duplex=False)
        self._workers: list[_Worker] = []
        self._tickets = count()

    def free(self) -> bool:
        return len(self._workers) < self._size or any(worker.ticket is None for worker in self._workers)

    def start(self, job: Work[Any]) -> int:
        idle = (worker for worker in self._workers if worker.ticket is None)
        worker = next(idle, None) or self._new()
        worker.ticket = next(self._tickets)
        with suppress(OSError):  # it died idle; wait() finds the pipe closed and says so
            worker.pipe.send(job)
        return worker.ticket

    def wait(self, timeout: float | None) -> list[WorkerMessage]:
        busy = {worker.pipe: worker for worker in self._workers if worker.ticket is not None}
        messages = []
        for pipe in wait(list(busy), timeout):
            worker = busy[pipe]  # type: ignore[index]
            assert worker.ticket is not None
            ticket = worker.ticket
            try:
                content = worker.pipe.recv()
            except (EOFError, OSError):
                content = self._bury(worker)
            worker.proven = True
            if content is JobEvent.ENDED:
                worker.ticket = None
            messages.append(WorkerMessage(ticket, content))
        return messages

    def stop(self, ticket: int) -> None:
        self._remove(next(worker for worker in self._workers if worker.ticket == ticket))

    def close(self) -> None:
        self._sender.close()
        self._receiver.close()
        for worker in list(self._workers):
            self._remove(worker)

    def _new(self) -> _Worker:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_work, args=(theirs, self._receiver, self._threads), daemon=True)
        with _interrupts_wait():
            process.start()
        theirs.close()  # or a dead worker would not close the pipe
        worker = _Worker(process, ours)
        self._workers.append(worker)
        return worker

    def _remove(self, worker: _Worker) -> None:
        worker.process.kill()
        worker.process.join()
        worker.pipe.close()
        self._workers.remove(worker)

    def _bury(self, worker: _Worker) -> WorkerLost:
        """Say what a worker died of.

        Raises:
            ChildProcessError: If it died before its first job, as all others would.
        """
        worker.process.join()
        code = worker.process.exitcode or 0
        self._remove(worker)
        how = f"exit status {code}" if code >= 0 else f"{signal.Signals(-code).name}, perhaps for lack of memory"
        if not worker.proven:
            raise ChildProcessError(
                f"a worker process died at its start ({how}); a program that evaluates must do so under "
                '`if __name__ == "__main__":`, because workers import it; or run with one worker'
            )
        return WorkerLost(f"ChildProcessError: the worker process died ({how})")


@contextmanager
def _interrupts_wait() -> Iterator[None]:
    """Have Ctrl-C wait for the end of the context, and in a process started there, which would print a traceback."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # whose start would end the waiting
    former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def _work(pipe: Connection, parent: Connection, threads: int) -> None:
    """Run jobs until the parent is gone; Ctrl-C is for the parent, which decides."""
    os.environ.update(D4ORM_NUM_THREADS=str(threads), OMP_NUM_THREADS=str(threads))
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def follow_parent() -> None:
        parent.poll(None)
        os._exit(1)

    threading.Thread(target=follow_parent, daemon=True).start()
    with suppress(EOFError, BrokenPipeError):  # the parent is gone
        while True:
            for content in events(pipe.recv()):
                pipe.send(content)


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

    def start(self, job: Work[Any]) -> int:
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

    def _next(self, task: Iterator[object]) -> Any:
        try:
            content = self._ray.get(next(task))
        except (self._ray.exceptions.RayError, StopIteration) as error:
            del self._jobs[task]
            return WorkerLost(f"ChildProcessError: the worker was lost ({describe(error)})")
        if content is JobEvent.ENDED:
            del self._jobs[task]
        return content


def _work_remotely(job: Work[Any]) -> Iterator[Any]:
    """Run a job on one core of some machine."""
    os.environ.update(D4ORM_NUM_THREADS="1", OMP_NUM_THREADS="1")
    yield from events(job)
