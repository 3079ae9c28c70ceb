"""Who may ask for anything: a browser that shows the playground's own page, and nobody else's.

Any page in a browser may open a web socket to a port of this machine. The browser then tells on whose behalf it does
(``Origin``) and by which name it came (``Host``): a foreign page has another origin, and one that has had its own name
point to this machine (DNS rebinding) has a foreign host.
"""

from __future__ import annotations

import contextlib
from urllib.parse import urlsplit

import viser
from viser.infra import WebsockClientConnection
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed

from d4orm_planners.play.proxy import GATE_HEADER

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_POLICY_VIOLATION = 1008


class Admission:
    """Turns away web sockets of a page before anything that they have sent is looked at.

    Args:
        server: The page.
        token: That of the gate before it; ``None`` for a page without a gate, which is for browsers on this machine.
    """

    def __init__(self, server: viser.ViserServer, token: str | None) -> None:
        self._token = token
        self._sockets = server._websock_server
        self._sockets.on_client_connect(self._admit_or_close)
        self._sockets.disconnect_all_clients()  # whoever was quicker than this

    async def _admit_or_close(self, client: WebsockClientConnection) -> None:
        connection = self._sockets._live_connections[client.client_id]
        assert connection.request is not None
        if not self._admits(connection.request.headers):
            await turn_away(connection)

    def _admits(self, headers: Headers) -> bool:
        return comes_from_here(headers) if self._token is None else headers.get_all(GATE_HEADER) == [self._token]


def comes_from_here(headers: Headers) -> bool:
    """Whether a request was made by a page of this machine's own, or by no page at all."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or _hostname(hosts[0]) not in LOOPBACK:
        return False
    return origins in ([], [f"http://{hosts[0]}"])


async def turn_away(connection: ServerConnection) -> None:
    """Close a connection, and leave nothing to read of what it has sent."""
    await connection.close(_POLICY_VIOLATION, "only the page that d4orm play shows may ask for anything")
    with contextlib.suppress(ConnectionClosed):
        while True:
            await connection.recv()


def _hostname(host: str) -> str | None:
    """The name in ``name:port``."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None
