"""``d4orm node``: its file, and real processes on loopback that are killed, stopped and disagree on nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from network_support import TIMEOUT, free_endpoint, wait_until
from planner_support import hop_problem, walled_in_problem

from d4orm_env.scenarios import make_problem, save_problem
from d4orm_env.verify import verify
from d4orm_planners.base.plan import Plan
from d4orm_planners.cli import app as cli
from d4orm_planners.cli.node_command import load_node

GOOD: dict[str, Any] = {
    "node": 1,
    "nodes": 2,
    "problem": {"scenario": "circle", "num_robots": 4},
    "time_limit": 60,
    "out": "plan.npz",
    "settings": {"engine": "cpu"},
}


def write(folder: Path, name: str = "node.yaml", **changes: Any) -> Path:
    """A node's file; a change to ``None`` leaves the field out."""
    path = folder / name
    content = {key: value for key, value in {**GOOD, **changes}.items() if value is not None}
    path.write_text(yaml.safe_dump(content))
    return path


class Process:
    """A running ``d4orm node``."""

    def __init__(self, path: Path) -> None:
        command = [sys.executable, "-m", "d4orm_planners.cli.app", "node", "--config", str(path)]
        self.lines: list[str] = []
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=path.parent.parent
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    def says(self, text: str, times: int = 1) -> None:
        """Wait until it has said something."""
        wait_until(lambda: "\n".join(self.lines).count(text) >= times, f"{text!r} of {self.lines}")

    def goes_on(self) -> None:
        """Wait until it has said more than what may have been on its way."""
        told = len(self.lines)
        wait_until(lambda: len(self.lines) > told + 2, "going on")

    def end(self) -> int:
        """Its exit status."""
        status = self.process.wait(3 * TIMEOUT)
        self._reader.join(TIMEOUT)
        if status < 0:
            sys.stdout.write("\n".join(self.lines))  # which pytest shows if the test fails
        return status


@pytest.fixture
def start(tmp_path: Path):
    """Starts node processes; whoever still runs is killed afterwards."""
    started: list[Process] = []

    def begin(**changes: Any) -> Process:
        started.append(Process(write(tmp_path, f"node{changes['node']}.yaml", **changes)))
        return started[-1]

    yield begin
    for one in started:
        one.process.kill()
        one.process.wait()
        one.process.stdout.close()


def best_of(process: Process) -> str:
    (line,) = [line for line in process.lines if " ends (" in line]
    return line.partition(": ")[2]


