"""Jobs in processes, of this machine or on Ray, and what happens when one dies or a part takes too long.

Trials and recorded episodes are such jobs: their results come one by one, so that what is done is not lost. A thread of
an executor waits for each process, for executors of processes cannot end a single one. Of processes that would write
to one folder only one may (:func:`only_writer`).
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol, Self, TypeVar

from d4orm_env.core.errors import describe
from d4orm_planners.d_d4orm.ray_planner import RayConnection

try:
    import fcntl
except ImportError:  # Windows: nobody is kept off
    fcntl = None  # type: ignore[assignment]

Result = TypeVar("Result")
BEGUN = "begun"  #: Word of a process that it has begun a job; the results follow it
RAY_USE = "running on a cluster"  #: Use of Ray here, for the error without it
QUEUED = 2  #: Jobs under way per core of the cluster: one that runs, and one that need not be waited for
ENDING = 0.1  #: Seconds between looks at whether processes that were stopped have ended


class Work(Protocol[Result]):
    """Work of one process, in parts with a result each."""

    @property
    def num_parts(self) -> int: ...

    def run(self) -> Iterable[Result]:
        """Do the parts, one after another."""

    def lost(self, done: int, reason: str) -> tuple[list[Result], Self | None]:
        """Results of the parts that fail with their process, after so many are done, and the job that is left."""


class WorkerLost(Exception):
    """The process that ran a job is gone."""


class JobWorker(Protocol):
    """A process that does one job at a time, for one thread."""

    def start(self, job: Work[Any]) -> None:
        """Hand a job over."""

    def receive(self, timeout: float | None) -> Any:
        """Return the job's next message: :data:`BEGUN`, then each result.

        A TimeoutError if it does not come within so many seconds, WorkerLost if the process is gone; the next job
        begins another.
        """

    def stop(self) -> None:
        """End the process; other threads may."""


def run_jobs(
    jobs: Iterable[Work[Result]], workers: Sequence[JobWorker], timeout: float | None = None
) -> Generator[list[Result]]:
    """Run jobs and yield results as they come, :meth:`Work.lost` where a process dies or a part takes over ``timeout``
    [s].

    The workers share the jobs; they are stopped at the end, also when the iteration is broken off. Raises OSError if no
    process can be started.
    """
    waiting, found = deque(jobs), SimpleQueue[list[Result] | Exception | None]()
    over = threading.Event()

    def serve(worker: JobWorker) -> None:
        try:
            while not over.is_set() and (job := _next(waiting)) is not None:
                _finish(job, worker, timeout, waiting, found)
        except Exception as error:
            found.put(error)
        found.put(None)

    threads = ThreadPoolExecutor(len(workers), initializer=_block_interrupts)
    serving = [threads.submit(serve, worker) for worker in workers]
    ended = 0
    try:
        while ended < len(workers):
            news = [found.get(), *(found.get() for _ in range(found.qsize()))]
            for error in (one for one in news if isinstance(one, Exception)):
                raise error
            if results := [result for one in news if isinstance(one, list) for result in one]:
                yield results
            ended += news.count(None)
    finally:
        over.set()
        while wait(serving, 0).not_done:
            for worker in workers:
                worker.stop()
            wait(serving, ENDING)
        for worker in workers:
            worker.stop()
        threads.shutdown()


def _next(waiting: deque[Work[Result]]) -> Work[Result] | None:
    with suppress(IndexError):  # there are no more
        return waiting.popleft()
    return None


def _finish(
    job: Work[Result], worker: JobWorker, timeout: float | None, waiting: deque[Work[Result]], found: SimpleQueue[Any]
) -> None:
    """Have a worker do a job; what is left of one that has lost its process is put back."""
    done = 0
    try:
        worker.start(job)
        worker.receive(None)
        while done < job.num_parts:
            found.put([worker.receive(timeout)])
            done += 1
    except (TimeoutError, WorkerLost) as error:
        worker.stop()
        late = isinstance(error, TimeoutError)
        results, left = job.lost(done, f"TimeoutError: took longer than {timeout:g} s" if late else str(error))
        found.put(results)
        if left is not None:
            waiting.appendleft(left)


def run_here(jobs: Iterable[Work[Result]]) -> Generator[list[Result]]:
    """Run jobs in this process, on all its cores, and yield results as they come."""
    for job in jobs:
        for result in job.run():
            yield [result]


def _block_interrupts() -> None:
    """Keep Ctrl-C from the present thread and from processes that it starts, which would print a traceback."""
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        resource_tracker.ensure_running()  # whose start would let it through again
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


class ProcessWorker:
    """A process of this machine, begun with its first job, whose kernels run on ``threads``; it ends with this one."""

    def __init__(self, threads: int = 1) -> None:
        self._threads = threads
        self._process: BaseProcess | None = None
        self._proven = False

    def start(self, job: Work[Any]) -> None:
        if self._process is None or not self._process.is_alive():
            context = multiprocessing.get_context("spawn")
            self._pipe, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, self._threads), daemon=True)
            process.start()
            theirs.close()  # or a dead worker would not close the pipe
            self._process, self._proven = process, False
        with suppress(OSError):  # it has just died; receive() says so
            self._pipe.send(job)

    def receive(self, timeout: float | None) -> Any:
        try:
            arrived = self._pipe.poll(timeout)
            content = self._pipe.recv() if arrived else None
        except (EOFError, OSError):
            raise self._lost() from None
        if not arrived:
            raise TimeoutError
        self._proven = True
        return content

    def stop(self) -> None:
        if (process := self._process) is not None:
            process.kill()
            process.join()

    def _lost(self) -> Exception:
        """The error of a process that has died: as its first job began, and all others would die too, or later."""
        assert self._process is not None
        self._process.join()
        code = self._process.exitcode or 0
        how = f"exit status {code}" if code >= 0 else f"{signal.Signals(-code).name}, perhaps for lack of memory"
        if self._proven:
            return WorkerLost(f"ChildProcessError: the worker process died ({how})")
        return ChildProcessError(
            f"a worker process died at its start ({how}); a program that evaluates must do so under "
            '`if __name__ == "__main__":`, because workers import it; or run with one worker'
        )


def _work(pipe: Connection, threads: int) -> None:
    """Run jobs until the parent is gone; Ctrl-C is for the parent, which decides."""
    os.environ.update(D4ORM_NUM_THREADS=str(threads), OMP_NUM_THREADS=str(threads))
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def follow_parent() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=follow_parent, daemon=True).start()
    with suppress(EOFError, BrokenPipeError):  # the parent is gone
        while True:
            for content in _contents(pipe.recv()):
                pipe.send(content)


def _contents(job: Work[Any]) -> Iterator[Any]:
    yield BEGUN
    yield from job.run()


def run_on_ray(
    jobs: Sequence[Work[Result]], address: str, size: int | None, timeout: float | None = None
) -> Generator[list[Result]]:
    """:func:`run_jobs` by tasks on a Ray cluster, one per job and core, never tried again by Ray itself.

    Its address is ``"auto"`` for the one that this machine belongs to, ``"local"`` for a new one here, or an address.
    At most ``size`` jobs are under way, by default twice as many as it has cores. Raises ValueError if the address is
    none, ImportError without Ray, ConnectionError if there is no cluster.
    """
    connection = RayConnection(address, RAY_USE)
    try:
        cores = int(connection.ray.cluster_resources().get("CPU", 1))
        count = min(size or QUEUED * max(cores, 1), max(len(jobs), 1))
        yield from run_jobs(jobs, [_RayWorker(connection.ray) for _ in range(count)], timeout)
    finally:
        connection.close()


class _RayWorker:
    """A task on a Ray cluster. A generator's results come back one by one, so that they are not lost with it."""

    def __init__(self, ray: Any) -> None:
        self._ray = ray
        self._results: Any = None
        self._task = ray.remote(num_cpus=1, max_retries=0)(_work_remotely)

    def start(self, job: Work[Any]) -> None:
        self._results = self._task.remote(job)

    def receive(self, timeout: float | None) -> Any:
        if not self._ray.wait([self._results], timeout=timeout)[0]:
            raise TimeoutError
        try:
            return self._ray.get(next(self._results))
        except (self._ray.exceptions.RayError, StopIteration) as error:
            raise WorkerLost(f"ChildProcessError: the worker was lost ({describe(error)})") from error

    def stop(self) -> None:
        if self._results is not None:
            self._ray.cancel(self._results, force=True)


def _work_remotely(job: Work[Any]) -> Iterator[Any]:
    """Run a job on one core of some machine."""
    os.environ.update(D4ORM_NUM_THREADS="1", OMP_NUM_THREADS="1")
    yield from _contents(job)


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Keep others that ask likewise from writing to a folder meanwhile; the system ends it for a process that dies."""
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise OSError(
            f"folder {folder} is being written to by another process; wait until that has ended, or choose another"
        ) from None
    except OSError:  # a file system without locks
        pass
    try:
        yield
    finally:
        os.close(handle)
