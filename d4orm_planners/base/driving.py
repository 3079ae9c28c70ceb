"""Driver of a policy: one thread at a time, and one episode at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

ATTRIBUTE = "_driving"
"""Attribute of a policy's :class:`Driving`, which its copies do not share."""
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

    @contextmanager
    def turn(self, env: Any = None) -> Iterator[None]:
        """Context in which a thread resets the policy for an environment or, without one, asks it for controls.

        Raises:
            RuntimeError: If another thread does so at this moment, or has reset the policy for its own environment.
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


def driven_alone(method: Callable[..., Any]) -> Callable[..., Any]:
    """``reset`` or ``act`` of a policy, refused where :class:`Driving` refuses it."""

    @wraps(method)
    def guarded(policy: Any, *arguments: Any, **keywords: Any) -> Any:
        # One step, so that two threads do not make two; a subclass need not call a constructor for it.
        driving: Driving = vars(policy).setdefault(ATTRIBUTE, Driving())
        env = keywords.get("env", *arguments[:1]) if method.__name__ == "reset" else None
        with driving.turn(env):
            return method(policy, *arguments, **keywords)

    return guarded
