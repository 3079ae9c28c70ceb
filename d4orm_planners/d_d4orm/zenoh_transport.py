"""The ``"zenoh"`` transport: peers on a network, by Eclipse Zenoh, which ROS 2 can run on too."""

from __future__ import annotations

import atexit
import contextlib
import ipaddress
import json
import logging
import re
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator

from d4orm_env.core.files import require_file
from d4orm_env.core.lazy import LazyModule, load
from d4orm_planners.base.settings import CheckedSettings, PathText, Seconds
from d4orm_planners.d_d4orm.transport import MAX_BYTES, WAITING, Transport

_zenoh: Any = LazyModule("zenoh", "transport 'zenoh'", "zenoh")

logger = logging.getLogger(__name__)
LOOPBACK = ("tcp/127.0.0.1:0",)  #: Default endpoint that nodes listen at: a free port that only this machine reaches
PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws")
LAST_WAIT = 5.0  #: Seconds to wait for the thread that receives, once there is nothing more to come

RESERVED = {
    "listen/endpoints": "listen",
    "connect/endpoints": "connect",
    "scouting/multicast/enabled": "multicast",
    "namespace": "namespace",
}
"""Keys that a zenoh configuration file leaves to the settings, and the setting."""

DEFAULTS: Mapping[str, object] = {
    "mode": "peer",
    # The queues of a slow link hold a megabyte, so that a candidate that is cut into pieces is not lost halfway.
    "transport/link/tx/queue/size/data": 16,
    # Longer messages end here, before they cost memory; what is a little too long is left to the inbox to count.
    "transport/link/rx/max_message_size": 2 * MAX_BYTES,
    # A node that is killed leaves nothing behind in shared memory.
    "transport/shared_memory/enabled": False,
    "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
}
"""Zenoh's settings, unless its configuration file has something else."""

_ENDPOINT = re.compile(rf"({'|'.join(PROTOCOLS)})/(?P<host>\[[0-9A-Fa-f:.%]+\]|[^\[\]:/?#]+):(?P<port>\d+)([?#].*)?")
_NAMESPACE = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")


def _namespace(name: str) -> str:
    if not _NAMESPACE.fullmatch(name):
        raise ValueError(f"{name!r} is not of letters, digits, '_', '.' and '-', with '/' between, as team/1")
    return name


def _endpoints(endpoints: object, least_port: int = 0) -> tuple[str, ...]:
    if isinstance(endpoints, str) or not isinstance(endpoints, (list, tuple)):
        raise ValueError(f"must be a list of endpoints, as [tcp/192.168.1.10:7447], not {endpoints!r}")
    for endpoint in endpoints:
        match = _ENDPOINT.fullmatch(endpoint) if isinstance(endpoint, str) else None
        if match is None or not least_port <= int(match["port"]) <= 65535:
            raise ValueError(
                f"has {endpoint!r}; an endpoint is of the form PROTOCOL/HOST:PORT, as tcp/192.168.1.10:7447, with one "
                f"of {', '.join(PROTOCOLS)}"
            )
    return tuple(endpoints)


@dataclass(frozen=True, kw_only=True)
class ZenohSettings(CheckedSettings):
    """Network of the nodes. By default that is this machine only, and no port is open beyond loopback."""

    #: Name shared by the nodes of one solve alone: their messages have the key ``NAMESPACE/candidates``
    namespace: Annotated[str, AfterValidator(_namespace)] = "d4orm"
    #: Endpoints to listen at, as ``tcp/192.168.1.10:7447``; port 0 for any free one
    listen: Annotated[tuple[str, ...], BeforeValidator(_endpoints)] = LOOPBACK
    #: Endpoints of other nodes or of a zenoh router; one that is away is tried again and again. One is enough, as
    #: connected nodes let each other know of the rest.
    connect: Annotated[tuple[str, ...], BeforeValidator(partial(_endpoints, least_port=1))] = ()
    #: Whether to find others by UDP multicast: on the network, or on this machine where the node listens on loopback
    #: only
    multicast: bool = False
    #: A zenoh configuration in JSON5, for TLS, access control and whatever else zenoh has; the settings above are not
    #: to be in it
    config_file: PathText | None = None
    grace_period: Seconds = 2.0  #: Seconds that a node goes on telling its solution, until all others have one as good

    @classmethod
    def of(cls, settings: object) -> ZenohSettings:
        """Settings from a mapping; those that are such already stay. Raises ValueError for others."""
        if isinstance(settings, cls):
            return settings
        if not isinstance(settings, Mapping):
            names = ", ".join(cls.setting_names())
            raise ValueError(f"the settings of zenoh must be a mapping of {names}, not {settings!r}")
        return cls.from_keywords(settings, "zenoh")

    @property
    def on_loopback(self) -> bool:
        """True if nobody beyond this machine can connect."""
        return all(_is_loopback(endpoint) for endpoint in self.listen)


