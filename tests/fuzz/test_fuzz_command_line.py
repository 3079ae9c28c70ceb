"""The command line: every call ends with 0 or 1, or with 2 and one line on stderr; never with a traceback."""

from __future__ import annotations

import contextlib
import io
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import typer
from fuzzing import NUMBER_LIKE, SCALAR, WORD, few
from hypothesis import given
from hypothesis import strategies as st
from planner_support import CHEAP

from d4orm_planners.base.planner_registry import PLANNERS, list_planners, list_policies
from d4orm_planners.cli import app as cli

SCENARIO = "version: 1\nrobots:\n  - {model: velocity2d, start: [0, 0], goal: [0.3, 0]}\n"
TEXT = st.one_of(NUMBER_LIKE, WORD, SCALAR.map(str)).filter(lambda text: "\0" not in text and text.isprintable())
FILE = st.sampled_from(["small.yaml", "taken", "taken/x.npz", "absent.yaml", "absent/x.npz", ".", "", "/proc/x.npz"])
TARGET = st.sampled_from(["taken", "absent/x.npz", "x.txt", ".", "", "new.npz", "new.png"])
NAME = st.one_of(st.sampled_from(["small.yaml", "nope", "", "circle,small.yaml"]), TEXT)
SETTING_NAMES = sorted({field.name for kind in PLANNERS.values() for field in fields(kind.config_class)})
SETTING = st.one_of(st.builds("{}={}".format, st.sampled_from(SETTING_NAMES), st.one_of(NUMBER_LIKE, TEXT)), TEXT)
ACTOR = st.sampled_from([name for name in list_policies() if name not in ("ppo", "sac", "ipopt")])
TOLD = st.builds("{}:{}={}".format, ACTOR, st.sampled_from(["extra_margin", "deadline", "temperature", "x"]), TEXT)
VALUES: dict[str, Any] = {
    "--scenario": NAME,
    "--model": st.one_of(st.sampled_from(["velocity2d", "holonomic3d"]), TEXT),
    "--planner": st.one_of(st.sampled_from([name for name in list_planners() if name != "ipopt"]), TEXT),
    "--policy": st.one_of(ACTOR, TOLD, TEXT),
    "--preset": st.one_of(st.just("paper"), TEXT),
    "--set": SETTING,
    "--engine": st.one_of(st.just("cpu"), TEXT),
    "--config": FILE,
    "--picture": TARGET,
    "--animation": TARGET,
    "--out": TARGET,
}
"""Of options that take more than a number; all others get text of any kind."""

SMALL: dict[str, list[str]] = {
    "plan": ["--quiet", "--num-robots=2", "--max-iterations=1", "--set=num_samples=8", "--set=num_steps=1"],
    "run": ["--quiet", "--num-robots=2", "--policy=goal"],
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
    "dataset": ["--out", "taken"],
}
"""What keeps a call from taking long, whatever else it is told."""

FOLDER = ("demo", "evaluate", "robustness", "bench", "train", "dataset")


def options_of(command: str) -> list[Any]:
    """The options that a command has, however many there are one day."""
    parameters = typer.main.get_command(cli.app).get_command(None, command).params  # type: ignore[attr-defined]
    options = [parameter for parameter in parameters if parameter.opts[0].startswith("--")]
    return [option for option in options if option.name != "out" or command not in FOLDER]


OPTIONS = {command: options_of(command) for command in SMALL}
"""Asked for here: a strategy may not draw what importing a command's libraries draws."""


@st.composite
def calls(draw: st.DrawFn) -> list[str]:
    command = draw(st.one_of(st.sampled_from(list(SMALL)), st.just("plan"), st.just("run")))
    arguments = [command, *SMALL[command]]
    known = OPTIONS[command]
    for option in draw(st.lists(st.sampled_from(known), max_size=3, unique=True)) if known else []:
        name = draw(st.sampled_from([*option.opts, *option.secondary_opts]))
        arguments += [name] if option.is_flag else [name, draw(VALUES.get(option.opts[0], TEXT))]
    for _ in range(draw(st.sampled_from([0, 0, 0, 1]))):
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


def call_and_check(folder: Path, arguments: list[str]) -> None:
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


@few(120)
@given(arguments=calls())
def test_every_call_works_or_says_in_one_line_what_is_wrong(folder: Path, arguments: list[str]) -> None:
    call_and_check(folder, arguments)


@few(60)
@given(planner=st.sampled_from(list_planners()), data=st.data())
def test_every_setting_of_every_planner_works_or_is_refused(folder: Path, planner: str, data: st.DataObject) -> None:
    known = [field.name for field in fields(PLANNERS[planner].config_class)]
    small = [f"--set={name}={value}" for name, value in CHEAP.items() if name in known]
    setting = f"--set={data.draw(st.sampled_from(known))}={data.draw(NUMBER_LIKE)}"
    call_and_check(folder, ["plan", "--quiet", "--scenario=small.yaml", f"--planner={planner}", *small, setting])
