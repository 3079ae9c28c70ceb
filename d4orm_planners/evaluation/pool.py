"""Handing jobs to processes, of this machine or others, and what happens when one dies or a trial takes too long."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import count
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple, Protocol

from d4orm_env.core.errors import describe
from d4orm_planners.d_d4orm.ray_connection import RayConnection
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.trials import Job, run_job

QUEUED = 2
"""Jobs under way per core of the cluster: one that runs, and one that need not be waited for."""


class JobEvent(Enum):
    """Event of a job, apart from its trials."""

    BEGUN = "begun"
    ENDED = "ended"


@dataclass(frozen=True)
class WorkerLost:
    """The process that ran a job is gone.

    Attributes:
        reason: Kind of error and message.
    """

    reason: str


class WorkerMessage(NamedTuple):
    """News of a job.

    Attributes:
        ticket: Of the job.
        content: A finished trial, a sign, or that the job is lost.
    """

    ticket: int
    content: Trial | JobEvent | WorkerLost


class Pool(Protocol):
    """Processes that run jobs."""

    def free(self) -> bool:
        """True if it takes another job now."""

    def start(self, job: Job) -> int:
        """Hand a job over; returns a ticket for it."""

    def wait(self, timeout: float | None) -> list[WorkerMessage]:
        """Wait for news, at most so long [s]."""

    def stop(self, ticket: int) -> None:
        """End the process that runs this job; no more news of it come."""

    def close(self) -> None:
        """End all processes."""


@dataclass
class _RunningJob:
    """A job under way: how many of its trials are done, and since when the present one runs."""

    job: Job
    done: int = 0
    since: float | None = None


@dataclass
class _Schedule:
    pool: Pool
    trial_timeout: float | None
    waiting: deque[Job]
    running: dict[int, _RunningJob] = field(default_factory=dict)

    def hand_out(self) -> None:
        while self.waiting and self.pool.free():
            job = self.waiting.popleft()
            self.running[self.pool.start(job)] = _RunningJob(job)

    def collect(self) -> list[Trial]:
        """Wait for news; the trials that have ended."""
        trials = []
        for ticket, content in self.pool.wait(self._patience()):
            run = self.running[ticket]
            if isinstance(content, WorkerLost):
                trials += self._give_up(ticket, content.reason)
            elif content is JobEvent.ENDED:
                del self.running[ticket]
            else:
                run.since = time.monotonic()
                if isinstance(content, Trial):
                    run.done += 1
                    trials.append(content)
        for ticket in [ticket for ticket, run in self.running.items() if self._left(run) <= 0]:
            self.pool.stop(ticket)
            trials += self._give_up(ticket, f"TimeoutError: took longer than {self.trial_timeout:g} s")
        return trials

    def _give_up(self, ticket: int, reason: str) -> list[Trial]:
        """The trials that a job fails in without its process; the others of the job are put back."""
        run = self.running.pop(ticket)
        left = run.job.conditions[run.done :]
        # Without a plan there is nothing to execute, under any condition.
        lost = len(left) if run.done == 0 and run.job.policy.planned else 1
        if left[lost:]:
            self.waiting.appendleft(replace(run.job, conditions=left[lost:]))
        return [run.job.failed(condition, reason) for condition in left[:lost]]

    def _left(self, run: _RunningJob) -> float:
        if self.trial_timeout is None or run.since is None or run.done == len(run.job.conditions):
            return float("inf")
        return run.since + self.trial_timeout - time.monotonic()

    def _patience(self) -> float | None:
        shortest = min(map(self._left, self.running.values()), default=float("inf"))
        return None if shortest == float("inf") else max(shortest, 0.0)


def run_jobs(jobs: Iterable[Job], pool: Pool, trial_timeout: float | None = None) -> Generator[list[Trial]]:
    """Run jobs and yield trials as they end. A trial whose process dies, or which takes too long, ends with an error.

    Args:
        jobs: Jobs to run.
        pool: Pool that runs it; closed at the end, also when the iteration is broken off.
        trial_timeout: Seconds that a trial may take, that of the plan included; ``None`` is no limit.

    Raises:
        OSError: If no process can be started.
    """
    schedule = _Schedule(pool, trial_timeout, deque(jobs))
    ended: list[Trial] = []
    try:
        while schedule.waiting or schedule.running or ended:
            # Nobody waits for work while somebody writes down what is done.
            schedule.hand_out()
            if ended:
                yield ended
            ended = schedule.collect() if schedule.running else []
    finally:
        pool.close()


def run_here(jobs: Iterable[Job]) -> Generator[list[Trial]]:
    """Run jobs in this process, on all its cores, and yield trials as they end."""
    for job in jobs:
        for trial in run_job(job):
            yield [trial]


@dataclass
class _Worker:
    """A process, this end of the pipe to it, its present job, and whether it has ever begun one."""

    process: BaseProcess
    pipe: Connection
    ticket: int | None = None
    proven: bool = False


class ProcessPool:
    """Worker processes. They stop at once when the pool is closed, or when this process dies.

    Args:
        size: Processes.
        threads: Threads of each.
        run: Function that runs a job; by default its trials.
    """

    def __init__(self, size: int, threads: int = 1, run: Callable[[Any], Iterator[object]] = run_job) -> None:
        self._size, self._threads, self._run = size, threads, run
        self._context = multiprocessing.get_context("spawn")
        # Nobody else holds the sending end: when this process dies, the workers notice.
        self._receiver, self._sender = self._context.Pipe(duplex=False)
        self._workers: list[_Worker] = []
        self._tickets = count()

    def free(self) -> bool:
        return len(self._workers) < self._size or any(worker.ticket is None for worker in self._workers)

    def start(self, job: object) -> int:
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
        work = (theirs, self._receiver, self._threads, self._run)
        process = self._context.Process(target=_work, args=work, daemon=True)
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


def _work(pipe: Connection, parent: Connection, threads: int, run: Callable[[Any], Iterator[object]]) -> None:
    """Run jobs until the parent is gone; Ctrl-C is for the parent, which decides."""
    os.environ.update(D4ORM_NUM_THREADS=str(threads), OMP_NUM_THREADS=str(threads))
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def follow_parent() -> None:
        parent.poll(None)
        os._exit(1)

    threading.Thread(target=follow_parent, daemon=True).start()
    with suppress(EOFError, BrokenPipeError):  # the parent is gone
        while True:
            job = pipe.recv()
            pipe.send(JobEvent.BEGUN)
            for result in run(job):
                pipe.send(result)
            pipe.send(JobEvent.ENDED)


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
