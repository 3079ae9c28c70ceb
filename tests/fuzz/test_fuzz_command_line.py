"""The command line: every call ends with 0 or 1, or with 2 and one line on stderr; never with a traceback."""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path
from typing import Any

import pytest
from fuzzing import NUMBER_LIKE, SCALAR, WORD, few
from hypothesis import given
from hypothesis import strategies as st

from d4orm_planners import cli
from d4orm_planners.registry import list_planners, list_policies

SCENARIO = "version: 1\nrobots:\n  - {model: velocity2d, start: [0, 0], goal: [0.3, 0]}\n"
TEXT = st.one_of(NUMBER_LIKE, WORD, SCALAR.map(str)).filter(lambda text: "\0" not in text and text.isprintable())
FILE = st.sampled_from(["small.yaml", "taken", "taken/x.npz", "absent.yaml", "absent/x.npz", ".", "", "/proc/x.npz"])
TARGET = st.sampled_from(["taken", "absent/x.npz", "x.txt", ".", "", "new.npz", "new.png"])
NAME = st.one_of(st.sampled_from(["circle", "small.yaml", "nope", "", "circle,small.yaml"]), TEXT)
SETTING = st.one_of(
    TEXT,
    st.builds("{}={}".format, st.sampled_from(["num_samples", "beta_start", "engine", "temperature", "x", ""]), TEXT),
)
OPTIONS: dict[str, Any] = {
    "--scenario": NAME,
    "--robots": TEXT,
    "--model": st.one_of(st.sampled_from(["velocity2d", "holonomic3d"]), TEXT),
    "--obstacles": TEXT,
    "--seed": TEXT,
    "--seeds": TEXT,
    "--planner": st.one_of(st.sampled_from(list_planners()), TEXT),
    "--policy": st.one_of(st.sampled_from([name for name in list_policies() if name not in ("ppo", "sac")]), TEXT),
    "--preset": st.one_of(st.just("paper"), TEXT),
    "--set": SETTING,
    "--engine": st.one_of(st.just("cpu"), TEXT),
    "--noise": TEXT,
    "--time-limit": TEXT,
    "--max-iterations": TEXT,
    "--trial-timeout": TEXT,
    "--workers": TEXT,
    "--deadlines": TEXT,
    "--num-envs": TEXT,
    "--steps": TEXT,
    "--lessons": TEXT,
    "--models": TEXT,
    "--engines": TEXT,
    "--config": FILE,
    "--picture": TARGET,
    "--out": TARGET,
    "--quiet": None,
    "--nonsense": TEXT,
}
# Whatever else they are told: nothing that takes long.
SMALL: dict[str, list[str]] = {
    "plan": ["--quiet", "--scenario", "small.yaml", "--max-iterations=1", "--set=num_samples=8", "--set=num_steps=1"],
    "run": ["--quiet", "--scenario", "small.yaml", "--policy", "goal"],
    "scenarios": [],
    "planners": [],
    "leaderboard": [],
    "node": [],
    # These do nothing, for the folder that they are to write to is a file.
    "demo": ["--out", "taken"],
    "evaluate": ["--out", "taken"],
    "robustness": ["--out", "taken"],
    "bench": ["--out", "taken"],
    "train": ["ppo", "--out", "taken"],
}
FOLDER = ("demo", "evaluate", "robustness", "bench", "train")


@st.composite
def calls(draw: st.DrawFn) -> list[str]:
    command = draw(st.one_of(st.sampled_from(list(SMALL)), st.just("plan"), st.just("run")))
    arguments = [command, *SMALL[command]]
    for option in draw(st.lists(st.sampled_from(list(OPTIONS)), min_size=1, max_size=3, unique=True)):
        if option == "--out" and command in FOLDER:
            continue
        value = OPTIONS[option]
        arguments.append(option if value is None else f"{option}={draw(value)}")
    if draw(st.integers(0, 5)) == 0:
        arguments.insert(draw(st.integers(1, len(arguments))), draw(st.one_of(FILE, TEXT)))
    return arguments


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yaml").write_text(SCENARIO)
    (tmp_path / "taken").write_text("mine")
    return tmp_path


def call(arguments: list[str]) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), pytest.raises(SystemExit) as exited:
        cli.main(arguments)
    return int(exited.value.code or 0), out.getvalue(), err.getvalue()


@few(100)
@given(arguments=calls())
def test_every_call_works_or_says_in_one_line_what_is_wrong(folder: Path, arguments: list[str]) -> None:
    before = sorted(folder.rglob("*"))
    status, out, err = call(arguments)
    assert status in (0, 1, 2), (status, err)
    assert "Traceback" not in out + err
    if status == 2:
        assert err.startswith("d4orm: ")
        assert err.endswith(os.linesep)
        assert err.count("\n") == 1, err
        assert len(err) > len("d4orm: .\n")
        assert sorted(folder.rglob("*")) == before, "something was left behind"
    assert (folder / "taken").read_text() == "mine"
    assert (folder / "small.yaml").read_text() == SCENARIO
    for path in set(folder.rglob("*")) - set(before):
        path.unlink()
