"""Policies and planners that users bring: given themselves, by import path, registered, or by entry points."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from env_support import line_problem
from registry_support import forgetting

from d4orm_env import navigation_v0
from d4orm_env.core.errors import UnknownKeywordError
from d4orm_env.envs.joint_state import split_state
from d4orm_planners import (
    Iteration,
    OpenLoop,
    Planner,
    PlannerConfig,
    Policy,
    evaluate,
    list_planners,
    list_policies,
    make_planner,
    make_policy,
    register_planner,
    register_policy,
    run_episode,
)
from d4orm_planners.base.names import PLANNERS, POLICIES
from d4orm_planners.base.planner_registry import describe_policy
from d4orm_planners.base.settings import CheckedSettings, Positive
from d4orm_planners.cli import app as cli
from d4orm_planners.evaluation.store import STORE, TrialStore
from d4orm_planners.rl.dataset import Demonstrations

ROOT = Path(__file__).resolve().parents[2]
PROBLEM = line_problem([9.0, 9.0, 9.0], horizon=20)


class Push(Policy):
    """Pushes everyone along the first axis."""

    def __init__(self, strength: float = 1.0) -> None:
        self.strength = strength

    def act(self, observations: dict[str, Any], state: Any) -> dict[str, Any]:
        return {agent: np.array([self.strength, 0]) for agent in observations}


@dataclass(frozen=True, kw_only=True)
class PullConfig(CheckedSettings):
    strength: Positive = 1.0


class Pull(Push):
    """Pushes, with settings that are checked."""

    config_class = PullConfig

    def __init__(self, config: PullConfig) -> None:
        super().__init__(config.strength)
        self.config = config


class Duck:
    """Acts like a policy without being one."""

    def reset(self, env: Any, seed: int = 0) -> None:
        self.seed = seed

    def act(self, observations: dict[str, Any], state: Any) -> dict[str, Any]:
        return push(observations, state)


class Ahead(Planner):
    """Everyone at full thrust along the first axis."""

    def iterate(self, search: Any, state: None) -> tuple[None, Iteration]:
        return state, Iteration(np.broadcast_to(np.float32([1, 0]), search.current.controls.shape))


def push(observations: dict[str, Any], state: Any) -> dict[str, Any]:
    assert split_state(PROBLEM, state).steps < PROBLEM.horizon
    return {agent: np.array([1.0, 0]) for agent in observations}


def push_one(observation: np.ndarray, strength: float = 1.0) -> np.ndarray:
    assert observation.ndim == 1
    return np.array([strength, 0])


def make_push(strength: float = 1.0) -> Push:
    """Makes one that pushes."""
    return Push(strength)


def controls(policy: Any) -> np.ndarray:
    env = navigation_v0.parallel_env(problem=PROBLEM)
    return run_episode(env, policy).trajectory.controls


@pytest.mark.parametrize(
    "policy",
    [
        Push(), Push, Pull, Duck(), Duck, push, push_one, make_push, Ahead, Ahead(PlannerConfig(max_iterations=1)),
        "test_own:Push", "test_own:push", "test_own:push_one", "test_own:make_push", "test_own:Ahead",
        f"{__file__}:Duck",
    ],
)  # fmt: skip
def test_an_episode_takes_whatever_acts(policy: Any) -> None:
    np.testing.assert_array_equal(controls(policy), controls("test_own:Push"))


def test_controls_of_an_iteration_have_the_shape_that_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ahead, "iterate", lambda self, search, state: (state, Iteration(np.zeros((2, 50, 2)))))
    with pytest.raises(ValueError, match=r"controls have shape \(2, 50, 2\); expected \(H, K, m\) = \("):
        make_planner(Ahead).solve(PROBLEM, seed=0)


@pytest.mark.parametrize("result", [None, (None, np.zeros((1, 1, 2))), Iteration(np.zeros((1, 1, 2)))])
def test_an_iteration_that_is_none_is_refused(monkeypatch: pytest.MonkeyPatch, result: object) -> None:
    monkeypatch.setattr(Ahead, "iterate", lambda *_: result)
    with pytest.raises(ValueError, match=r"iterate\(\) of planner .* returned .*; write: return state, Iteration"):
        make_planner(Ahead).solve(PROBLEM, seed=0)


def test_settings_reach_what_takes_them() -> None:
    weak = controls(Push(0.5))
    assert weak[0, 0, 0] == 0.5
    for policy in (Push, make_push, Pull, "test_own:Push", "test_own:Pull"):
        np.testing.assert_array_equal(controls(make_policy(policy, strength=0.5)), weak)


@pytest.mark.parametrize(
    ("policy", "settings", "message"),
    [
        (lambda a, b, c: 0, {}, "policy '<lambda>' is .*, which does not act"),
        (lambda *everything: 0, {}, "which does not act"),
        (lambda: 3, {}, "is 3, which does not act"),
        (Policy, {}, "policy 'Policy' lacks act; define it"),
        (Planner, {}, "planner 'Planner' lacks iterate; define it"),
        (int, {}, "policy 'int' is .* give a Policy of yours"),
        ("test_own:Pull", {"strength": -1}, "strength is -1; it must be positive"),
        (
            "no_module:Name",
            {},
            "'no_module:Name' cannot be imported .*No module named 'no_module'.* give package.module:",
        ),
        ("no_file.py:Name", {}, "'no_file.py:Name' cannot be imported .*No such file"),
        ("test_own:Nothing", {}, "test_own has no 'Nothing'"),
        ("test_own:not a name", {}, "is no import path; give package.module:Name"),
        ("test_own:PROBLEM", {}, "which does not act"),
        ("test_own:PROBLEN", {}, "test_own has no 'PROBLEN'; .*; did you mean 'PROBLEM'"),
        (
            type("One", (Policy,), {"act": lambda self, all: {}}),
            {},
            r"'One': act takes .* called with \(observations, ",
        ),
        (type("No", (Push,), {"reset": lambda self, env: None}), {}, r"'No': reset takes .* called with \(env, seed=0"),
        (type("Be", (Planner,), {"iterate": lambda self: None}), {}, "'Be': iterate takes .* called with .*search, st"),
    ],
)
def test_what_does_not_act_is_refused(policy: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_policy(policy, **settings)


def test_a_file_finds_its_neighbours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "neighbour_of_mine.py").write_text("def push(observations, state): return {}\n")
    (tmp_path / "mine.py").write_text("from neighbour_of_mine import push\n")
    assert make_policy(f"{tmp_path / 'mine.py'}:push").function({}, None) == {}  # type: ignore[attr-defined]


@pytest.mark.parametrize("policy", [Push, make_push, Pull, "test_own:Ahead", push, Push()])
def test_unknown_settings_are_refused(policy: Any) -> None:
    with pytest.raises(UnknownKeywordError, match="speed"):
        make_policy(policy, speed=1)


@pytest.fixture
def tables() -> Iterator[None]:
    with forgetting(PLANNERS, POLICIES):
        yield


@pytest.mark.usefixtures("tables")
def test_registered_names_go_wherever_names_go(tmp_path: Path) -> None:
    register_policy("push", Push)
    register_policy("push-function", push)
    register_policy("later", "test_own:make_push")
    register_planner("ahead", Ahead)
    assert list_planners()[-1] == "ahead"
    assert {"ahead", "push", "push-function", "later"} < set(list_policies())
    assert describe_policy("later") == "Makes one that pushes."
    assert make_planner("ahead").solve(PROBLEM, max_iterations=2).planner == "Ahead"
    assert isinstance(make_policy("ahead", max_iterations=1), OpenLoop)
    with pytest.raises(UnknownKeywordError, match="'speed' is no setting of planner 'ahead'"):
        make_planner("ahead", speed=1)
    policies = ["push", "push-function", "later", "ahead"]
    rows = evaluate(policies, [PROBLEM], seeds=range(1), time_limit=1.0, workers=1, out=tmp_path)
    assert [row.label for row in rows] == policies
    assert {row.errors for row in rows} == {0}
    assert {row.policy for row in TrialStore(tmp_path / STORE).trials()} == set(policies)


@pytest.mark.usefixtures("tables")
def test_taken_names_and_bad_ones_are_refused() -> None:
    register_policy("push", Push)
    register_policy("push", type("Push", (Push,), {"__module__": Push.__module__}))  # a cell that is run again
    register_policy("path", "test_own:push")
    register_policy("path", ":".join(["test_own", "push"]))
    with pytest.raises(ValueError, match="'path' is taken"):
        register_policy("path", "test_own:push_one")
    for register, name in ((register_policy, "push"), (register_policy, "d4orm"), (register_planner, "go-to-goal"),
                           (register_planner, "mppi")):  # fmt: skip
        with pytest.raises(ValueError, match=f"{name!r} .*register yours under another"):
            register(name, Ahead)
    for name in ("a:b", "a,b", "", " ", "a=b", 3):
        with pytest.raises(ValueError, match=r"name .* is none; give one of letters"):
            register_policy(name, Push)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"planner 'x' is .*give a subclass of"):
        register_planner("x", Push)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="policy 'x' is 3; give a Policy"):
        register_policy("x", 3)


@pytest.mark.usefixtures("tables")
def test_entry_points_are_found_and_loaded_when_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    info = tmp_path / "theirs-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[d4orm.policies]\ntheirs = theirs_module:Theirs\n"
        "broken = theirs_module:nothing\ngo-to-goal = theirs_module:Theirs\n"
        "[d4orm.planners]\ntheirs-planner = test_own:Ahead\n"
    )
    (tmp_path / "theirs_module.py").write_text("from test_own import Push\nclass Theirs(Push):\n    'Theirs.'\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert {"theirs", "broken", "theirs-planner"} < set(list_policies())
    assert "theirs_module" not in sys.modules
    assert describe_policy("theirs") == "Theirs."
    np.testing.assert_array_equal(controls("theirs"), controls("theirs-planner"))
    with pytest.raises(ValueError, match="policy 'broken': 'theirs_module:nothing' names nothing"):
        make_policy("broken")
    with pytest.raises(ValueError, match=r"policy name 'go-to-goal' is claimed by .*GoToGoal and theirs_module:Theirs"):
        make_policy("go-to-goal")
    with pytest.raises(SystemExit, match="0"):
        cli.main(["planners"])
    listing = capsys.readouterr().out
    assert "Theirs." in listing
    assert "unusable: policy 'broken'" in " ".join(listing.replace("│", " ").split())


# Comparisons.

WRITTEN = """
import numpy as np
from d4orm_planners import Policy

