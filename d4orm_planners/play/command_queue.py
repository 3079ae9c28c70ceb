"""Requests that a session has not done yet: so many at most, and of every setting the last one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec

P = ParamSpec("P")
Command = Callable[[], None]

MOST_WAITING = 100
"""Commands; more than that come from no hand."""


class CommandQueue:
    """Commands from any threads for one that executes them."""

    def __init__(self) -> None:
        self._waiting: dict[object, Command] = {}
        self._changed = threading.Condition()
        self._closed, self._dropped = False, 0

    def put(self, command: Command, setting: str | None = None) -> None:
        """Add a command; it takes the place of one for the same setting that waits. Beyond so many it is dropped."""
        with self._changed:
            self._waiting.pop(setting, None)
            if len(self._waiting) < MOST_WAITING:
                self._waiting[setting or object()] = command
            else:
                self._dropped += 1
            self._changed.notify_all()

    def take(self) -> Command | None:
        """The command that has waited longest; ``None`` where there is none, or the queue is closed."""
        with self._changed:
            if self._closed or not self._waiting:
                return None
            return self._waiting.pop(next(iter(self._waiting)))

    def dropped(self) -> int:
        """Return the number dropped since this was last asked."""
        with self._changed:
            dropped, self._dropped = self._dropped, 0
        return dropped

    def wait(self, timeout: float) -> None:
        """Until there is a command, the queue is closed, or so many seconds have passed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._waiting, timeout)

    def close(self) -> None:
        """Wake waiting calls; there is nothing to take any more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        """True if it was closed."""
        return self._closed


def queued(
    setting: str | None = None,
) -> Callable[[Callable[Concatenate[Any, P], None]], Callable[Concatenate[Any, P], None]]:
    """Have calls of a method wait among its object's ``commands``; of one setting the last call counts."""

    def decorate(method: Callable[Concatenate[Any, P], None]) -> Callable[Concatenate[Any, P], None]:
        @wraps(method)
        def put(owner: Any, /, *arguments: P.args, **keywords: P.kwargs) -> None:
            owner.commands.put(partial(method, owner, *arguments, **keywords), setting)

        return put

    return decorate
