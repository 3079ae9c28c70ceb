"""Files and messages from elsewhere: read as what they are, or refused in one line that names them."""

from __future__ import annotations

import contextlib
import io
import sqlite3
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fuzzing import PLAIN, SCALAR, all_finite, damaged, few, refused, spoiled
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from planner_support import hop_problem

from d4orm_env import load_map, load_problem, make_problem, verify
from d4orm_env.core.problem import Problem
from d4orm_planners import Plan, make_planner
from d4orm_planners.cli.node_command import load_node
from d4orm_planners.d_d4orm.transport import Message, decode, encode
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.evaluation.store import Trial, TrialStore

PROBLEM = hop_problem(2, horizon=4)
ROBOT = {"model": "holonomic2d", "start": [0, 0], "goal": [2, 0], "velocity": [0.1, 0], "radius": 0.15}
EXPLICIT = {
    "version": 1, "name": "x", "dt": 0.1, "horizon": 20, "margin": 0.05, "goal_radius": 0.075, "goal_speed": 0.5,
    "robots": [ROBOT, {"model": "differential_drive", "start": [0, 2], "goal": [2, 2], "max_turn_rate": 1.5}],
    "world": {
        "bounds": {"lower": [-5, -5], "upper": [5, 5]},
        "circles": [{"center": [1, -2], "radius": 0.3}],
        "boxes": [{"lower": [-2, -2], "upper": [-1, -1]}],
    },
}  # fmt: skip
SHORT = {"version": 1, "scenario": "random", "num_robots": 3, "seed": 1, "arguments": {"size": 6.0}}
NODE = {
    "node": 0, "nodes": 2, "problem": {"scenario": "circle", "num_robots": 2}, "time_limit": 5, "out": "plan.npz",
    "seed": 3, "settings": {"num_samples": 64}, "zenoh": {"listen": ["tcp/127.0.0.1:0"]},
}  # fmt: skip
MAP = {
    "image": "map.png", "resolution": 0.5, "origin": [-1, 2, 0], "negate": 0, "mode": "trinary",
    "occupied_thresh": 0.65, "free_thresh": 0.196,
}  # fmt: skip
GRID = b"type octile\nheight 3\nwidth 4\nmap\n....\n.@ES\nG..T\n"
ROWS = b"version 1\n0\tgrid.map\t4\t3\t0\t0\t3\t0\t3.5\n1\tgrid.map\t4\t3\t0\t2\t3\t1\t4\n"
LONG = 1_000


def check_problem(problem: Problem) -> None:
    """A problem that was accepted can be stepped, whatever the robots do, and stays finite."""
    engine = get_sampling_engine("cpu")
    for sign in (0, 1, -1):
        controls = sign * np.where(np.isfinite(problem.team.control_limits), problem.team.control_limits, 0)
        states, arrived = problem.start, np.zeros(problem.num_robots, bool)
        for _ in range(3):
            step = engine.step(problem.arrays, states, arrived, controls.astype(np.float32))
            states, arrived = step.states, step.arrived
            assert all_finite(step.states, step.controls, step.rewards)


@few(150)
@given(document=st.one_of(spoiled(EXPLICIT), spoiled(SHORT), PLAIN))
def test_a_scenario_file_makes_a_problem_or_is_refused(tmp_path: Path, document: Any) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text(yaml.safe_dump(document, allow_unicode=True), encoding="utf-8")
    problem, _ = refused(lambda: load_problem(path), path.name)
    if problem is not None:
        check_problem(problem)


