"""Access to the playground: the check that requests are its own page's, and of the messages that this may send.

Any page in a browser may ask a port of this machine. The browser then tells on whose behalf it does (``Origin``) and by
which name it came (``Host``): a foreign page has another origin, and one that has had its own name point to this
machine (DNS rebinding) has a foreign host. A page for other machines has a token in its address instead, which the
first request brings and gets back as a cookie, and all others show.
"""

from __future__ import annotations

import asyncio
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from typing import Annotated, Any, Literal
from unittest.mock import patch
from urllib.parse import parse_qs

import msgspec
import viser
import websockets.asyncio.server
from msgspec import Meta
from viser.infra import ClientId, WebsockClientConnection
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from d4orm_env.core.arrays import short_repr

LARGEST_UPLOAD = 2_000_000  #: Bytes of a file
_LARGEST_COORDINATE = 1e9
_ROUNDING = 1e-3  #: Share of its step by which a slider's value may be off
Coordinate = Annotated[float, Meta(ge=-_LARGEST_COORDINATE, le=_LARGEST_COORDINATE)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Pixels = Annotated[float, Meta(ge=1, le=100_000)]
Name = Annotated[str, Meta(max_length=255)]


LOOPBACK = ("127.0.0.1", "localhost", "::1")
_LOCAL_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d+)?", re.IGNORECASE)
_LARGEST_MESSAGE = LARGEST_UPLOAD + 10_000
_MESSAGE_PERIOD = 0.002  #: Seconds from one message of a page to its next at least; a hand makes one every 16 ms


