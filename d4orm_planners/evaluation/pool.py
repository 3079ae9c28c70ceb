"""Handing jobs to processes, of this machine or others, and what happens when one dies or a trial takes too long."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Generator, Iterable
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import NamedTuple, Protocol

from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.trials import Job, run_job


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
