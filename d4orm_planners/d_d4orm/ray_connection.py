"""Connecting to Ray: to a cluster, or to an instance of one's own that only this machine can reach."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

TIMEOUT = 10.0
"""Seconds to wait for the head of a cluster to answer."""

LOOPBACK = ("127.0.0.1", "::1")


def import_ray(what: str) -> ModuleType:
    """Ray, or an ``ImportError`` that says what needs it and how to install it."""
    try:
        import ray
    except ImportError as error:
        raise ImportError(f"{what} needs ray; install it with: pip install 'd4orm-env[distributed]'") from error
    return ray


class RayConnection:
    """A connection to Ray. One that this process has already is used, and left open.

    Attributes:
        ray: The library.

    Args:
        address: ``"auto"`` for the cluster that this machine belongs to, an address, or ``"local"`` for a new instance
            on this machine.
        what: User of it, for the error without Ray.

    Raises:
        ValueError: If the address is none.
        ImportError: If Ray is not installed.
        ConnectionError: If there is no cluster.
    """

    def __init__(self, address: str, what: str) -> None:
        host, port = host_and_port(address)
        self.ray = import_ray(what)
        self._owner = not self.ray.is_initialized()
        try:
            if host:
                # Ray itself tries for minutes.
                socket.create_connection((host, port), TIMEOUT).close()
            if self._owner and address == "local":
                self._start_here()
            elif self._owner:
                self.ray.init(address=address, log_to_driver=False)
        except Exception as error:  # Ray raises errors of many kinds
            text = " ".join(str(error).split())
            raise ConnectionError(
                f"Ray cluster {address!r} cannot be reached ({type(error).__name__}: {text}); "
                "start one with `ray start --head`, or leave the address out to run on this machine"
            ) from error

    def _start_here(self) -> None:
        with _loopback_only():
            self.ray.init(address="local", log_to_driver=False, include_dashboard=False)
        if (address := self.ray.util.get_node_ip_address()) not in LOOPBACK:
            self.ray.shutdown()
            raise RuntimeError(f"Ray {self.ray.__version__} would listen on {address}, beyond this machine")

    def close(self) -> None:
        """Disconnect, which ends an instance of one's own."""
        if self._owner:
            self.ray.shutdown()


@contextmanager
def _loopback_only() -> Iterator[None]:
    """Have Ray use the loopback address, which on Linux it replaces by one of the network, even if given it."""
    from ray._private import ray_constants

    usual = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = usual


def host_and_port(address: str) -> tuple[str, int]:
    """Return host and port of an address; nothing for one that is no ``host:port``, with ``ray://`` or without.

    Raises:
        ValueError: If it is no address.
    """
    if address in ("auto", "local"):
        return "", 0
    host, _, port = str(address).removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(f"Ray address {address!r} is neither auto, nor local, nor of the form host:port")
    return host.strip("[]"), int(port)
