"""D-D4orm over Ray: the same rounds in other processes, which may be killed, and which nobody else can reach."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planner_support import program

from d4orm_env.scenarios import make_problem
from d4orm_planners import cli, make_planner

SETTINGS: dict[str, Any] = {"engine": "cpu", "num_samples": 64, "num_steps": 5, "improve": True, "k": 2}

SOLVE = """
import json
from d4orm_env import make_problem
from d4orm_planners import make_planner
from d4orm_planners.distributed.ray_connection import RayConnection

if __name__ == "__main__":
    def solve(**settings):
        planner = make_planner("d-d4orm", transport="ray", **settings)
        return planner.solve(make_problem("circle", num_robots=4), seed=3, max_iterations=3)

    connection = RayConnection("local", "this test")
    times = {{True: 2, False: 1}}
    plans = {{clip: [solve(clip_between_iterations=clip, **{settings}) for _ in range(times[clip])] for clip in times}}
    shared = connection.ray.is_initialized()
    connection.close()
    solve(**{settings})
    print("RESULT", json.dumps([
        {{clip: [[record.reward for record in plan.history] for plan in pair] for clip, pair in plans.items()}},
        plans[True][0].metrics["messages"], shared, connection.ray.is_initialized(),
    ]))
"""

KILL = """
import json, os, signal, threading
from d4orm_env import make_problem
from d4orm_planners import make_planner
from d4orm_planners.search import Search
from d4orm_planners.distributed import ray_planner
from d4orm_planners.distributed.ray_connection import RayConnection

def kill(restarts, mode):
    ray_planner.RESTARTS = restarts
    planner = make_planner(
        "d-d4orm", engine="cpu", transport="ray", mode=mode, improve=True, patience=60, num_steps=400
    )
    search = Search(planner, make_problem("circle", num_robots=8), 0, None)
    notes = []
    try:
        notes.append(search.advance().note)
        crew = search.state.crew
        before = [node.search.planner.process for node in crew.alive]
        # Into an iteration, or nearly.
        timer = threading.Timer(0.1, os.kill, (before[1], signal.SIGKILL))
        timer.start()
        while len(notes) < 8 and not any(notes):
            notes.append(search.advance().note)
        timer.join()
        after = [node.search.planner.process for node in crew.alive]
    finally:
        search.close()
    plan = search.plan("stopped")
    return [before, after, [note for note in notes if note], plan.solved]

if __name__ == "__main__":
    connection = RayConnection("local", "this test")
    print("RESULT", json.dumps([kill({restarts}, mode) for mode in ("sync", "async")]))
    connection.close()
"""

OVERDUE = """
import json, os, signal
from d4orm_env import make_problem
from d4orm_planners import make_planner
from d4orm_planners.distributed import ray_planner
from d4orm_planners.distributed.ray_connection import RayConnection

def solve(patience):
    planner = make_planner("d-d4orm", engine="cpu", transport="ray", improve=True, patience=patience, num_steps=200000)
    return planner.solve(make_problem("circle", num_robots=8), time_limit=1)

if __name__ == "__main__":
    connection = RayConnection("local", "this test")
    in_time = solve(60)
    start = ray_planner.RayPlanner.start
    def frozen(planner):
        start(planner)
        os.kill(planner.process, signal.SIGSTOP)
    ray_planner.RayPlanner.start = frozen
    overdue = solve(0.1)
    plans = [[plan.status, plan.history[-1].note, plan.denoising_steps] for plan in (in_time, overdue)]
    print("RESULT", json.dumps(plans))
    connection.close()
"""

SOCKETS = """
import json, os
from pathlib import Path
from d4orm_env import make_problem
from d4orm_planners import make_planner

def family():
    "This process and all that it has started."
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            pass
    mine = {os.getpid()}
    while more := {child for child, parent in parents.items() if parent in mine} - mine:
        mine |= more
    return mine

def listening():
    "Addresses that they listen on, in the kernel's notation."
    sockets = set()
    for process in family():
        for link in Path(f"/proc/{process}/fd").glob("*"):
            try:
                sockets.add(os.readlink(link))
            except OSError:
                pass
    rows = [line.split() for name in ("tcp", "tcp6") for line in Path("/proc/net", name).read_text().splitlines()[1:]]
    return sorted({row[1].partition(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in sockets})

if __name__ == "__main__":
    heard = []
    planner = make_planner("d-d4orm", transport="ray", engine="cpu", num_samples=64, num_steps=5)
    problem = make_problem("circle", num_robots=2)
    planner.solve(problem, max_iterations=1, callback=lambda record: heard.extend(listening()))
    print("RESULT", json.dumps(heard))
"""


def result_of(tmp_path: Path, body: str) -> Any:
    result = program(tmp_path, body)
    assert result.returncode == 0, result.stderr
    # Ray may have something to say before and after.
    (line,) = [line for line in result.stdout.splitlines() if line.startswith("RESULT ")]
    return json.loads(line.removeprefix("RESULT "))


@pytest.mark.slow
def test_rounds_in_actors_are_those_of_threads(tmp_path: Path) -> None:
    rewards, messages, shared, still_there = result_of(tmp_path, SOLVE.format(settings=SETTINGS))
    assert messages == 6
    assert shared, "an instance that was there stays"
    assert not still_there, "an instance of its own ends with the solve"
    for clip in (True, False):
        first = rewards[json.dumps(clip)][0]
        assert all(again == first for again in rewards[json.dumps(clip)])
        planner = make_planner("d-d4orm", **SETTINGS, clip_between_iterations=clip)
        here = planner.solve(make_problem("circle", num_robots=4), seed=3, max_iterations=3)
        np.testing.assert_allclose(first, [record.reward for record in here.history], atol=1e-6)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_an_actor_that_is_killed_is_restarted(tmp_path: Path) -> None:
    for before, after, notes, solved in result_of(tmp_path, KILL.format(restarts=3)):
        assert len(before) == len(after) == 2
        assert before[0] == after[0]
        assert before[1] != after[1]
        assert notes == ["the actor of node 1 was lost and restarted"]
        assert solved


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_an_actor_that_is_killed_too_often_is_done_without(tmp_path: Path) -> None:
    for before, after, (note,), solved in result_of(tmp_path, KILL.format(restarts=0)):
        assert before[:1] == after
        assert note.startswith("node 1 failed (ChildProcessError: its actor was lost for good (")
        assert solved


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="needs kill -STOP")
def test_actors_keep_the_time_limit_and_those_that_do_not_are_given_up(tmp_path: Path) -> None:
    in_time, overdue = result_of(tmp_path, OVERDUE)
    assert in_time[:2] == ["time_limit", ""]
    assert 0 < in_time[2] < 200000
    assert overdue == ["time_limit", "node 0 did not finish in time; node 1 did not finish in time", 0]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="looks at Linux's sockets")
def test_an_instance_of_its_own_listens_on_loopback_only(tmp_path: Path) -> None:
    heard = result_of(tmp_path, SOCKETS)
    assert heard
    # 127.0.0.1, the same as an IPv6 address, and ::1.
    assert set(heard) <= {"0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"}


def test_without_ray_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SystemExit) as exit_:
        cli.main(["plan", "--planner", "d-d4orm", "--set", "transport=ray"])
    assert exit_.value.code == 2
    assert capsys.readouterr().err == (
        "d4orm: transport 'ray' of d-d4orm needs ray; install it with pip install \"d4orm-env[distributed]\"\n"
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
