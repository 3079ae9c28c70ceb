"""The zenoh transport on loopback: what arrives, what is refused, and that it waits and closes as promised."""

from __future__ import annotations

import subprocess
import sys
import threading
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from network_support import free_endpoint, has_listeners, wait_until

from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings, ZenohTransport

Join = Callable[..., ZenohTransport]


@pytest.fixture
def join() -> Iterator[Join]:
    """Opens ends; all are closed afterwards."""
    ends: list[ZenohTransport] = []

    def opened(**settings: Any) -> ZenohTransport:
        ends.append(ZenohTransport(ZenohSettings(**settings)))
        return ends[-1]

    yield opened
    for end in ends:
        end.close()


@pytest.fixture
def pair(join: Join) -> tuple[ZenohTransport, ZenohTransport]:
    """Two connected ends."""
    endpoint = free_endpoint()
    first, second = join(listen=[endpoint]), join(connect=[endpoint])
    wait_until(lambda: has_listeners(first) and has_listeners(second))
    return first, second


def test_messages_reach_everybody_else_and_not_the_sender(join: Join) -> None:
    endpoint = free_endpoint()
    first = join(listen=[endpoint])
    second, third = join(connect=[endpoint]), join(connect=[endpoint])
    got: dict[ZenohTransport, set[bytes]] = {end: set() for end in (first, second, third)}
    sent = {first: b"a", second: b"b", third: b"c"}

    def complete() -> bool:
        # Peers that know one another only by the first take their time to connect.
        for end, data in sent.items():
            end.publish(data)
        for end, messages in got.items():
            messages |= set(end.collect(timeout=0.1))
        return all(len(messages) == 2 for messages in got.values())

    wait_until(complete)
    assert got == {first: {b"b", b"c"}, second: {b"a", b"c"}, third: {b"a", b"b"}}


def test_big_messages_come_whole(pair: tuple[ZenohTransport, ZenohTransport]) -> None:
    first, second = pair
    data = bytes(range(256)) * 2000
    second.publish(data)
    assert first.collect(timeout=60) == [data]


def test_who_is_away_is_tried_again(join: Join) -> None:
    endpoint = free_endpoint()
    early = join(connect=[endpoint])
    early.publish(b"to nobody")
    assert early.collect() == []
    late = join(listen=[endpoint])
    wait_until(lambda: has_listeners(early))
    early.publish(b"to somebody")
    assert late.collect(timeout=60) == [b"to somebody"]


def test_two_solves_on_one_network_do_not_hear_each_other(join: Join) -> None:
    endpoint = free_endpoint()
    first = join(listen=[endpoint], namespace="team/1")
    other, second = join(connect=[endpoint], namespace="team/2"), join(connect=[endpoint], namespace="team/1")
    wait_until(lambda: has_listeners(second))
    assert not has_listeners(other)
    other.publish(b"stranger")
    second.publish(b"friend")
    assert first.collect(timeout=60) == [b"friend"]


def test_collecting_waits_for_a_message_or_the_end(pair: tuple[ZenohTransport, ZenohTransport]) -> None:
    first, second = pair
    for action, expected in ((lambda: first.publish(b"a"), [b"a"]), (second.close, [])):
        threading.Timer(0.05, action).start()
        assert second.collect(timeout=60) == expected
    second.close()
    second.publish(b"b")
    assert second.collect(timeout=60) == []


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_by_default_nothing_beyond_loopback_is_open(join: Join) -> None:
    join()
    opened = [
        (local.rpartition(":")[0], protocol)
        for protocol in ("tcp", "tcp6", "udp", "udp6")
        for local in _own_sockets(protocol)
    ]
    assert opened == [("0100007F", "tcp")]


def _own_sockets(protocol: str) -> list[str]:
    """Local addresses, in the kernel's hexadecimal form, that this process listens at or receives datagrams at."""
    own = {link.readlink().name for link in Path("/proc/self/fd").iterdir() if link.is_symlink()}
    rows = [line.split() for line in Path(f"/proc/net/{protocol}").read_text().splitlines()[1:]]
    return [row[1] for row in rows if f"socket:[{row[9]}]" in own and (row[3] == "0A" or protocol.startswith("udp"))]


