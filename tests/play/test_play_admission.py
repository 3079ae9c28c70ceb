"""Who may drive a playground: its own page, and no page of somebody else's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest

from d4orm_env import make_problem

pytest.importorskip("viser")

import msgspec
from play_support import opened, reached, running, until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection

from d4orm_planners.play.playground import Playground

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # viser leaves a loop open


@pytest.fixture
def playground(request: pytest.FixtureRequest) -> Iterator[Playground]:
    scene = make_problem("circle", num_robots=2)
    with running(scene, "go-to-goal", host=getattr(request, "param", "127.0.0.1")) as shown:
        yield shown


def ticks(connection: ClientConnection, playground: Playground) -> bool:
    """Whether somebody who ticks a box of the page is obeyed, rather than hung up on."""
    box = playground._panel.paused
    told = {"type": "GuiUpdateMessage", "uuid": box._impl.uuid, "updates": {"value": True}}
    try:
        connection.send(msgspec.msgpack.encode(told))
        while not box.value:
            with suppress(TimeoutError):  # a page that is paused has no more to say
                connection.recv(timeout=0.1)
    except ConnectionClosed as closed:
        code = None if closed.rcvd is None else closed.rcvd.code
    else:
        return True
    finally:
        connection.close()
    assert code == 1008
    return False


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1:{port}", "http://127.0.0.1:{port}"),
        ("localhost:9000", "http://localhost:9000"),  # through a tunnel of SSH
        ("127.0.0.1:{port}", None),  # no browser
    ],
)
def test_its_own_page_drives(playground: Playground, host: str, origin: str | None) -> None:
    port = playground._server.get_port()
    connection = opened(reached(port), host.format(port=port), origin and origin.format(port=port))
    assert ticks(connection, playground)


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1:{port}", "http://elsewhere.example"),
        ("127.0.0.1:{port}", "http://127.0.0.1:1"),
        ("127.0.0.1:{port}", "https://127.0.0.1:{port}"),
        ("127.0.0.1:{port}", "null"),
        ("rebound.example:{port}", "http://rebound.example:{port}"),
        ("rebound.example:{port}", None),
        ("127.0.0.1.rebound.example:{port}", "http://127.0.0.1.rebound.example:{port}"),
    ],
)
def test_a_foreign_page_does_not(playground: Playground, host: str, origin: str | None) -> None:
    port = playground._server.get_port()
    connection = opened(reached(port), host.format(port=port), origin and origin.format(port=port))
    assert not ticks(connection, playground)
    until(lambda: not playground.clients)
    assert not playground._panel.paused.value


@pytest.mark.parametrize("playground", ["127.0.0.2"], indirect=True)
def test_nobody_goes_round_the_gate(playground: Playground) -> None:
    gate, behind = playground._gate, playground._server.get_port()
    assert gate is not None
    assert not ticks(opened(reached(behind), f"127.0.0.1:{behind}", None), playground)
    assert not ticks(opened(reached(behind), f"127.0.0.1:{behind}", None, {"X-D4orm-Gate": "guess"}), playground)
    with pytest.raises(InvalidStatus, match="403"):
        through(gate, None)
    assert ticks(through(gate, gate.token), playground)


def through(gate: Any, token: str | None) -> ClientConnection:
    """A web socket through a gate, with the cookie of who has shown a token."""
    cookie = {} if token is None else {"Cookie": f"d4orm_play_{gate.port}={token}"}
    return opened(reached(gate.port, "127.0.0.2"), f"127.0.0.2:{gate.port}", f"http://127.0.0.2:{gate.port}", cookie)