class Mine(Policy):
    def __init__(self, strength=1.0):
        self.strength = strength
    def act(self, observations, state):
        return {agent: np.array([self.strength, 0]) for agent in observations}

def f(observations, state):
    return {agent: np.zeros(2) for agent in observations}
"""


def rows_of(folder: Path) -> list[tuple[str, dict[str, Any]]]:
    return [(row.policy, json.loads(row.config)) for row in TrialStore(folder / STORE).trials()]


def compare(policies: Any, out: Path, **settings: Any) -> list[Any]:
    return evaluate(policies, [PROBLEM], seeds=range(2), out=out, **{"workers": 1, **settings})


def test_a_comparison_takes_a_mixture(tmp_path: Path) -> None:
    policies = {
        "mine": Push(), "weak": Push(0.5), "f": push, "class": {"policy": Push, "strength": 0.25}, "go-to-goal": {},
        "path": "test_own:Push", "duck": Duck(), "one": push_one,
    }  # fmt: skip
    rows = compare(policies, tmp_path)
    assert [row.label for row in rows] == list(policies)
    assert {row.errors for row in rows} == {0}
    stored = dict(rows_of(tmp_path))
    assert stored["go-to-goal"] == {}
    digest = stored["f"]["source"]
    assert len(digest) == 64
    assert stored["mine"] == {"strength": 1.0, "source": digest}
    assert stored["weak"] == {"strength": 0.5, "source": digest}
    assert stored["class"] == {"strength": 0.25, "source": digest}
    assert stored["test_own:Push"] == {"source": digest}
    # Nothing is left to do, although the instances have been used.
    counts: list[tuple[int, int]] = []
    compare(policies, tmp_path, progress=lambda what, done, total: counts.append((done, total)))
    assert counts == [(16, 16)]


def test_policies_without_labels_have_their_own_names(tmp_path: Path) -> None:
    rows = compare([Push, push, Duck(), "go-to-goal"], tmp_path)
    assert [row.label for row in rows] == ["Push", "push", "Duck", "go-to-goal"]
    assert [row.label for row in compare(push_one, tmp_path)] == ["push_one"]
    with pytest.raises(ValueError, match="two policies are called 'Push'; leave one out, or give a mapping"):
        compare([Push(), Push(2.0)], tmp_path)
    with pytest.raises(ValueError, match=r"policies\['go-to-goal'\] has the name of another policy"):
        compare({"go-to-goal": Push()}, tmp_path)
    with pytest.raises(ValueError, match="setting that cannot be stored"):
        compare({"x": {"policy": Push, "strength": np.ones(2)}}, tmp_path)


def test_an_edited_policy_is_another(tmp_path: Path) -> None:
    (tmp_path / "written.py").write_text(WRITTEN)
    compare(f"{tmp_path / 'written.py'}:Mine", tmp_path / "out")
    code = f"""