class ZenohTransport(Transport):
    """One end of a network of zenoh peers. The environment variable ``RUST_LOG`` makes zenoh log what it does.

    Raises:
        ImportError: If zenoh is not installed.
        ValueError: If zenoh refuses the settings or its configuration file, or cannot listen where it is asked to.
    """

    def __init__(self, settings: ZenohSettings) -> None:
        super().__init__()
        zenoh = load(_zenoh)
        zenoh.try_init_log_from_env()
        config = zenoh_config(zenoh, settings)
        key = f"{settings.namespace}/candidates"
        self._error: type[Exception] = zenoh.ZError
        try:
            self._session = zenoh.open(config)
            # Newer candidates replace older ones, so that it is better to lose one than to wait for a slow link.
            self._publisher = self._session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                express=True,
                allowed_destination=zenoh.Locality.REMOTE,
            )
            self._subscriber = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(WAITING))
        except zenoh.ZError as error:
            raise ValueError(
                f"zenoh cannot listen at {', '.join(settings.listen) or 'nothing'} or connect to "
                f"{', '.join(settings.connect) or 'nothing'}: {_reason(error)}"
            ) from error
        # Zenoh's own thread for a callback is none that the end of the process leaves alone.
        self._receiver = threading.Thread(target=self._receive, daemon=True, name=f"zenoh-{key}")
        self._receiver.start()
        # A session that is left open might keep the process from ending, and a thread inside it would abort it.
        atexit.register(self._leave)

    def publish(self, data: bytes) -> None:
        if self.closed:
            return
        try:
            self._publisher.put(data)
        except self._error as error:
            if not self.closed:
                logger.warning("a candidate was not sent: %s", _reason(error))

    def close(self) -> None:
        super().close()
        atexit.unregister(self._leave)
        self._leave()

    def _leave(self) -> None:
        self._session.close()
        self._receiver.join(LAST_WAIT)

    def _receive(self) -> None:
        with contextlib.suppress(self._error):  # which says that the session is closed
            while True:
                self.put(self._subscriber.recv().payload.to_bytes())


def zenoh_config(zenoh: ModuleType, settings: ZenohSettings) -> object:
    config = plain = zenoh.Config()
    if settings.config_file is not None:
        try:
            require_file(Path(settings.config_file), "a JSON5 file")
            config = zenoh.Config.from_file(settings.config_file)
        except (zenoh.ZError, ValueError) as error:
            raise ValueError(f"config_file {settings.config_file}: {_reason(error)}") from error
        for key, name in RESERVED.items():
            if config.get_json(key) != plain.get_json(key):
                raise ValueError(f"config_file {settings.config_file} has {key}; leave it to the setting {name}")
    unset = {key: value for key, value in DEFAULTS.items() if config.get_json(key) == plain.get_json(key)}
    given: dict[str, object] = {
        "listen/endpoints": settings.listen,
        "connect/endpoints": settings.connect,
        "scouting/multicast/enabled": settings.multicast,
    }
    if settings.on_loopback and config.get_json("scouting/multicast/interface") == "null":
        given["scouting/multicast/interface"] = "127.0.0.1"
    for key, value in {**unset, **given}.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _is_loopback(endpoint: str) -> bool:
    match = _ENDPOINT.fullmatch(endpoint)
    assert match is not None
    host = match["host"].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _reason(error: Exception) -> str:
    """Return zenoh's message, on one line and without positions in its sources."""
    return " ".join(re.sub(r" at /\S+\.rs:\d+\.?", "", str(error)).split())
