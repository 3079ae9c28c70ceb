"""Checks of what a page asks for, by the type of its message and against what the page offers.

A web socket may carry anything. What a message may be is written down here, once; all else goes no
further, and what does is encoded anew, so that nothing but what was checked is read behind it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
import viser
from msgspec import Meta
from viser.infra import ClientId

LARGEST_UPLOAD = 2_000_000
"""Bytes of a file."""

_LARGEST_COORDINATE = 1e9
_ROUNDING = 1e-3
"""Share of its step by which a slider's value may be off."""

Coordinate = Annotated[float, Meta(ge=-_LARGEST_COORDINATE, le=_LARGEST_COORDINATE)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Pixels = Annotated[float, Meta(ge=1, le=100_000)]
Name = Annotated[str, Meta(max_length=255)]


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
    """Tells messages that a page may send from all others.

    Args:
        server: The page.
    """

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

        Args:
            client: Its number.
            data: Anything.

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