from test_own import compare, rows_of
from pathlib import Path
compare({f"{tmp_path / 'written.py'}:Mine"!r}, Path({str(tmp_path / "out")!r}))
print(len(rows_of(Path({str(tmp_path / "out")!r}))))
"""
    (tmp_path / "written.py").write_text(WRITTEN + "# edited\n")
    assert program(tmp_path, code) == "4\n"


def program(folder: Path, text: str) -> str:
    """What a program prints."""
    (folder / "program.py").write_text(text)
    path = os.pathsep.join(
        filter(None, [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "planners"), os.environ.get("PYTHONPATH")])
    )
    result = subprocess.run(
        [sys.executable, "program.py"],
        capture_output=True, text=True, check=False, cwd=folder, env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return result.stdout


MIXTURE = """
import numpy as np
from d4orm_planners import Policy, evaluate, register_policy

class Here(Policy):
    def act(self, observations, state):
        return {{agent: np.zeros(2) for agent in observations}}

def here(observation):
    return np.zeros(2)

if __name__ == "__main__":
    from written import f
    register_policy("registered", f)
    policies = {{"a": Here(), "b": here, "c": "written:Mine", "registered": {{}}, "go-to-goal": {{}}}}
    rows = evaluate(policies, out="out", seeds=range(2), num_robots=2, {arguments})
    print(*((row.label, row.errors, row.error) for row in rows))
