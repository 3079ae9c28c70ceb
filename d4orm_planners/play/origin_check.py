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
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import msgspec
import viser
from msgspec import Meta
from viser.infra import ClientId, WebsockClientConnection
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed

from d4orm_planners.play.proxy import GATE_HEADER

LARGEST_UPLOAD = 2_000_000
"""Bytes of a file."""

_LARGEST_COORDINATE = 1e9
_ROUNDING = 1e-3
"""Share of its step by which a slider's value may be off."""

Coordinate = Annotated[float, Meta(ge=-_LARGEST_COORDINATE, le=_LARGEST_COORDINATE)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Pixels = Annotated[float, Meta(ge=1, le=100_000)]
Name = Annotated[str, Meta(max_length=255)]


LOOPBACK = ("127.0.0.1", "localhost", "::1")
_POLICY_VIOLATION = 1008
_LARGEST_MESSAGE = LARGEST_UPLOAD + 10_000
_MESSAGE_PERIOD = 0.002
"""Seconds from one message of a page to its next at least; a hand makes one every 16 ms."""


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
    """Tells messages that a page may send from all others."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._gui, self._scene = server.gui, server.scene
        self._checks: dict[type, Callable[[int, Any], None]] = {
            _Drag: self._check_drag,
            _Control: self._check_control,
            _Upload: self._check_upload,
            _Part: self._check_part,
        }

    def checked(self, client: int, data: str | bytes) -> bytes:
        """Return a client's message, encoded anew.

        Raises:
            msgspec.DecodeError: If it is no message of a page, or one with fields of other types or sizes.
            ValueError: If it asks for what the page does not offer.
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
            raise ValueError(f"{control.label} cannot be {_short(value)}; it takes {said}")

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


def _short(value: object) -> str:
    text = ascii(value)
    return text if len(text) <= 40 else text[:37] + "..."


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
