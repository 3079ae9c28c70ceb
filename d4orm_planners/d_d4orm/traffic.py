"""Statistics of a node's messages, and of its waiting for the others."""

from __future__ import annotations

import time

from d4orm_planners.d_d4orm.transport import Transport


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
        """See :meth:`Transport.publish`."""
        self._transport.publish(data)
        self.messages += 1
        self.message_bytes += len(data)

    def collect(self, timeout: float = 0.0) -> list[bytes]:
        """See :meth:`Transport.collect`."""
        begin = time.perf_counter()
        try:
            return self._transport.collect(timeout)
        finally:
            self.waited += time.perf_counter() - begin

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        self._transport.close()
