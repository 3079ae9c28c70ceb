"""Access to the playground: a browser that shows its own page, and nobody else's; and requests it may make.

Any page in a browser may open a web socket to a port of this machine. The browser then tells on whose behalf it does
(``Origin``) and by which name it came (``Host``): a foreign page has another origin, and one that has had its own name
point to this machine (DNS rebinding) has a foreign host.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from functools import partial
from urllib.parse import urlsplit

import msgspec
import viser
from viser.infra import WebsockClientConnection
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed

from d4orm_planners.play.proxy import GATE_HEADER
from d4orm_planners.play.validation import LARGEST_UPLOAD, MessageValidator

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_POLICY_VIOLATION = 1008
_LARGEST_MESSAGE = LARGEST_UPLOAD + 10_000
_MESSAGE_PERIOD = 0.002
"""Seconds from one message of a page to its next at least; a hand makes one every 16 ms."""


class OriginCheck:
    """Turns away web sockets of a page before anything that they have sent is looked at.

    Of what the others send, only what the page offers comes through.

    Args:
        server: The page.
        token: That of the gate before it; ``None`` for a page without a gate, which is for browsers on this machine.
        refuse: Called with the reason when a page asks for what it does not offer.
    """

    def __init__(self, server: viser.ViserServer, token: str | None, refuse: Callable[[str], None]) -> None:
        self._token, self._refuse = token, refuse
        self._validator = MessageValidator(server)
        self._sockets = server._websock_server
        self._sockets.on_client_connect(self._admit_or_close)
        self._sockets.disconnect_all_clients()  # whoever was quicker than this

    async def _admit_or_close(self, client: WebsockClientConnection) -> None:
        connection = self._sockets._live_connections[client.client_id]
        assert connection.request is not None
        if not self._admits(connection.request.headers):
            await turn_away(connection)
            return
        connection.protocol.max_message_size = connection.protocol.max_fragment_size = _LARGEST_MESSAGE
        connection.recv = partial(self._receive, connection, client.client_id)  # type: ignore[method-assign, assignment]

    async def _receive(self, connection: ServerConnection, client: int) -> bytes:
        """The next message that may come through; a connection with anything else is closed."""
        while True:
            await asyncio.sleep(_MESSAGE_PERIOD)
            data = await ServerConnection.recv(connection)
            try:
                return self._validator.checked(client, data)
            except msgspec.ValidationError:
                pass  # a message that nobody listens to
            except (msgspec.DecodeError, RecursionError):
                await turn_away(connection)
            except ValueError as error:
                self._refuse(str(error))

    def _admits(self, headers: Headers) -> bool:
        return comes_from_here(headers) if self._token is None else headers.get_all(GATE_HEADER) == [self._token]


def comes_from_here(headers: Headers) -> bool:
    """Check whether a request was made by a page of this machine's own, or by no page at all."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or _hostname(hosts[0]) not in LOOPBACK:
        return False
    return origins in ([], [f"http://{hosts[0]}"])


async def turn_away(connection: ServerConnection) -> None:
    """Close a connection, and leave nothing to read of what it has sent."""
    await connection.close(_POLICY_VIOLATION, "only the page that d4orm play shows may ask for anything")
    with contextlib.suppress(ConnectionClosed):
        while True:
            await ServerConnection.recv(connection)


def _hostname(host: str) -> str | None:
    """The name in ``name:port``."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None