@few(60)
@given(content=st.one_of(damaged(yaml.safe_dump(EXPLICIT).encode()), st.binary(max_size=60), st.text().map(str.encode)))
def test_bytes_that_may_be_a_scenario_file_likewise(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_bytes(content)
    problem, _ = refused(lambda: load_problem(path), path.name)
    if problem is not None:
        check_problem(problem)


@few(60)
@given(document=spoiled(MAP), kind=st.sampled_from(["L", "LA", "RGB", "RGBA"]), seed=st.integers(0, 2**32 - 1))
def test_a_map_server_file_makes_a_world_or_is_refused(tmp_path: Path, document: Any, kind: str, seed: int) -> None:
    pixels = np.random.default_rng(seed).choice(np.array([0, 205, 254, 255], np.uint8), (4, 5, len(kind)))
    Image.fromarray(pixels[..., 0] if kind == "L" else pixels).save(tmp_path / "map.png")
    path = tmp_path / "map.yaml"
    path.write_text(yaml.safe_dump(document, allow_unicode=True), encoding="utf-8")
    world, _ = refused(lambda: load_map(path), str(tmp_path))
    if world is not None:
        rows, columns = np.nonzero(pixels[..., -1] == 0 if kind[-1] == "A" else np.zeros((4, 5), bool))
        lower, upper = world.bounds.astype(np.float64)
        transparent = lower + (upper - lower) * np.stack([(columns + 0.5) / 5, (3.5 - rows) / 4], axis=-1)
        assert (world.clearance(transparent) < 0).all()


@few(100)
@given(grid=st.one_of(st.just(GRID), damaged(GRID)), rows=st.one_of(st.just(ROWS), damaged(ROWS)))
def test_a_moving_ai_map_and_its_scenario_likewise(tmp_path: Path, grid: bytes, rows: bytes) -> None:
    names = tmp_path / "grid.map", tmp_path / "grid.scen"
    for path, content in zip(names, (grid, rows), strict=True):
        path.write_bytes(content)
    problem, _ = refused(
        lambda: make_problem("map", 2, map=names[0], scenario_file=names[1]), "grid.", "scenario 'map'"
    )
    if problem is not None:
        check_problem(problem)


@few(60)
@given(document=spoiled(NODE))
def test_a_nodes_file_makes_a_task_or_is_refused(tmp_path: Path, document: Any) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(yaml.safe_dump(document, allow_unicode=True), encoding="utf-8")
    refused(lambda: load_node(path), path.name)


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("plan") / "plan.npz"
    make_planner("d4orm", engine="cpu", num_samples=16, num_steps=1).solve(PROBLEM, max_iterations=1).save(path)
    return path.read_bytes()


def check_plan(path: Path) -> None:
    """A plan that was accepted is whole, finite, and solved only if the judge says so."""
    loaded, _ = refused(lambda: Plan.load(path), path.name)
    if loaded is not None:
        problem = loaded.problem
        assert loaded.controls.shape == (problem.horizon, problem.num_robots, problem.control_size)
        assert all_finite(loaded.controls, loaded.trajectory.states, loaded.trajectory.rewards)
        assert not loaded.solved or verify(problem, loaded.controls).ok


@few(80)
@given(data=st.data())
def test_a_damaged_plan_file_is_refused(tmp_path: Path, plan: bytes, data: st.DataObject) -> None:
    path = tmp_path / "plan.npz"
    path.write_bytes(data.draw(damaged(plan)))
    check_plan(path)


ARRAYS = st.one_of(
    SCALAR.map(lambda value: np.array(str(value))),
    st.floats(width=32).map(lambda value: np.full((4, 2, 2), value, np.float32)),
    st.sampled_from([np.zeros(0), np.zeros((4, 2)), np.zeros((2, 4, 2, 2)), np.full((4, 2, 2), 1e6), np.array(["x"])]),
    st.sampled_from([np.zeros((4, 2, 2), kind) for kind in ("bool", "complex64", "int8", "M8[s]", "S3", "V4")]),
)


@few(80)
@given(data=st.data())
def test_a_plan_file_with_other_members_is_refused(tmp_path: Path, plan: bytes, data: st.DataObject) -> None:
    path = tmp_path / "plan.npz"
    with zipfile.ZipFile(io.BytesIO(plan)) as whole:
        members = {name: whole.read(name) for name in whole.namelist()}
    name = data.draw(st.sampled_from([*members, "extra.npy", "extra.txt", "../outside.npy"]))
    kind = data.draw(st.sampled_from(["drop", "array", "damage", "text"]))
    if kind == "array" or name not in members:
        content = io.BytesIO()
        np.save(content, data.draw(ARRAYS), allow_pickle=False)
        members[name] = content.getvalue()
    elif kind == "drop":
        del members[name]
    elif kind == "damage":
        members[name] = data.draw(damaged(members[name]))
    else:
        members[name] = data.draw(st.binary(max_size=40))
    with zipfile.ZipFile(path, "w") as spoilt:
        for member, content in members.items():
            spoilt.writestr(member, content)
    check_plan(path)
    assert not (tmp_path.parent / "outside.npy").exists()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "trials.sqlite"
    common: dict[str, Any] = {
        "policy": "go-to-goal",
        "config": "{}",
        "problem": "abc",
        "control_noise_std": 0.0,
        "label": "go-to-goal",
    }
    common |= {"scenario": "circle", "num_robots": 2, "model": "holonomic2d", "dt": 0.1, "success": True, "steps": 60}
    TrialStore(path).add(*(Trial(seed=seed, **common) for seed in range(3)))
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")
    return path


def read_store(path: Path) -> None:
    trials, _ = refused(lambda: TrialStore.existing(path).trials(), path.name)
    assert trials is None or all(isinstance(trial, Trial) for trial in trials)


@few(60)
@given(data=st.data())
def test_a_damaged_store_is_read_or_refused(tmp_path: Path, store: Path, data: st.DataObject) -> None:
    path = tmp_path / "trials.sqlite"
    for stale in tmp_path.glob("trials.sqlite*"):
        stale.unlink()
    content = bytearray(store.read_bytes())
    # Places and bytes rather than damaged(): a failure then shows these, and not the whole store.
    change = st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255))
    for position, byte in data.draw(st.lists(change, max_size=4), label="changes"):
        content[position] = byte
    length = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))), label="length")
    path.write_bytes(content[:length])
    read_store(path)


