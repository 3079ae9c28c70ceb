"""A playground on this machine, and who talks to it without a browser."""

from __future__ import annotations

import gc
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import viser
from websockets.sync.client import ClientConnection, connect

from d4orm_env import Problem
from d4orm_planners.play.playground import Playground

TIMEOUT = 60.0


@contextmanager
def running(problem: Problem, *policies: str, **options: str) -> Iterator[Playground]:
    """A playground with its page."""
    shown: Any = Playground(problem, *policies, **options)
    thread = threading.Thread(target=shown.run, daemon=True)
    thread.start()
    try:
        yield shown
    finally:
        shown.stop()
        thread.join()
        shown.close()
        del shown
        gc.collect()  # viser leaves an event loop open, of which this test may warn and no other


def opened(
    raw: socket.socket, host: str, origin: str | None, headers: dict[str, str] | None = None
) -> ClientConnection:
    """A web socket over a connection, by a name and on behalf of a page."""
    claims: Any = {"origin": origin, "subprotocols": [f"viser-v{viser.__version__}"], "additional_headers": headers}
    return connect(f"ws://{host}/", sock=raw, max_size=None, **claims)


def reached(port: int, host: str = "127.0.0.1") -> socket.socket:
    """A connection to a port of this machine."""
    return socket.create_connection((host, port), timeout=TIMEOUT)


def visitor(playground: Playground) -> ClientConnection:
    """A web socket of this machine's, and what it says to begin with."""
    port = playground._server.get_port()
    connection = opened(reached(port), f"127.0.0.1:{port}", None)
    before = set(playground._server.get_clients())
    say(connection, CAMERA)
    until(lambda: set(playground._server.get_clients()) - before)
    return connection


def say(connection: ClientConnection, message: object) -> None:
    """Send a message as pages do."""
    connection.send(msgspec.msgpack.encode(message))


CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 9], "fov": 0.6, "near": 0.01, "far": 1000,
    "image_height": 800, "image_width": 1200, "look_at": [0, 0, 0], "up_direction": [0, 1, 0],
}  # fmt: skip


def update(control: Any, value: object, name: str = "value") -> dict[str, object]:
    """The message of a control that somebody has used."""
    return {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {name: value}}


def control(playground: Playground, label: str) -> Any:
    """The control with this label."""
    handles = playground._server.gui._gui_input_handle_from_uuid.values()
    return next(handle for handle in handles if handle.label == label)


def drag(phase: str, index: int | None, end: tuple[float, ...] = (0.3, 0.4, 0), **others: object) -> dict[str, object]:
    """The message of a robot that is dragged."""
    return {
        "type": "SceneNodeDragMessage", "phase": phase, "name": "/viewport_0/robots", "instance_index": index,
        "start_position": [0, 0, 0], "start_screen_pos": [0.5, 0.5], "end_position": end,
        "end_screen_pos": [0.5, 0.5], "button": "left", "modifier": None, "owner": "", **others,
    }  # fmt: skip


def until(condition: Callable[[], object]) -> None:
    """Wait for something that another thread does."""
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)
