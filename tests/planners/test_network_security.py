"""TLS and access control as the documented example has them: who is of the team is heard, nobody else."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from network_support import free_endpoint, has_listeners, port_of, wait_until

from d4orm_planners.cli.node_command import load_node
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings, ZenohTransport

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
NODE = EXAMPLES / "node"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("openssl") is None or shutil.which("bash") is None, reason="needs openssl and bash"
    ),
]


@pytest.fixture(scope="module")
def configuration(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """The example's configuration file for a robot by its name, with certificates by the example's script."""
    folder = tmp_path_factory.mktemp("certificates")
    for robots in (["robot0=127.0.0.1"], ["robot1=127.0.0.1", "robot9=127.0.0.1"]):  # of one authority
        subprocess.run(["bash", str(NODE / "certificates.sh"), str(folder), *robots], check=True, capture_output=True)
    text = (NODE / "zenoh.json5").read_text()

    def write(robot: str) -> str:
        path = folder / f"{robot}.json5"
        own = text.replace("/etc/d4orm/ca.pem", str(folder / "ca.pem")).replace("/etc/d4orm", str(folder / robot))
        path.write_text(own)
        return str(path)

    return write


@pytest.fixture
def team(configuration: Callable[[str], str]) -> Iterator[tuple[str, ZenohTransport, ZenohTransport]]:
    """Where the first listens, and two connected robots of the team."""
    endpoint = free_endpoint().replace("tcp", "tls")
    first = ZenohTransport(ZenohSettings(listen=(endpoint,), config_file=configuration("robot0")))
    second = ZenohTransport(ZenohSettings(listen=(), connect=(endpoint,), config_file=configuration("robot1")))
    wait_until(lambda: has_listeners(first) and has_listeners(second), "a connection")
    yield endpoint, first, second
    first.close()
    second.close()


def test_robots_of_the_team_hear_each_other(team: tuple[str, ZenohTransport, ZenohTransport]) -> None:
    _, first, second = team
    first.publish(b"there")
    assert second.collect(timeout=60) == [b"there"]
    second.publish(b"and back")
    assert first.collect(timeout=60) == [b"and back"]


@pytest.mark.parametrize("stranger", ["another name", "no certificate", "no encryption"])
def test_a_stranger_neither_hears_nor_is_heard(
    stranger: str,
    team: tuple[str, ZenohTransport, ZenohTransport],
    configuration: Callable[[str], str],
    tmp_path: Path,
) -> None:
    endpoint, first, second = team
    settings: dict[str, Any] = {"listen": [], "connect": [endpoint]}
    if stranger == "another name":
        settings["config_file"] = configuration("robot9")
    elif stranger == "no certificate":
        settings["config_file"] = str(tmp_path / "zenoh.json5")
        authority = Path(configuration("robot0")).parent / "ca.pem"
        (tmp_path / "zenoh.json5").write_text(
            f"{{transport: {{link: {{tls: {{root_ca_certificate: '{authority}'}}}}}}}}"
        )
    else:
        settings["connect"] = [endpoint.replace("tls", "tcp")]
    outside = ZenohTransport(ZenohSettings.of(settings))
    try:
        # Long enough to connect, if it could; what is tested is that nothing comes of it.
        deadline = time.perf_counter() + 2
        while time.perf_counter() < deadline:
            outside.publish(b"let me in")
            first.publish(b"secret")
            assert outside.collect(timeout=0.1) == []
        assert not has_listeners(outside)
        assert set(second.collect()) == {b"secret"}
        assert first.collect() == []
    finally:
        outside.close()


@pytest.mark.parametrize("who", ["tb0", "operator", "guest"])
def test_robots_tell_states_and_operators_give_orders(who: str, tmp_path: Path) -> None:
    from d4orm_planners.serve import wire
    from d4orm_planners.tracking import ros_messages as ros

    names = [f"{name}=127.0.0.1" for name in ("server", who)]
    subprocess.run(["bash", str(NODE / "certificates.sh"), str(tmp_path), *names], check=True, capture_output=True)
    text = (EXAMPLES / "robots" / "zenoh.json5").read_text().replace("/etc/d4orm/ca.pem", str(tmp_path / "ca.pem"))
    (tmp_path / "server.json5").write_text(text.replace("/etc/d4orm", str(tmp_path / "server")))
    transport = text[: text.index("  // Robots say")] + "}"
    (tmp_path / "who.json5").write_text(transport.replace("/etc/d4orm", str(tmp_path / who)))
    endpoint, topics = free_endpoint().replace("tcp", "tls"), {"tb0/pose": "tb0", "tb0/goal": "operator"}
    ours = ZenohSettings(listen=(endpoint,), config_file=str(tmp_path / "server.json5"))
    theirs = ZenohSettings(listen=(), connect=(endpoint,), config_file=str(tmp_path / "who.json5"))
    with wire.RosSession(ours, 0, "d4orm") as server, wire.RosSession(theirs, 0, "other") as other:
        heard = {topic: server.subscriber(topic, wire.POSE) for topic in topics}
        said = {topic: other.publisher(topic, wire.POSE) for topic in topics}
        command, commanded = server.publisher("tb0/cmd_vel", wire.TWIST), other.subscriber("tb0/cmd_vel", wire.TWIST)
        seen, may, end = set(), {topic for topic, name in topics.items() if name == who}, time.perf_counter() + 30
        while time.perf_counter() < end and not (who != "guest" and seen == may | {"cmd_vel"}):
            end = min(end, time.perf_counter() + 2) if who == "guest" else end
            for publisher in said.values():
                publisher.publish(ros.make(wire.POSE, ros.header(0), ros.pose(np.zeros(2), 0.0)))
            command.publish(ros.twist(np.zeros(3)))
            time.sleep(0.05)
            seen |= {topic for topic in topics if heard[topic].take()} | ({"cmd_vel"} if commanded.take() else set())
    assert seen == (may | {"cmd_vel"} if who != "guest" else set())


def test_the_documented_file_of_a_node_is_a_good_one(tmp_path: Path) -> None:
    task = load_node(NODE / "node.yaml")
    config = task.planner.config
    assert config.zenoh is not None
    assert config.zenoh.config_file == str(NODE / "zenoh.json5")
    assert [port_of(endpoint) for endpoint in config.zenoh.listen + config.zenoh.connect] == [7447, 7447]
    # The access rules are about the key that the nodes use.
    assert f'key_exprs: ["{config.zenoh.namespace}/candidates"]' in (NODE / "zenoh.json5").read_text()
    assert yaml.safe_load((NODE / "node.yaml").read_text())["time_limit"] == task.time_limit
