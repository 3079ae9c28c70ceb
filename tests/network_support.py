"""What the tests of nodes on a network share: free ports, waiting for something to come about, and faults."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import random
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from d4orm_planners.d_d4orm.transport import Transport
from d4orm_planners.d_d4orm.zenoh_transport import ZenohTransport

TIMEOUT = 120.0
"""Seconds that anything may take on a busy machine before a test gives up on it."""


def free_endpoint() -> str:
    """An endpoint on loopback that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def port_of(endpoint: str) -> int:
    return int(endpoint.rpartition(":")[2])


def has_listeners(end: ZenohTransport) -> bool:
    """Check whether any node would receive what is published now."""
    return bool(end._publisher.matching_status.matching)


def wait_until(condition: Callable[[], Any], what: str = "it", seconds: float = TIMEOUT) -> None:
    """Return as soon as a condition holds."""
    deadline = time.perf_counter() + seconds
    while not condition():
        assert time.perf_counter() < deadline, f"{what} did not come about"
        time.sleep(0.01)


class FaultyTransport:
    """Loses, duplicates, delays and so reorders what arrives.

    Args:
        inner: Where it arrives.
        seed: Of the faults.
        loss: Share of the messages that is lost.
        duplicates: Share of the others that comes twice.
        delay: Longest delay [s]; each is drawn evenly.
    """

    def __init__(
        self, inner: Transport, seed: int, loss: float = 0.0, duplicates: float = 0.0, delay: float = 0.0
    ) -> None:
        self._inner, self._random = inner, random.Random(seed)
        self._loss, self._duplicates, self._delay = loss, duplicates, delay
        self._number = itertools.count()
        self._late: list[tuple[float, int, bytes]] = []
        self._closed = False

    def publish(self, data: bytes) -> None:
        self._inner.publish(data)

    def collect(self, timeout: float = 0.0) -> list[bytes]:
        deadline = time.perf_counter() + timeout
        while True:
            due = [when for when, _, _ in self._late[:1]]
            for data in self._inner.collect(max(min([deadline, *due]) - time.perf_counter(), 0.0)):
                self._hold(data)
            now, ready = time.perf_counter(), []
            while self._late and self._late[0][0] <= now:
                ready.append(heapq.heappop(self._late)[2])
            if ready or now >= deadline or self._closed:
                return ready

    def _hold(self, data: bytes) -> None:
        if self._random.random() < self._loss:
            return
        for _ in range(1 + (self._random.random() < self._duplicates)):
            due = time.perf_counter() + self._random.uniform(0, self._delay)
            heapq.heappush(self._late, (due, next(self._number), data))

    def close(self) -> None:
        self._closed = True
        self._inner.close()


class Link:
    """A TCP connection that can be cut and mended: what connects to ``endpoint`` is passed on to another endpoint.

    Args:
        target: Where to.
        stalls: Whether a cut link holds back what is sent, as a lost radio link does, or closes its connections.
    """

    def __init__(self, target: str, stalls: bool) -> None:
        self._target, self._stalls = target, stalls
        self._whole = threading.Event()
        self._whole.set()
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        self._whole.clear()
        if not self._stalls:
            self._close_all()

    def mend(self) -> None:
        self._whole.set()

    def close(self) -> None:
        self._whole.set()
        self._server.close()
        self._close_all()

    def _close_all(self) -> None:
        for end in self._open:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        self._open = []

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._server.accept()
            except OSError:
                return
            if not self._whole.is_set() and not self._stalls:
                near.close()
                continue
            try:
                far = socket.create_connection(("127.0.0.1", port_of(self._target)))
            except OSError:
                near.close()
                continue
            self._open += [near, far]
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._pass_on, args=(source, sink), daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self._whole.wait()
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)
