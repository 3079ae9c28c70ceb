"""Worker processes of this machine that can be stopped one by one, which executors of ``concurrent.futures`` cannot."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from d4orm_planners.evaluation.pool import JobEvent, WorkerLost, WorkerMessage
from d4orm_planners.evaluation.trials import run_job


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
