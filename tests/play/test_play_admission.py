"""Who may drive a playground: its own page, and no page of somebody else's."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from contextlib import suppress

import pytest

from d4orm_env import make_problem

pytest.importorskip("viser")

import msgspec
from play_support import opened, reached, running, update
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection

from d4orm_planners.play.origin_check import OriginCheck
from d4orm_planners.play.playground import Playground

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # viser leaves a loop open


@pytest.fixture
def playground(request: pytest.FixtureRequest) -> Iterator[Playground]:
    scene = make_problem("circle", num_robots=2)
    with running(scene, "go-to-goal", host=getattr(request, "param", "127.0.0.1")) as shown:
        yield shown


def ticks(connection: ClientConnection, playground: Playground) -> bool:
    """Whether somebody who ticks a box of the page is obeyed."""
    box = playground._panel.paused
    connection.send(msgspec.msgpack.encode(update(box, True)))
    while not box.value:
        with suppress(TimeoutError):  # a page that is paused has no more to say
            connection.recv(timeout=0.1)
    connection.close()
    return True


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
    with pytest.raises(InvalidStatus, match="403"):
        opened(reached(port), host.format(port=port), origin and origin.format(port=port))
    assert (
        asked(playground, "/", Host=host.format(port=port), **({} if origin is None else {"Origin": origin}))[0] == 403
    )
    assert not playground._server.get_clients()
    assert not playground._panel.paused.value


def asked(playground: Playground, path: str, **headers: str) -> tuple[int, str]:
    """Status and cookie of the page's answer."""
    connection = http.client.HTTPConnection(playground._server.get_host(), playground._server.get_port(), timeout=60)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status, answer.getheader("Set-Cookie") or ""


@pytest.mark.parametrize("path", ["/" + 7000 * "a", "/" + 256 * "%61", 3500 * "/a", "/assets", "/../secret", "/%00"])
def test_what_is_no_page_is_not_found(playground: Playground, path: str) -> None:
    assert asked(playground, path)[0] == 404


elsewhere = pytest.mark.parametrize("playground", ["127.0.0.2"], indirect=True)


@elsewhere
def test_only_who_has_the_token_comes_in(playground: Playground) -> None:
    port, token = playground._server.get_port(), playground.address.partition("=")[2]
    assert asked(playground, "/")[0] == 403
    assert asked(playground, "/?token=guess")[0] == 403
    assert asked(playground, "/", Cookie=f"d4orm_play_{port}=guess")[0] == 403
    status, cookie = asked(playground, f"/?token={token}")
    assert status == 303
    assert "HttpOnly" in cookie
    shown = cookie.partition(";")[0]
    assert asked(playground, "/", Cookie=f"a[b]=c; {shown}") == (200, "")
    assert asked(playground, "/", Cookie=shown, Origin="http://elsewhere.example")[0] == 403
    assert asked(playground, "/", Cookie=shown, Origin=f"http://127.0.0.2:{port}")[0] == 200


@elsewhere
def test_web_sockets_need_the_token_too(playground: Playground) -> None:
    port, token = playground._server.get_port(), playground.address.partition("=")[2]
    for shown in (None, "guess", token):
        cookie = {} if shown is None else {"Cookie": f"d4orm_play_{port}={shown}"}
        raw, origin = reached(port, "127.0.0.2"), f"http://127.0.0.2:{port}"
        if shown == token:
            assert ticks(opened(raw, f"127.0.0.2:{port}", origin, cookie), playground)
        else:
            with pytest.raises(InvalidStatus, match="403"):
                opened(raw, f"127.0.0.2:{port}", origin, cookie)


def test_a_server_that_nobody_can_guard_is_an_error() -> None:
    with pytest.raises(RuntimeError, match="install viser"), OriginCheck(None, "cookie").installed():
        pass
