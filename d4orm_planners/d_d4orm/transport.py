"""Transport of messages: its protocol, and threads of one process as the simplest one."""

from __future__ import annotations

import threading
from collections import deque
from typing import Protocol

TRANSPORTS = ("local", "ray", "zenoh")

WAITING = 64
"""Messages that wait for a slow node at most; then the oldest are lost, which newer ones replace anyhow."""


class Transport(Protocol):
    """One node's access to the others. Messages are bytes; they may get lost, and come in any order."""

    def publish(self, data: bytes) -> None:
        """Send to all other nodes, without waiting for them; nothing happens once closed."""
        ...

    def collect(self, timeout: float = 0.0) -> list[bytes]:
        """Everything that has arrived since the last call; waits up to ``timeout`` [s] for something to arrive.

        Once closed there is nothing, at once.
        """
        ...

    def close(self) -> None:
        """Leave. A call that waits in :meth:`collect` is woken; closing again does no harm."""
        ...


class Mailbox:
    """Queue of messages for one receiver, whatever thread they come from.

    Attributes:
        closed: Whether there will be no more.
    """

    def __init__(self) -> None:
        self._arrived: deque[bytes] = deque(maxlen=WAITING)
        self._changed = threading.Condition()
        self.closed = False

    def put(self, data: bytes) -> None:
        """Add a message."""
        with self._changed:
            self._arrived.append(data)
            self._changed.notify_all()

    def take(self, timeout: float = 0.0) -> list[bytes]:
        """See :meth:`Transport.collect`."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._arrived, timeout)
            messages = [] if self.closed else list(self._arrived)
            self._arrived.clear()
        return messages

    def close(self) -> None:
        """Wake waiting calls; from now on there is nothing to take."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()


class LocalTransport:
    """The ``"local"`` transport: one end of a :class:`LocalNetwork`."""

    def __init__(self, network: LocalNetwork) -> None:
        self._network = network
        self.mailbox = Mailbox()

    def publish(self, data: bytes) -> None:
        """See :meth:`Transport.publish`."""
        if not self.mailbox.closed:
            self._network.deliver(self, bytes(data))

    def collect(self, timeout: float = 0.0) -> list[bytes]:
        """See :meth:`Transport.collect`."""
        return self.mailbox.take(timeout)

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        self.mailbox.close()


class LocalNetwork:
    """A fully connected network inside one process."""

    def __init__(self) -> None:
        self._ends: list[LocalTransport] = []
        self._lock = threading.Lock()

    def join(self) -> LocalTransport:
        """A new end of the network; it receives what is sent from now on."""
        end = LocalTransport(self)
        with self._lock:
            self._ends.append(end)
        return end

    def deliver(self, sender: LocalTransport, data: bytes) -> None:
        """Give a message to every end but the sender's."""
        with self._lock:
            ends = [end for end in self._ends if end is not sender]
        for end in ends:
            end.mailbox.put(data)
