"""D-D4orm over Ray: the same rounds in other processes, which may be killed, and which nobody else can reach."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray_program

from d4orm_env.scenarios import make_problem
from d4orm_planners import make_planner
from d4orm_planners.cli import app as cli

LOOPBACK = {"0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"}
"""127.0.0.1, the same as an IPv6 address, and ::1, as the kernel writes them."""


@pytest.mark.cluster
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9 and -STOP")
def test_rounds_over_ray(subtests: pytest.Subtests) -> None:
    """One process for all parts: Ray, and every actor, takes seconds to start."""
    ran = subprocess.run([sys.executable, ray_program.__file__], capture_output=True, text=True, check=False)
    # Ray may have something to say before and after.
    lines = [line.removeprefix("RESULT ") for line in ran.stdout.splitlines() if line.startswith("RESULT ")]
    results: dict[str, Any] = dict(map(json.loads, lines))
    assert ran.returncode == 0, (*results, ran.stderr)

    for clip, (rewards, messages) in results["rounds"].items():
        with subtests.test("rounds in actors are those of threads", clip=clip):
            here, here_messages = ray_program.rounds("local", clip == "clipped")
            np.testing.assert_allclose(rewards, here, atol=1e-6)
            assert messages == here_messages == 6
    with subtests.test("rounds repeat, in an instance of their own too"):
        assert results["again"] == results["rounds"]["clipped"]
    with subtests.test("an instance that was there stays, and one of its own ends with the solve"):
        assert results["shared"]
        assert not results["left open"]
    for before, after, notes, solved in results["killed, 3 restarts"]:
        with subtests.test("an actor that is killed is restarted"):
            assert len(before) == len(after) == 2
            assert before[0] == after[0]
            assert before[1] != after[1]
            assert notes == ["the actor of node 1 was lost and restarted"]
            assert solved
    for before, after, notes, solved in results["killed, 0 restarts"]:
        with subtests.test("an actor that is killed too often is done without"):
            assert before[:1] == after
            assert len(notes) == 1
            assert notes[0].startswith("node 1 failed (ChildProcessError: its actor was lost for good (")
            assert solved
    with subtests.test("actors keep the time limit"):
        status, note, steps = results["in time"]
        assert (status, note) == ("time_limit", "")
        assert 0 < steps < 200000
    with subtests.test("actors that do not keep it are given up"):
        assert results["frozen"] == ["time_limit", "node 0 did not finish in time; node 1 did not finish in time", 0]
    if Path("/proc/net/tcp").exists():
        with subtests.test("an instance of its own listens on loopback only"):
            assert results["listening"]
            assert set(results["listening"]) <= LOOPBACK


def test_without_ray_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SystemExit) as exit_:
        cli.main(["plan", "--planner", "d-d4orm", "--set", "transport=ray"])
    assert exit_.value.code == 2
    assert capsys.readouterr().err == (
        "d4orm: transport 'ray' of d-d4orm needs ray; install it with: pip install 'd4orm-env[distributed]'\n"
    )


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"address": "auto"}, "address 'auto' goes with transport 'ray', not 'local'"),
        ({"transport": "ray", "address": "nowhere"}, "Ray address 'nowhere' is neither auto, nor local, nor"),
    ],
)
def test_a_bad_address_is_refused(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make_planner("d-d4orm", **settings)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1"])
def test_a_cluster_that_is_not_there_is_one_clear_error(address: str) -> None:
    planner = make_planner("d-d4orm", transport="ray", address=address)
    with pytest.raises(ConnectionError, match=rf"Ray cluster '{address}' cannot be reached \(ConnectionRefused"):
        planner.solve(make_problem("circle", num_robots=2))
