"""A proxy before a page: requests from other machines need the token that is in the address."""

from __future__ import annotations

import asyncio
import hmac
import logging
import secrets
import socket
import threading
from typing import Any
from urllib.parse import parse_qs, urlsplit

GATE_HEADER = "X-D4orm-Gate"
"""Header that the gate writes its token into, so that what is behind it can tell what has come through the gate."""

logger = logging.getLogger(__name__)

_HEAD = 16_384
_TIMEOUT = 10.0
_MOST_WAITING = 100
"""Connections that have not shown the token yet; further ones are closed."""


class AuthenticatingProxy:
    """Passes connections on to a port of this machine once they have shown the token.

    The page and its web socket are asked for by requests of their own, one per connection. The first brings the token
    in its address and gets it back as a cookie, which the others show.

    Raises:
        OSError: If it cannot listen there.
    """

    def __init__(self, host: str, port: int, target: int) -> None:
        self.token = secrets.token_urlsafe(24)
        self._target = target
        self._socket = socket.create_server((host, port))
        self.port = self._socket.getsockname()[1]
        self._waiting = 0
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(_tell_quietly)
        self._thread = threading.Thread(target=self._serve, name="d4orm-gate", daemon=True)
        self._ready = threading.Event()
        self._thread.start()
        self._ready.wait()

    def close(self) -> None:
        """Hang up and stop listening."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._socket.close()

    def _serve(self) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(asyncio.start_server(self._pass, sock=self._socket, limit=_HEAD))
        self._loop.call_soon(self._ready.set)
        self._loop.run_forever()
        server.close()
        self._loop.run_until_complete(_hang_up())
        self._loop.close()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await self._head(reader)
            if answer := self._answer(head):
                writer.write(answer)
                await writer.drain()
                return
            behind, ahead = await asyncio.open_connection("127.0.0.1", self._target)
            pumps = [asyncio.create_task(_pump(reader, ahead)), asyncio.create_task(_pump(behind, writer))]
            try:
                ahead.write(head[:-2] + f"{GATE_HEADER}: {self.token}\r\n\r\n".encode())
                await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for pump in pumps:
                    pump.cancel()
                ahead.close()
        except (OSError, asyncio.IncompleteReadError):
            pass  # whoever it was has gone, or speaks something else
        except asyncio.CancelledError:
            pass  # the gate closes; Python 3.11 complains of connections that end otherwise
        finally:
            writer.close()

    async def _head(self, reader: asyncio.StreamReader) -> bytes:
        """The first lines of a request, up to the empty one; nothing where there are too many.

        Raises:
            OSError: If they do not come, or too many others are waited for.
        """
        if self._waiting >= _MOST_WAITING:
            raise ConnectionRefusedError
        self._waiting += 1
        try:
            return await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _TIMEOUT)
        except asyncio.LimitOverrunError:
            return b""
        finally:
            self._waiting -= 1

    def _answer(self, head: bytes) -> bytes:
        """Return the answer to a request; nothing if it may pass. One that cannot be read has shown no token."""
        lines = head.decode("latin-1").split("\r\n")
        headers = {
            name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines[1:])
        }
        target = lines[0].partition(" ")[2].partition(" ")[0]
        if self._is_token(_token_in(target)):
            cookie = f"{self._cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            return _response("303 See Other", f"Location: /\r\nSet-Cookie: {cookie}\r\n")
        # Other pages of this host may have cookies of any form.
        cookies = dict(part.strip().partition("=")[::2] for part in headers.get("cookie", "").split(";"))
        own_page = headers.get("origin") in (None, f"http://{headers.get('host')}")
        if self._is_token(cookies.get(self._cookie, "")) and own_page:
            return b""
        return _response("403 Forbidden", "", b"open the address with the token that d4orm play has printed\n")

    @property
    def _cookie(self) -> str:
        return f"d4orm_play_{self.port}"

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self.token.encode())


def _token_in(target: str) -> str:
    """The token in an address; nothing where there is none, or the address is none."""
    try:
        return parse_qs(urlsplit(target).query).get("token", [""])[0]
    except ValueError:
        return ""


def _response(status: str, headers: str, body: bytes = b"") -> bytes:
    top = f"HTTP/1.1 {status}\r\n{headers}Content-Type: text/plain\r\nContent-Length: {len(body)}\r\n"
    return f"{top}Connection: close\r\n\r\n".encode() + body


async def _hang_up() -> None:
    """End what is under way, and let its connections close."""
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    await asyncio.sleep(0.01)


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while data := await reader.read(65536):
            writer.write(data)
            await writer.drain()
    except OSError:
        pass


def _tell_quietly(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Requests must not be able to fill the terminal."""
    logger.debug("%s", context["message"], exc_info=context.get("exception"))