"""


@pytest.mark.slow
@pytest.mark.parametrize("arguments", ["workers=2", pytest.param("ray='local', workers=2", id="ray")])
def test_other_processes_get_the_same_policies(tmp_path: Path, arguments: str) -> None:
    if "ray" in arguments:
        pytest.importorskip("ray")
    (tmp_path / "written.py").write_text(WRITTEN)
    labels = ("a", "b", "c", "registered", "go-to-goal")
    expected = " ".join(str((label, 0, "")) for label in labels)
    assert program(tmp_path, MIXTURE.format(arguments=arguments)).splitlines()[-1] == expected


def test_what_workers_cannot_import_is_refused_before_anything_runs(tmp_path: Path) -> None:
    local = {"f": lambda observations, state: push(observations, state)}
    with pytest.raises(ValueError, match=r"policy 'f' cannot be handed to worker processes .* or run with workers=1"):
        compare(local, tmp_path, workers=2)
    assert rows_of(tmp_path) == []
    assert [row.errors for row in compare(local, tmp_path)] == [0]


def test_trials_leave_a_given_policy_as_it_was(tmp_path: Path) -> None:
    policy = OpenLoop(Ahead(PlannerConfig(max_iterations=1)))
    compare({"mine": policy}, tmp_path)
    assert policy.planner is not None
    assert policy.plan is None
    ((_, first), *_) = rows_of(tmp_path)
    assert first["planner"] == "Ahead"
    assert first["max_iterations"] == 1
    assert "source" in first


def test_numbers_of_numpy_are_numbers(tmp_path: Path) -> None:
    for strength, robots, path in ((0.5, 2, True), (np.float32(0.5), np.int64(2), np.bool_(True))):
        observation = {"observed_robots": robots, "observed_path": path}
        rows = compare({"mine": {"policy": Push, "strength": strength}}, tmp_path, observation=observation)
        assert [row.errors for row in rows] == [0]
    # They mean the same.
    assert len(rows_of(tmp_path)) == 2


class Locked(Push):
    """It holds what cannot be copied, a lock, and a policy that can."""

    def __init__(self) -> None:
        super().__init__()
        self.lock, self.helper = threading.Lock(), make_policy("orca")

    def identity(self) -> dict[str, object]:
        return {}


def test_what_cannot_be_copied_is_given_as_a_class(tmp_path: Path) -> None:
    remedy = r"policy 'Locked' cannot be copied .*lock.*give its class, or a function that makes it"
    with pytest.raises(ValueError, match=remedy):
        compare({"locked": Locked()}, tmp_path)
    with pytest.raises(ValueError, match=remedy):
        Demonstrations(policy=Locked(), environment={"scenario": "circle", "num_robots": 2}, seeds=range(1))
    assert rows_of(tmp_path) == []
    (row,) = compare({"locked": Locked}, tmp_path)
    assert row.errors == 0


def test_the_command_line_takes_import_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "from_here.py").write_text(WRITTEN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    settings = ["--num-robots", "2", "--workers", "1"]
    many = ["-p", "go-to-goal,from_here:f", "-p", "from_here:Mine:strength=0.5", "-p", "from_here.py:Mine"]
    two = ["--disturb=delay=1", "--set=from_here:Mine.strength=2", "--seeds=1"]
    for arguments, status in (
        (["evaluate", *many, *settings, "--seeds", "1"], 0),
        (["robustness", "--policy", "from_here:Mine", *settings, *two], 0),
        (["run", "--policy", "from_here:f", "--num-robots", "2"], 1),
        (["run", "--policy", "from_here:g", "--num-robots", "2"], 2),
        (["plan", "--planner", "test_own:Ahead", "--num-robots", "2"], 1),
        (["plan", "--planner", "from_here:f", "--num-robots", "2"], 2),
    ):  # fmt: skip
        with pytest.raises(SystemExit, match=str(status)):
            cli.main(arguments)
    error = capsys.readouterr().err
    assert "'from_here:g' names nothing" in error
    assert "planner 'from_here:f' is <function f" in error
    assert [name for name, _ in rows_of(tmp_path / "evaluation")] == [
        "from_here.py:Mine", "from_here:Mine", "from_here:f", "go-to-goal",
    ]  # fmt: skip
