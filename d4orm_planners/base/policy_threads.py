"""Threads about a policy: one caller at a time, and work in the background of a controller."""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import wraps
from typing import Any, Generic, TypeVar

import numpy as np

from d4orm_env.engine.threads import keep_to_one_core

Result = TypeVar("Result")
ATTRIBUTE = "_driving"  #: Attribute of a policy's :class:`Driving`, which its copies do not share
SWITCH = 5e-4
"""Time for which a thread keeps the interpreter that another one waits for [s], a tenth of Python's own: control loops
wait for it after each of their many kernels, at worst every time."""
LEAST, MOST, KEPT = 0.1, 0.5, 0.9
"""Shares of a time limit that are kept back for what comes after a wait, at least and at most, and share of the longest
time that this took lately which a call keeps."""
MANY = 20_000
"""Objects that a garbage collection beside control loops may look at. A process with kernels has 300,000, for which it
holds up all threads for a tenth of a second."""
_REMEDY = "make a policy for every thread, with make_policy() or copy.copy()"


class Driving:
    """Refuses calls of a policy that would mix the episodes of several threads.

    An episode may go on in another thread than it began in. But two calls must not overlap, and a thread whose episode
    another one has replaced by that of its own environment must reset before it acts again.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._episode: tuple[int, int] | None = None
        self._replaced: set[int] = set()

    def __reduce__(self) -> tuple[type[Driving], tuple[()]]:
        return Driving, ()

    def is_for(self, env: Any) -> bool:
        """Return whether the present episode, if any, is that of this environment."""
        return self._episode is None or self._episode[1] == id(getattr(env, "unwrapped", env))

    @contextmanager
    def turn(self, env: Any = None) -> Iterator[None]:
        """Context in which a thread resets the policy for an environment or, without one, asks it for controls.

        A RuntimeError if another thread does so at this moment, or has reset the policy for its own environment.
        """
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(f"another thread is using this policy at this moment; {_REMEDY}")
        thread = threading.get_ident()
        try:
            if env is not None:
                episode = thread, id(getattr(env, "unwrapped", env))
                if self._episode is not None and self._episode[1] != episode[1]:
                    self._replaced.add(self._episode[0])
                self._replaced.discard(thread)
                self._episode = episode
            elif thread in self._replaced:
                raise RuntimeError(f"another thread has reset this policy for an environment of its own; {_REMEDY}")
            yield
        finally:
            self._lock.release()


def check_episode(policy: Any, env: Any) -> None:
    """Refuse a policy whose last reset was for another environment, by a RuntimeError."""
    driving = vars(policy).get(ATTRIBUTE)
    if driving is not None and not driving.is_for(env):
        raise RuntimeError("this policy has begun another episode since; give each controller one of its own")


def driven_alone(method: Callable[..., Any]) -> Callable[..., Any]:
    """``reset`` or ``act`` of a policy, refused where :class:`Driving` refuses it. A failed reset is none."""

    @wraps(method)
    def guarded(policy: Any, *arguments: Any, **keywords: Any) -> Any:
        # One step, so that two threads do not make two; a subclass need not call a constructor for it.
        driving: Driving = vars(policy).setdefault(ATTRIBUTE, Driving())
        env = keywords.get("env", *arguments[:1]) if method.__name__ == "reset" else None
        with driving.turn(env):
            try:
                return method(policy, *arguments, **keywords)
            except BaseException:
                if method.__name__ == "reset":
                    vars(policy).pop("problem", None)
                raise

    return guarded


class Background(Generic[Result]):
    """A job at a time in a thread of its own.

    If ``yielding``, it leaves other cores, and their threads, to others, which go first where threads have priorities.
    """

    def __init__(self, yielding: bool = False) -> None:
        self._initializer = _yield_to_others if yielding else None
        self._pool: ThreadPoolExecutor | None = None
        self._job: Future[Result] | None = None

    def __reduce__(self) -> tuple[type[Background[Result]], tuple[bool]]:
        return type(self), (self._initializer is not None,)

    def start(self, work: Callable[[], Result]) -> Future[Result]:
        if self._pool is None:
            # Of the whole process, there is no other.
            sys.setswitchinterval(min(SWITCH, sys.getswitchinterval()))
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="background", initializer=self._initializer)
        self._job = self._pool.submit(work)
        return self._job

    @property
    def is_busy(self) -> bool:
        return self._job is not None and not self._job.done()

    def result(self) -> tuple[bool, Result | None]:
        """True if no job is under way, and the result of the last one, which is given once."""
        if self._job is None:
            return True, None
        if self.is_busy:
            return False, None
        job, self._job = self._job, None
        return True, job.result()

    def run(self, work: Callable[[], Result], timeout: float | None) -> Result | None:
        """The result of the work, or ``None`` if it takes longer than the timeout [s]; without one it is waited for.

        Late work goes on, and its result is thrown away. No other work begins before it is done.
        """
        if timeout is None:
            return work()
        end = time.perf_counter() + timeout
        if timeout <= 0 or (self._job is not None and not wait([self._job], timeout).done):
            return None
        self.result()  # an error of late work must not get lost
        wait([self.start(work)], max(end - time.perf_counter(), 0))
        return self.result()[1]

    def forget(self) -> None:
        """Wait for what is under way and throw its result away; an error of it is raised."""
        job, self._job = self._job, None
        if job is not None:
            job.result()

    def close(self) -> None:
        """End the thread as soon as its job is done; another job would start another one."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=False, cancel_futures=True)


class TimeLimit:
    """Limit of the time that each of somebody's calls takes, part of which it waits for work in the background."""

    def __init__(self) -> None:
        self._begin, self._seconds, self._waited, self._rest = 0.0, np.inf, np.inf, 0.0

    def begin(self, seconds: float | None) -> None:
        """Note that a call begins, which may take so many seconds, or any time."""
        self._begin, self._seconds, self._waited = time.perf_counter(), np.inf if seconds is None else seconds, np.inf

    @property
    def left(self) -> float | None:
        """Seconds that the call may wait, so that what comes after it fits in; ``None`` for any."""
        if self._seconds == np.inf:
            return None
        rest = min(max(self._rest, LEAST * self._seconds), MOST * self._seconds)
        return self._begin + self._seconds - rest - time.perf_counter()

    def run(self, background: Background[Result], work: Callable[[], Result]) -> Result | None:
        """The result of the work, or ``None`` if it is late."""
        result = background.run(work, self.left)
        self._waited = time.perf_counter()
        return result

    def end(self) -> None:
        """Note that the call ends."""
        self._rest = max(time.perf_counter() - self._waited, KEPT * self._rest)


def keep_collections_short() -> None:
    """Have garbage collections look at what is new only, from now on, where there is much else."""
    if gc.isenabled() and len(gc.get_objects(generation=2)) > MANY:
        gc.unfreeze()
        gc.collect()
        gc.freeze()


def _yield_to_others() -> None:
    """Keep the calling thread to one core, and lower its priority: on Linux its number stands for that here."""
    keep_to_one_core()
    if sys.platform != "linux":
        return
    thread = threading.get_native_id()
    # Where all of the process yields more than that, only root could take some of it back.
    os.setpriority(os.PRIO_PROCESS, thread, max(10, os.getpriority(os.PRIO_PROCESS, thread)))
