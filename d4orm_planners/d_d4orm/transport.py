"""Transport of messages: its protocol, and threads of one process as the simplest one."""

from __future__ import annotations

import threading
import time
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
    """The receiving end of a transport: a queue of messages, whatever thread they come from."""

    def __init__(self) -> None:
        self._arrived: deque[bytes] = deque(maxlen=WAITING)
        self._changed = threading.Condition()
        self.closed = False

    def put(self, data: bytes) -> None:
        """Add a message."""
        with self._changed:
            self._arrived.append(data)
            self._changed.notify_all()

    def collect(self, timeout: float = 0.0) -> list[bytes]:
        """Return what has arrived, see :meth:`Transport.collect`."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._arrived, timeout)
            messages = [] if self.closed else list(self._arrived)
            self._arrived.clear()
        return messages

    def close(self) -> None:
        """Wake waiting calls; from now on nothing arrives."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()


class LocalTransport(Mailbox):
    """The ``"local"`` transport: one end of a :class:`LocalNetwork`."""

    def __init__(self, network: LocalNetwork) -> None:
        super().__init__()
        self._network = network

    def publish(self, data: bytes) -> None:
        """Send to all other ends."""
        if not self.closed:
            self._network.deliver(self, bytes(data))


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
            end.put(data)


class TrafficStats:
    """A transport that counts.

    Attributes:
        messages: Messages published so far; each goes to all other nodes.
        message_bytes: Their length together.
        waited: Seconds spent in :meth:`collect` so far.
    """

    def __init__(self, transport: Transport) -> None:
        self.messages = self.message_bytes = 0
        self.waited = 0.0
        self._transport = transport

    def publish(self, data: bytes) -> None:
        self._transport.publish(data)
        self.messages += 1
        self.message_bytes += len(data)

    def collect(self, timeout: float = 0.0) -> list[bytes]:
        begin = time.perf_counter()
        try:
            return self._transport.collect(timeout)
        finally:
            self.waited += time.perf_counter() - begin

    def close(self) -> None:
        self._transport.close()