def test_multicast_finds_others_on_this_machine(join: Join) -> None:
    # A namespace of its own, because nodes of other tests may be found as well.
    namespace = f"test/{uuid.uuid4()}"
    first, second = (join(multicast=True, namespace=namespace) for _ in range(2))
    wait_until(lambda: has_listeners(first) and has_listeners(second))
    first.publish(b"found")
    assert second.collect(timeout=60) == [b"found"]


def test_without_zenoh_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(ImportError, match=r"needs zenoh; install it with: pip install 'd4orm-env\[zenoh\]'"):
        ZenohTransport(ZenohSettings())


def test_an_end_that_nobody_closed_does_not_keep_the_process_from_ending() -> None:
    code = (
        "from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings, ZenohTransport\n"
        "end = ZenohTransport(ZenohSettings())\nprint('done')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    assert result.stdout == "done\n"


@given(st.text(max_size=30))
def test_any_text_is_an_endpoint_or_refused(text: str) -> None:
    for endpoint in (text, f"tcp/{text}", f"tcp/{text}:1", f"tcp/h:{text}"):
        try:
            kept = ZenohSettings(connect=(endpoint,)).connect
        except ValueError as error:
            kept = (endpoint,) if repr(endpoint) in str(error) else ()
        assert kept == (endpoint,)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"namespace": "a b"}, "namespace 'a b' is not of letters, digits"),
        ({"namespace": "a/*"}, "namespace 'a/\\*'"),
        ({"namespace": 3}, "namespace must be text, not 3"),
        ({"listen": "tcp/1.2.3.4:7447"}, "listen must be a list of endpoints, .*, not 'tcp/1.2.3.4:7447'"),
        ({"listen": ["1.2.3.4"]}, "listen has '1.2.3.4'; an endpoint is of the form PROTOCOL/HOST:PORT"),
        ({"listen": ["tcp/1.2.3.4:99999"]}, "listen has 'tcp/1.2.3.4:99999'"),
        ({"connect": ["tcp/1.2.3.4:0"]}, "connect has 'tcp/1.2.3.4:0'"),
        ({"connect": ["pigeon/1.2.3.4:1"]}, "connect has 'pigeon/1.2.3.4:1'.* with one of tcp, tls"),
        ({"connect": [7447]}, "connect has 7447"),
        ({"multicast": "yes"}, "multicast must be True or False, not 'yes'"),
        ({"grace_period": -1}, "grace_period is -1; it must be zero or more"),
        ({"colour": 1}, "'colour' is no setting of zenoh; it takes namespace, listen"),
    ],
)
def test_a_bad_setting_is_refused_by_name(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        ZenohSettings.of(settings)


def test_settings_are_a_mapping() -> None:
    with pytest.raises(ValueError, match=r"the settings of zenoh must be a mapping of namespace, .*, not 3"):
        ZenohSettings.of(3)
    assert ZenohSettings.of({"listen": ["tcp/[::1]:7447", "tls/localhost:1"]}).on_loopback
    assert not ZenohSettings.of({"listen": ["tcp/127.0.0.1:1", "tcp/0.0.0.0:1"]}).on_loopback


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, r"config_file .*zenoh.json5: No such file"),
        ("{mode:", r"config_file .*zenoh.json5: .*expected"),
        ("{colour: 1}", r"unknown field `colour`, expected one of `id`"),
        ("{listen: {endpoints: ['tcp/0.0.0.0:1']}}", r"has listen/endpoints; leave it to the setting listen"),
        ("{scouting: {multicast: {enabled: true}}}", r"has scouting/multicast/enabled; .* the setting multicast"),
    ],
)
def test_a_bad_configuration_file_is_refused(content: str | None, text: str, tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ValueError, match=text) as caught:
        ZenohTransport(ZenohSettings(config_file=str(path)))
    assert "\n" not in str(caught.value)


def test_a_port_that_is_taken_is_named(join: Join) -> None:
    endpoint = free_endpoint()
    join(listen=[endpoint])
    with pytest.raises(ValueError, match=f"zenoh cannot listen at {endpoint} .*Address already in use"):
        join(listen=[endpoint])