CELL = st.one_of(st.none(), st.integers(-(2**63), 2**63 - 1), st.floats(), st.text(max_size=5), st.binary(max_size=5))
COLUMNS = (
    "control_noise_std",
    "seed",
    "num_robots",
    "dt",
    "success",
    "verified",
    "wall_time",
    "steps",
    "config",
    "history",
    "error",
)


@few(60)
@given(column=st.sampled_from(COLUMNS), cell=CELL)
def test_a_store_with_another_cell_is_read_or_refused(tmp_path: Path, store: Path, column: str, cell: Any) -> None:
    from d4orm_planners.evaluation.leaderboard import leaderboard

    path = tmp_path / "trials.sqlite"
    for stale in tmp_path.glob("trials.sqlite*"):
        stale.unlink()
    path.write_bytes(store.read_bytes())
    with contextlib.closing(sqlite3.connect(path)) as connection, contextlib.suppress(sqlite3.IntegrityError):
        connection.execute(f"UPDATE trials SET {column} = ? WHERE seed = 1", (cell,))
        connection.commit()
    trials, _ = refused(lambda: TrialStore.existing(path).trials(), path.name)
    if trials is not None:
        assert isinstance(leaderboard(trials), str)


MESSAGE = encode(Message(1, 3, np.ones((4, 2, 2), np.float32), 0.5, True), PROBLEM)


@few(200)
@given(data=st.one_of(damaged(MESSAGE), st.binary(max_size=200)))
def test_a_message_is_whole_or_dropped(data: bytes) -> None:
    message, _ = refused(lambda: decode(data, PROBLEM, num_nodes=2))
    if message is not None:
        assert message.node < 2
        assert message.controls.shape == (4, 2, 2)
        assert all_finite(message.controls, message.reward)
