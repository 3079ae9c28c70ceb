"""Handing jobs to processes, of this machine or others, and what happens when one dies or a part takes too long.

Trials and recorded episodes are such jobs: their results come one by one, so that what is done is not lost.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

Result = TypeVar("Result")


class Work(Protocol[Result]):
    """Work of one process, in parts with a result each."""

    @property
    def num_parts(self) -> int: ...

    def run(self) -> Iterable[Result]:
        """Do the parts, one after another."""

    def lost(self, done: int, reason: str) -> tuple[list[Result], Self | None]:
        """Results of the parts that fail with their process, after so many are done, and the job that is left."""


class JobEvent(Enum):
    """Event of a job, apart from its results."""

    BEGUN = "begun"
    ENDED = "ended"


@dataclass(frozen=True)
class WorkerLost:
    """The process that ran a job is gone."""

    reason: str


class WorkerMessage(NamedTuple):
    """News of a job.

    Attributes:
        ticket: Of the job.
        content: The result of a part, an event, or that the job is lost.
    """

    ticket: int
    content: Any


class Pool(Protocol):
    """Processes that run jobs."""

    def free(self) -> bool:
        """True if it takes another job now."""

    def start(self, job: Work[Any]) -> int:
        """Hand a job over; returns a ticket for it."""

    def wait(self, timeout: float | None) -> list[WorkerMessage]:
        """Wait for news, at most so long [s]."""

    def stop(self, ticket: int) -> None:
        """End the process that runs this job; no more news of it come."""

    def close(self) -> None:
        """End all processes."""


@dataclass
class _RunningJob:
    """A job under way: how many of its parts are done, and since when the present one runs."""

    job: Work[Any]
    done: int = 0
    since: float | None = None


@dataclass
class _Schedule(Generic[Result]):
    pool: Pool
    timeout: float | None
    waiting: deque[Work[Result]]
    running: dict[int, _RunningJob] = field(default_factory=dict)

    def hand_out(self) -> None:
        while self.waiting and self.pool.free():
            job = self.waiting.popleft()
            self.running[self.pool.start(job)] = _RunningJob(job)

    def collect(self) -> list[Result]:
        """Wait for news; the results that there are now."""
        results = []
        for ticket, content in self.pool.wait(self._patience()):
            run = self.running[ticket]
            if isinstance(content, WorkerLost):
                results += self._give_up(ticket, content.reason)
            elif content is JobEvent.ENDED:
                del self.running[ticket]
            else:
                run.since = time.monotonic()
                if content is not JobEvent.BEGUN:
                    run.done += 1
                    results.append(content)
        for ticket in [ticket for ticket, run in self.running.items() if self._left(run) <= 0]:
            self.pool.stop(ticket)
            results += self._give_up(ticket, f"TimeoutError: took longer than {self.timeout:g} s")
        return results

    def _give_up(self, ticket: int, reason: str) -> list[Result]:
        """The results of a job that has lost its process; what is left of it is put back."""
        run = self.running.pop(ticket)
        results, left = run.job.lost(run.done, reason)
        if left is not None:
            self.waiting.appendleft(left)
        return results

    def _left(self, run: _RunningJob) -> float:
        if self.timeout is None or run.since is None or run.done == run.job.num_parts:
            return float("inf")
        return run.since + self.timeout - time.monotonic()

    def _patience(self) -> float | None:
        shortest = min(map(self._left, self.running.values()), default=float("inf"))
        return None if shortest == float("inf") else max(shortest, 0.0)


def run_jobs(jobs: Iterable[Work[Result]], pool: Pool, timeout: float | None = None) -> Generator[list[Result]]:
    """Run jobs and yield results as they come, :meth:`Work.lost` where a process dies or a part takes too long.

    Args:
        jobs: Jobs to run.
        pool: Pool that runs them; closed at the end, also when the iteration is broken off.
        timeout: Seconds that a part may take; ``None`` is no limit.

    Raises:
        OSError: If no process can be started.
    """
    schedule = _Schedule(pool, timeout, deque(jobs))
    ended: list[Result] = []
    try:
        while schedule.waiting or schedule.running or ended:
            # Nobody waits for work while somebody writes down what is done.
            schedule.hand_out()
            if ended:
                yield ended
            ended = schedule.collect() if schedule.running else []
    finally:
        pool.close()


def events(job: Work[Any]) -> Iterator[Any]:
    """Do a job, and yield what a worker says of it: that it has begun, each result, and that it has ended."""
    yield JobEvent.BEGUN
    yield from job.run()
    yield JobEvent.ENDED


def run_here(jobs: Iterable[Work[Result]]) -> Generator[list[Result]]:
    """Run jobs in this process, on all its cores, and yield results as they come."""
    for job in jobs:
        for result in job.run():
            yield [result]