class _Message(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """A message, whose fields are those of viser's message of that name."""


class _Camera(_Message, tag="ViewerCameraMessage"):
    wxyz: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    position: Point
    fov: Coordinate
    near: Coordinate
    far: Coordinate
    image_height: Pixels
    image_width: Pixels
    look_at: Point
    up_direction: Point


class _Drag(_Message, tag="SceneNodeDragMessage"):
    phase: Literal["start", "update", "end"]
    name: Name
    instance_index: Annotated[int, Meta(ge=0)] | None
    start_position: Point
    start_screen_pos: tuple[float, float]
    end_position: Point
    end_screen_pos: tuple[float, float]
    button: Literal["left", "middle", "right"]
    modifier: Name | None
    owner: Name = ""


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    value: object


class _Control(_Message, tag="GuiUpdateMessage"):
    uuid: Name
    updates: _Value


class _Upload(_Message, tag="FileTransferStartUpload"):
    source_component_uuid: Name
    transfer_uuid: Name
    filename: Name
    mime_type: Name
    part_count: Annotated[int, Meta(ge=0)]
    size_bytes: Annotated[int, Meta(ge=0)]


class _Part(_Message, tag="FileTransferPart"):
    source_component_uuid: Name | None
    transfer_uuid: Name
    part_index: Annotated[int, Meta(ge=0)]
    content: bytes


_DECODER = msgspec.msgpack.Decoder(_Camera | _Drag | _Control | _Upload | _Part)


class MessageValidator:
    """Lets those messages of a page through that ask for what it offers; ``refuse`` is told of any else, and why."""

    def __init__(self, server: viser.ViserServer, refuse: Callable[[str], None]) -> None:
        self._gui, self._scene, self._refuse = server.gui, server.scene, refuse
        self._checks: dict[type, Callable[[int, Any], None]] = {
            _Drag: self._check_drag,
            _Control: self._check_control,
            _Upload: self._check_upload,
            _Part: self._check_part,
        }
        self._sockets = server._websock_server
        self._sockets.on_client_connect(self._attach)
        self._sockets.disconnect_all_clients()  # clients that were quicker than this

    async def _attach(self, client: WebsockClientConnection) -> None:
        connection = self._sockets._live_connections[client.client_id]
        connection.recv = partial(self._receive, connection, client.client_id)  # type: ignore[method-assign, assignment]

    async def _receive(self, connection: ServerConnection, client: int) -> bytes:
        """The next message that may come through; a connection with anything else is closed."""
        while True:
            await asyncio.sleep(_MESSAGE_PERIOD)
            data = await ServerConnection.recv(connection)
            try:
                return self.checked(client, data)
            except msgspec.ValidationError:
                pass  # a message that nothing listens to
            except (msgspec.DecodeError, RecursionError):
                await connection.close(CloseCode.POLICY_VIOLATION, "only the page of d4orm play may send messages")
            except ValueError as error:
                self._refuse(str(error))

    def checked(self, client: int, data: str | bytes) -> bytes:
        """Return a client's message, encoded anew.

        A DecodeError if it is no message of a page, or of other types or sizes, a ValueError if the page does not offer
        that.
        """
        if isinstance(data, str):
            raise msgspec.DecodeError("text where a page sends bytes")
        message = _DECODER.decode(data)
        if (check := self._checks.get(type(message))) is not None:
            check(client, message)
        return msgspec.msgpack.encode(message)

    def _check_control(self, client: int, message: _Control) -> None:
        control, value = self._gui._gui_input_handle_from_uuid.get(message.uuid), message.updates.value
        match control:
            case viser.GuiCheckboxHandle() | viser.GuiButtonHandle():
                offered, said = isinstance(value, bool), "true or false"
            case viser.GuiDropdownHandle():
                offered, said = value in control.options, "one of " + ", ".join(control.options)
            case viser.GuiSliderHandle() | viser.GuiNumberHandle():
                offered, said = _is_on_scale(value, control), f"{control.min} to {control.max} by {control.step}"
            case _:
                raise ValueError("a page has no such control; load it anew")
        if not offered:
            raise ValueError(f"{control.label} cannot be {short_repr(value)}; it takes {said}")

    def _check_drag(self, client: int, message: _Drag) -> None:
        # One that was taken away meanwhile is dragged to the end, and the session says that it is gone.
        key = (ClientId(client), message.name)
        under_way = None if message.phase == "start" else self._scene._active_drag_handles.get(key)
        node = self._scene._handle_from_node_name.get(message.name) if under_way is None else under_way[0]
        many, robot = getattr(node, "batched_positions", None), message.instance_index
        offered = robot is None if many is None else robot is not None and robot < len(many)
        if node is None or not offered:
            raise ValueError("what was dragged is not there any more; take another")

    def _check_upload(self, client: int, message: _Upload) -> None:
        if not isinstance(self._gui._gui_input_handle_from_uuid.get(message.source_component_uuid),
                          viser.GuiUploadButtonHandle):  # fmt: skip
            raise ValueError("a page has no such button; load it anew")
        if message.size_bytes > LARGEST_UPLOAD or message.part_count > message.size_bytes:
            raise ValueError(f"the file has {message.size_bytes} bytes; a scene has at most {LARGEST_UPLOAD}")
        if any(upload["client_id"] == client for upload in self._gui._current_file_upload_states.values()):
            raise ValueError("a file is on its way already; send one after the other")

    def _check_part(self, client: int, message: _Part) -> None:
        upload = self._gui._current_file_upload_states.get(message.transfer_uuid)
        if upload is None or upload["client_id"] != client:
            raise ValueError("part of a file that was not taken; send it again")
        if upload["transferred_bytes"] + len(message.content) > upload["total_bytes"]:
            raise ValueError("more of a file than it has bytes; send it again")


def _is_on_scale(value: object, control: Any) -> bool:
    """Check whether a value is one of a slider's, from its least by its step to its greatest."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not control.min <= value <= control.max:
        return False
    steps = (value - control.min) / control.step
    return value == control.max or abs(steps - round(steps)) <= _ROUNDING


class OriginCheck:
    """Answers requests that do not come from a page of the playground, before anything else looks at them.

    The secret ``token`` in the address, ``None`` for browsers on this machine, is kept by a cookie of this name.
    """

    def __init__(self, token: str | None, cookie: str) -> None:
        self._token, self._cookie = token, cookie

    def answer(self, request: Request) -> Response | None:
        """Return the answer to a request; ``None`` if it may pass."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        passes = len(hosts) == 1 and origins in ([], [f"http://{hosts[0]}"])
        if self._token is None:
            passes = passes and _LOCAL_HOST.fullmatch(hosts[0]) is not None
        elif _is_same(parse_qs(request.path.partition("?")[2]).get("token", [""])[0], self._token):
            cookie = f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/"
            return _response(HTTPStatus.SEE_OTHER, {"Location": "/", "Set-Cookie": cookie})
        else:
            # Other pages of this host may have cookies of any form.
            parts = ";".join(request.headers.get_all("Cookie")).split(";")
            cookies = dict(part.strip().partition("=")[::2] for part in parts)
            passes = passes and _is_same(cookies.get(self._cookie, ""), self._token)
        if passes:
            return None
        return _refusal(HTTPStatus.FORBIDDEN)

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Have a server of web sockets that is started meanwhile ask first; viser starts one and has no option for it.

        Raises RuntimeError if none was started, so that nothing would be checked.
        """
        serve, started = websockets.asyncio.server.serve, False

        def checked_serve(*given: Any, process_request: Callable[..., Any], **options: Any) -> Any:
            nonlocal started
            started = True
            options["max_size"] = _LARGEST_MESSAGE

            def first(connection: ServerConnection, request: Request) -> Any:
                try:
                    return self.answer(request) or process_request(connection, request)
                except OSError:  # no file can have that name
                    return _refusal(HTTPStatus.NOT_FOUND)

            return serve(*given, process_request=first, **options)

        with patch.object(websockets.asyncio.server, "serve", checked_serve):
            yield
        if not started:
            raise RuntimeError(f"viser {viser.__version__} starts no server that can be guarded; install viser 1.1")


def _is_same(given: str, secret: str) -> bool:
    return secrets.compare_digest(given.encode(errors="replace"), secret.encode())


def _refusal(status: HTTPStatus) -> Response:
    return _response(status, {}, b"open the address that d4orm play has printed\n")


def _response(status: HTTPStatus, headers: dict[str, str], body: bytes = b"") -> Response:
    common = {"Content-Type": "text/plain", "Content-Length": str(len(body)), "Connection": "close"}
    return Response(status, status.phrase, Headers(common | headers), body)