@pytest.mark.slow
def test_all_nodes_end_and_name_the_same_best_candidate(start: Any, tmp_path: Path) -> None:
    endpoint, problem = free_endpoint(), make_problem("circle", num_robots=4)
    save_problem(problem, tmp_path / "team.yaml")
    nodes = [
        start(
            node=node,
            nodes=3,
            problem="team.yaml",
            out=f"plan{node}.npz",
            zenoh={"connect": [endpoint], "grace_period": TIMEOUT}
            if node
            else {"listen": [endpoint], "grace_period": TIMEOUT},
        )
        for node in range(3)
    ]
    assert [node.end() for node in nodes] == [0, 0, 0]
    assert len({best_of(node) for node in nodes}) == 1
    assert "best candidate solves the problem" in nodes[0].lines[-2]
    for node in range(3):
        assert any(f"heard from node {node}" in other.lines for other in nodes)
        plan = Plan.load(tmp_path / f"plan{node}.npz")
        assert plan.problem.digest == problem.digest
        assert verify(problem, plan.controls).ok


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_the_others_go_on_when_a_node_is_killed_while_it_plans(start: Any, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    save_problem(hop_problem(2), tmp_path / "hop.yaml")
    settings = {"engine": "cpu", "num_samples": 192, "num_steps": 20, "improve": True, "timeout": 0.2}
    # All would plan on for long, and the others know each other only by the one that is killed.
    common = {"nodes": 3, "problem": "hop.yaml", "settings": settings, "time_limit": 10 * TIMEOUT}
    victim = start(node=0, zenoh={"listen": [endpoint]}, **common)
    victim.says("iteration 1 ")
    nodes = {node: start(node=node, out=f"plan{node}.npz", zenoh={"connect": [endpoint]}, **common) for node in (1, 2)}
    for node in nodes.values():
        node.says("heard from node 0")
    os.kill(victim.process.pid, signal.SIGKILL)
    assert victim.end() == -signal.SIGKILL
    for number, node in nodes.items():
        node.goes_on()
        node.process.send_signal(signal.SIGINT)
        assert node.end() == 0
        plan = Plan.load(tmp_path / f"plan{number}.npz")
        assert plan.status == "interrupted"
        assert verify(plan.problem, plan.controls).ok
    assert not (tmp_path / GOOD["out"]).exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_node_with_the_best_so_far(number: int, start: Any, tmp_path: Path) -> None:
    save_problem(walled_in_problem(), tmp_path / "ring.yaml")
    node = start(node=0, nodes=2, problem="ring.yaml", time_limit=10 * TIMEOUT)
    node.says("iteration 2 ")
    node.process.send_signal(number)
    assert node.end() == 1
    assert node.lines[-2].startswith("node 0 ends (interrupted): best candidate does not solve the problem")
    plan = Plan.load(tmp_path / "plan.npz")
    assert plan.status == "interrupted"
    assert not plan.solved
    assert plan.controls.any()


@pytest.mark.slow
def test_what_cannot_be_solved_in_time_is_said_to_be_unsolved(start: Any, tmp_path: Path) -> None:
    save_problem(walled_in_problem(), tmp_path / "ring.yaml")
    node = start(node=0, nodes=2, problem="ring.yaml", time_limit=1)
    assert node.end() == 1
    assert node.lines[-2].startswith("node 0 ends (time limit): best candidate does not solve the problem")
    assert Plan.load(tmp_path / "plan.npz").status == "time_limit"


def test_a_file_means_a_node(tmp_path: Path) -> None:
    settings = {"planner": "d4orm-d", "selection": "max", "num_samples": 512}
    zenoh = {"namespace": "team/1", "config_file": "zenoh.json5"}
    task = load_node(write(tmp_path, seed=7, settings=settings, zenoh=zenoh))
    config = task.planner.config
    assert (config.node, config.nodes, config.transport, config.mode) == (1, 2, "zenoh", "async")
    assert (config.node_planner.name, config.selection, config.refinement.num_samples) == ("d4orm-d", "max", 512)
    assert config.zenoh is not None
    assert config.zenoh.namespace == "team/1"
    assert config.zenoh.config_file == str(tmp_path / "zenoh.json5")
    assert (task.seed, task.time_limit, task.out) == (7, 60.0, tmp_path / "plan.npz")
    np.testing.assert_array_equal(task.problem.start, make_problem("circle", num_robots=4).start)


def test_a_file_names_the_map_of_its_problem(tmp_path: Path) -> None:
    rows = ("type octile", "height 3", "width 6", "map", "......", "..@@..", "......")
    Path(tmp_path, "room.map").write_text("\n".join(rows) + "\n", encoding="utf-8")
    task = load_node(write(tmp_path, problem={"scenario": "map", "map": "room.map", "cell": 0.6, "num_robots": 2}))
    same = make_problem("map", map=tmp_path / "room.map", cell=0.6, num_robots=2)
    assert task.problem.digest == same.digest
    for wrong, text in (({"map": "nowhere.map"}, "nowhere"), ({"map": "room.map", "colour": 3}, "colour")):
        with pytest.raises(ValueError, match=f"problem: .*{text}"):
            load_node(write(tmp_path, problem={"scenario": "map", **wrong}))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"colour": 1}, "unknown field 'colour'; known are node, nodes, problem"),
        ({"time_limit": None}, "field 'time_limit' is missing"),
        ({"time_limit": 0}, "time_limit is 0; it must be positive"),
        ({"time_limit": "soon"}, "time_limit must be a number, not 'soon'"),
        ({"node": 2}, "node is 2; of 2 nodes the last one is 1"),
        ({"node": -1}, "node is -1; it must be at least 0"),
        ({"nodes": "two"}, "nodes must be a whole number, not 'two'"),
        ({"seed": -1}, "seed is -1; it must be at least 0"),
        ({"out": 3}, "out must be a path, not 3"),
        ({"settings": [1]}, r"settings must be a mapping of fields, not \[1\]"),
        ({"settings": {"num_sample": 3}}, "'num_sample' is no setting of planner 'd-d4orm'; it takes"),
        ({"settings": {"nodes": 3}}, "settings has 'nodes', which is a field of the file itself"),
        ({"settings": {"mode": "sync"}}, "settings has 'mode', which is the same for every node of a network"),
        ({"settings": {"num_samples": 3}}, "num_samples is 3 for 2 nodes together"),
        ({"zenoh": {"port": 3}}, "'port' is no setting of zenoh; it takes namespace"),
        ({"zenoh": {"listen": ["here"]}}, "listen has 'here'; an endpoint is of the form"),
        ({"zenoh": []}, r"zenoh must be a mapping of fields, not \[\]"),
        ({"problem": 3}, "problem must be a scenario file or a scenario with its arguments, not 3"),
        ({"problem": {"scenario": "square"}}, "problem: scenario 'square' is unknown"),
        ({"problem": {"scenario": "circle", "colour": 3}}, "problem: scenario 'circle' takes no argument 'colour'"),
        ({"problem": "nowhere.yaml"}, "nowhere.yaml: cannot be read"),
    ],
)
def test_a_bad_file_is_refused_by_field(changes: dict[str, Any], text: str, tmp_path: Path) -> None:
    path = write(tmp_path, **changes)
    with pytest.raises(ValueError, match=f"{path.name}: .*{text}") as caught:
        load_node(path)
    assert "\n" not in str(caught.value)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 3) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=8), inner, max_size=2),
    max_leaves=4,
)


@given(st.sampled_from([*GOOD, "seed", "zenoh", "colour"]), VALUES)
def test_any_value_of_a_field_is_taken_or_refused(field: str, value: Any) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), **{field: value})
        complaint = str(path)
        try:
            load_node(path)
        except ValueError as error:
            complaint = str(error)
        assert complaint.startswith(str(path))


def test_what_is_no_file_of_a_node_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none.yaml: cannot be read \(No such file"):
        load_node(tmp_path / "none.yaml")
    for content, text in (("- 1", "the file must be a mapping"), ("a: [", "is not YAML"), ("!!python/x 1", "tag")):
        (tmp_path / "bad.yaml").write_text(content)
        with pytest.raises(ValueError, match=f"bad.yaml: .*{text}"):
            load_node(tmp_path / "bad.yaml")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"colour": 1}, "unknown field 'colour'"),
        ({"out": "plan.txt"}, "must end in .npz"),
        ({"out": "nowhere/plan.npz"}, "does not exist; create it"),
        ({"zenoh": {"config_file": "none.json5"}}, "none.json5: No such file"),
        ({"zenoh": {"config_file": "/dev/zero"}}, "/dev/zero: is not a file; give the path of a JSON5 file"),
    ],
)
def test_bad_input_is_one_line_and_status_two(
    changes: dict[str, Any], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, **changes)
    with pytest.raises(SystemExit) as exit_:
        cli.main(["node", "--config", str(path)])
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert text in line
    assert list(tmp_path.iterdir()) == [path]
