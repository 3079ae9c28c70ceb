"""Success against noise: the statistics, the store of trials, resuming, and what is written."""

from __future__ import annotations

import csv
import multiprocessing
import os
import re
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import trial_support

from d4orm_planners import make_policy
from d4orm_planners.base.policy import GoToGoal
from d4orm_planners.cli import evaluate_command
from d4orm_planners.evaluation import sqlite_file
from d4orm_planners.evaluation import trials as trials_module
from d4orm_planners.evaluation.evaluate import run_study
from d4orm_planners.evaluation.robustness import write_robustness
from d4orm_planners.evaluation.sqlite_file import APPLICATION_ID
from d4orm_planners.evaluation.store import STORE, TrialStore
from d4orm_planners.evaluation.study import Study
from d4orm_planners.evaluation.summary import SuccessRate, success_rate, success_rates, wilson_interval
from d4orm_planners.evaluation.tables import HEADER, markdown
from d4orm_planners.evaluation.trials import Job

TINY: dict[str, Any] = {"num_robots": [2], "control_noise_std": [0.0, 0.3], "seeds": range(2), "workers": 1}


def rates_of(
    policies: Any, out: Path, *, workers: int = 1, progress: Callable[..., Any] | None = None, **study: Any
) -> list[SuccessRate]:
    """Run what is missing, and sum up."""
    return success_rates(run_study(Study(policies=policies, **study), out, workers=workers, progress=progress))


trial = partial(trial_support.trial, policy="go-to-goal", label="go-to-goal", control_noise_std=0.1, makespan=6.0)


@pytest.fixture
def d4orm(d4orm):
    """Runs ``d4orm robustness``."""
    return partial(d4orm, "robustness")


# Statistics.


@pytest.mark.parametrize(
    ("successes", "count", "lower", "upper"),
    [
        (0, 10, 0.0, 0.277533),
        (10, 10, 0.722467, 1.0),
        (5, 10, 0.236593, 0.763407),
        (1, 50, 0.003539, 0.104954),
        (45, 50, 0.786398, 0.956524),
    ],
)
def test_wilson_interval(successes: int, count: int, lower: float, upper: float) -> None:
    assert wilson_interval(successes, count) == pytest.approx((lower, upper), abs=1e-6)


@pytest.mark.parametrize(("successes", "count"), [(-1, 5), (6, 5), (1, 0), (0, 0)])
def test_impossible_counts_are_refused(successes: int, count: int) -> None:
    with pytest.raises(ValueError, match="must"):
        wilson_interval(successes, count)


def test_success_rate_sums_up() -> None:
    row = success_rate([
        trial(0, travel_time=4.0, wall_time=1.0),
        trial(1, travel_time=6.0, wall_time=2.0),
        trial(2, success=False, collided=2, arrived=1, travel_time=9.0, wall_time=9.0),
        trial(3, success=False, arrived=0, travel_time=None, wall_time=None, error="ValueError: no"),
    ])  # fmt: skip
    assert (row.trials, row.successes, row.contacts, row.late, row.errors) == (4, 2, 1, 1, 1)
    assert (row.rate, row.travel_time, row.wall_time, row.error) == (0.5, 5.0, 2.0, "ValueError: no")
    assert (row.lower, row.upper) == wilson_interval(2, 4)


def test_only_what_was_judged_counts_as_verified() -> None:
    assert success_rate([trial(0, verified=True), trial(1, verified=False), trial(2, verified=None)]).verified == 1
    assert success_rate([trial(0, verified=None)]).verified is None


def test_a_trial_that_was_over_at_once_has_no_time_of_motion() -> None:
    row = success_rate([trial(0, steps=0, wall_time=1.0), trial(1, steps=50, wall_time=1.0)])
    assert row.compute == pytest.approx(1.0 / 5.0)


# The store.


def test_the_store_gives_back_what_was_added(tmp_path: Path) -> None:
    store = TrialStore(tmp_path / "trials.sqlite")
    rows = [
        trial(0),
        trial(1, control_noise_std=1 / 3, success=False),
        trial(2, error="ValueError: no", travel_time=None),
    ]
    assert all(store.add(row) for row in rows)
    again = TrialStore(tmp_path / "trials.sqlite")
    assert sorted(again.trials(), key=lambda row: row.seed) == rows
    assert again.finished() == {rows[0].key, rows[1].key}


def test_a_finished_trial_stays_and_a_failed_one_is_replaced(tmp_path: Path) -> None:
    store = TrialStore(tmp_path / "trials.sqlite")
    assert store.add(trial())
    assert not store.add(trial(steps=7))
    assert store.add(trial(1, error="boom"))
    assert store.add(trial(1))
    assert store.trials() == [trial(), trial(1)]


def test_a_seed_that_the_store_has_no_room_for_is_refused(tmp_path: Path) -> None:
    store = TrialStore(tmp_path / "trials.sqlite")
    with pytest.raises(ValueError, match=f"seed is {2**63}; a store has room for seeds up to {2**63 - 1}"):
        store.add(trial(0), trial(2**63))
    assert store.trials() == []
    assert store.add(trial(2**63 - 1))


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("reward", "much"), ("num_robots", "many"), ("success", "yes"), ("seed", "first"), ("config", "none"),
        ("label", b"x"), ("history", "[[1"), ("history", "[1, 2]"), ("control_noise_std", "much"), ("travel_time", "a"),
        ("disturbances", '[["delay", 3]]'), ("machine", '{"processor": "x"}'),
    ],
)  # fmt: skip
def test_what_does_not_belong_in_a_column_is_one_clear_error(tmp_path: Path, column: str, value: Any) -> None:
    path = tmp_path / "trials.sqlite"
    TrialStore(path).add(trial())
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(f"UPDATE trials SET {column} = ?", (value,))
    message = rf"trial store .*trials\.sqlite is damaged \(trial 0 has {re.escape(repr(value))} as {column}\)"
    with pytest.raises(ValueError, match=message):
        TrialStore.existing(path).trials()


def test_a_damaged_file_is_called_damaged(tmp_path: Path) -> None:
    path = tmp_path / "trials.sqlite"
    TrialStore(path).add(*(trial(seed) for seed in range(200)))
    content = bytearray(path.read_bytes())
    content[4096:] = bytes(len(content) - 4096)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"trial store .* is damaged \(database disk image is malformed\); put a copy"):
        TrialStore.existing(path).trials()


def test_columns_and_texts_that_are_damaged_are_called_so(tmp_path: Path) -> None:
    path = tmp_path / "trials.sqlite"
    TrialStore(path).add(trial())
    content = path.read_bytes()
    for good, bad in ((b"collided INTEGER", b"collidex INTEGER"), (b"goal", b"g\xffal")):
        path.write_bytes(content.replace(good, bad))
        with pytest.raises(ValueError, match=r"trial store .* is damaged \(.*\); put a copy in its place"):
            TrialStore.existing(path).trials()


def test_who_never_has_the_store_alone_gives_up_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0

    class Busy:
        def execute(self, statement: str) -> None:
            error = sqlite3.OperationalError("database is locked")
            error.sqlite_errorcode = sqlite3.SQLITE_BUSY
            raise error

    def sleep(seconds: float) -> None:
        nonlocal now
        now += 1

    monkeypatch.setattr(sqlite_file, "time", SimpleNamespace(monotonic=lambda: now, sleep=sleep))
    with pytest.raises(sqlite3.OperationalError, match="locked"):
        sqlite_file.use_wal(Busy())  # type: ignore[arg-type]
    assert sqlite_file.TIMEOUT < now - 1000 <= sqlite_file.TIMEOUT + 1


READ = """
import os, sys
from d4orm_planners.evaluation.store import TrialStore
if os.geteuid() == 0:
    os.setresuid(65534, 65534, 65534)
try:
    print(len(TrialStore.existing(sys.argv[1]).trials()))
except OSError as error:
    print(error)
"""


@pytest.mark.skipif(os.name != "posix", reason="file modes of POSIX")
@pytest.mark.parametrize("left_behind", [False, True])
def test_a_store_that_cannot_be_written_to_can_be_read(left_behind: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trials.sqlite"
        store = TrialStore(path)
        store.add(trial(0), trial(1))
        if left_behind:
            Path(f"{path}-wal").write_bytes(b"not a log that could be read without writing")
        os.chmod(folder, 0o555)
        command = [sys.executable, "-c", READ, str(path)]
        told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        os.chmod(folder, 0o755)
    if left_behind:
        assert "cannot be read: " in told
        assert "; copy it with all files beside it to a folder that can be written to" in told
    else:
        assert told == "2\n"


def fill(path: Path, first: int, last: int) -> None:
    store = TrialStore(path)
    for seed in range(first, last):
        store.add(trial(seed))


def test_two_writers_lose_nothing_and_count_nothing_twice(tmp_path: Path) -> None:
    context, path = multiprocessing.get_context("spawn"), tmp_path / "trials.sqlite"
    # They make the file at the same time, and half of their trials are the same.
    writers = [context.Process(target=fill, args=(path, first, first + 100)) for first in (0, 50)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert [row.seed for row in TrialStore(path).trials()] == list(range(150))


def not_a_database(path: Path) -> None:
    path.write_text("these are my notes, " * 100)


def other_database(path: Path) -> None:
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE notes (text)")
    connection.commit()
    connection.close()


def other_version(path: Path, version: int) -> None:
    connection = sqlite3.connect(path)
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {version}")
    connection.close()


def former_version(path: Path) -> None:
    other_version(path, 1)


def later_version(path: Path) -> None:
    other_version(path, 99)


@pytest.mark.parametrize("make", [not_a_database, other_database, former_version, later_version])
def test_a_file_that_is_not_ours_is_refused_and_left_alone(d4orm, tmp_path: Path, make: Callable[..., None]) -> None:
    make(tmp_path / STORE)
    before = (tmp_path / STORE).read_bytes()
    status, _, err = d4orm("--out", ".", "--policies", "go-to-goal")
    assert status == 2
    assert err.count("\n") == 1
    assert "is no store of trials" in err
    assert (tmp_path / STORE).read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [STORE]


# Trials.


def test_success_and_failure_are_counted(tmp_path: Path) -> None:
    rates = rates_of(["go-to-goal", "orca"], tmp_path, **TINY)
    assert [(row.policy, row.control_noise_std, row.trials, row.successes, row.contacts) for row in rates] == [
        ("go-to-goal", 0.0, 2, 0, 2),
        ("go-to-goal", 0.3, 2, 0, 2),
        ("orca", 0.0, 2, 2, 0),
        ("orca", 0.3, 2, 2, 0),
    ]
    stored = TrialStore(tmp_path / STORE).trials()
    assert len(stored) == len({row.key for row in stored}) == 8
    assert {(row.scenario, row.num_robots, row.model) for row in stored} == {("circle", 2, "holonomic2d")}
    assert all(row.steps and row.wall_time and '"numpy"' in row.versions for row in stored)


def test_random_problems_differ_by_seed_and_noise_too(tmp_path: Path) -> None:
    rates_of(["go-to-goal"], tmp_path, scenarios=["random"], **TINY)
    stored = TrialStore(tmp_path / STORE).trials()
    assert len({row.problem for row in stored}) == 2
    assert len({row.travel_time for row in stored}) == 4


def test_a_plan_is_made_once_for_all_levels_of_noise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    solve = type(make_policy("d4orm").planner).solve  # type: ignore[attr-defined]

    def counted(self: Any, problem: Any, seed: int = 0, **budget: Any) -> Any:
        made.append(seed)
        return solve(self, problem, seed=seed, **budget)

    monkeypatch.setattr("d4orm_planners.sampling.d4orm.D4orm.solve", counted)
    settings = {"engine": "cpu", "num_samples": 64, "num_steps": 5, "max_iterations": 1}
    rates = rates_of({"d4orm": settings}, tmp_path, **TINY)
    assert made == [0, 1]
    assert all(row.errors == 0 for row in rates)
    times = {(row.seed, row.wall_time) for row in TrialStore(tmp_path / STORE).trials()}
    assert len(times) == 2


def test_resuming_runs_only_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rates_of(["go-to-goal"], tmp_path, **TINY)
    ran: list[tuple[int, tuple[float, ...]]] = []

    def levels(job: Job) -> tuple[float, ...]:
        return tuple(condition.control_noise_std for condition in job.conditions)

    run = Job.run
    monkeypatch.setattr(Job, "run", lambda job: (ran.append((job.seed, levels(job))), run(job))[1])
    before = rates_of(["go-to-goal"], tmp_path, **TINY)
    assert ran == []
    counts: list[tuple[int, int]] = []
    more = {**TINY, "control_noise_std": [0.0, 0.3, 0.5], "seeds": range(3)}
    rates = rates_of(["go-to-goal"], tmp_path, **more, progress=lambda what, done, total: counts.append((done, total)))
    assert ran == [(0, (0.5,)), (1, (0.5,)), (2, (0.0, 0.3, 0.5))]
    assert counts == [(4, 9), (5, 9), (6, 9), (7, 9), (8, 9), (9, 9)]
    assert [row.trials for row in rates] == [3, 3, 3]
    # Trials beyond those asked for are in the store and not in the rates.
    again = rates_of(["go-to-goal"], tmp_path, **TINY)
    assert again == before
    # Other settings are other trials.
    ran.clear()
    rates_of({"orca": {"time_horizon": 2.0}}, tmp_path, **TINY)
    rates_of({"orca": {"time_horizon": 3.0}}, tmp_path, **TINY)
    assert len(ran) == 4


class Unlucky(GoToGoal):
    """Fails in the first episode."""

    def _begin(self, env: Any, seed: int) -> None:
        if seed == 0:
            raise RuntimeError("out of\nluck")


def test_an_error_is_a_row_and_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trials_module, "fresh_policy", lambda name, **settings: Unlucky())
    rates = rates_of(["go-to-goal"], tmp_path, **TINY)
    assert [(row.trials, row.errors) for row in rates] == [(2, 1)] * 2
    assert all(row.error.startswith("RuntimeError: out of luck (test_robustness.py, line ") for row in rates)
    assert "- `go-to-goal`: RuntimeError: out of luck" in markdown(rates)
    monkeypatch.undo()
    rates = rates_of(["go-to-goal"], tmp_path, **TINY)
    assert [(row.trials, row.errors) for row in rates] == [(2, 0)] * 2


def test_ctrl_c_keeps_what_was_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, d4orm) -> None:
    run = Job.run

    def interrupted(job: Any) -> Any:
        if job.seed == 1:
            raise KeyboardInterrupt
        return run(job)

    monkeypatch.setattr(Job, "run", interrupted)
    arguments = [
        "--policies",
        "go-to-goal",
        "--num-robots",
        "2",
        "--seeds",
        "3",
        "--control-noise-std",
        "0,0.3",
        "--workers",
        "1",
    ]
    status, _, err = d4orm(*arguments)
    assert status == 130
    assert "the same command goes on from there" in err
    assert len(TrialStore(tmp_path / "robustness" / STORE).trials()) == 2


@pytest.mark.slow
def test_the_number_of_workers_makes_no_difference(tmp_path: Path) -> None:
    alone, together = (
        rates_of(["go-to-goal", "orca"], tmp_path / str(workers), **{**TINY, "workers": workers}) for workers in (1, 2)
    )
    times = ("wall_time", "decision", "compute", "compute_lower", "compute_upper")
    untimed: dict[str, Any] = dict.fromkeys(times)
    assert [replace(row, **untimed) for row in alone] == [replace(row, **untimed) for row in together]
    # Workers of several have one thread each, which the description of the machine says.
    untimed = {"wall_time": None, "preparation": None, "elapsed": None, "date": "", "machine": ""}
    outcomes = [[replace(row, **untimed) for row in TrialStore(tmp_path / folder / STORE).trials()] for folder in "12"]
    assert outcomes[0] == outcomes[1]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
@pytest.mark.parametrize(("workers", "later"), [(1, 0.0), (2, 0.2)], ids=["at once", "in the middle"])
def test_a_killed_run_goes_on_where_it_was(tmp_path: Path, workers: int, later: float) -> None:
    arguments = f"--policies go-to-goal --num-robots 8 --seeds 16 --control-noise-std 0,0.1 --out {tmp_path}".split()
    command = [sys.executable, "-m", "d4orm_planners.cli.app", "robustness", *arguments, f"--workers={workers}", "-q"]
    process = subprocess.Popen(command)
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if (tmp_path / STORE).exists() and TrialStore(tmp_path / STORE).trials():
            break
        time.sleep(0.02)
    time.sleep(later)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    time.sleep(1)  # workers may finish a trial that they are in the middle of
    first = TrialStore(tmp_path / STORE).trials()
    assert 0 < len(first) < 32
    time.sleep(0.5)
    assert TrialStore(tmp_path / STORE).trials() == first, "a worker outlived its parent"
    subprocess.run(command, check=True)
    rows = TrialStore(tmp_path / STORE).trials()
    assert [(row.control_noise_std, row.seed) for row in rows] == [
        (noise, seed) for noise in (0.0, 0.1) for seed in range(16)
    ]
    kept = {row.key: row for row in rows}
    assert all(kept[row.key] == row for row in first)
    assert not list(tmp_path.glob(".*")), "a temporary file was left behind"


@pytest.mark.slow
def test_closed_loop_survives_noise_that_open_loop_does_not(tmp_path: Path) -> None:
    policies = {"d4orm-c2f": {"refine": "sync"}, "hybrid": {}, "go-to-goal": {}}
    rates = rates_of(policies, tmp_path, **{**TINY, "num_robots": 4, "control_noise_std": (0.0, 0.5)})
    rows = {(row.policy, row.control_noise_std): row for row in rates}
    assert rows["hybrid", 0.0].successes == rows["d4orm-c2f", 0.5].successes == 2
    assert rows["hybrid", 0.5].successes == 0
    assert rows["go-to-goal", 0.0].contacts == 2


# What is written.


def test_the_files(d4orm, tmp_path: Path) -> None:
    arguments = ("--policies", "go-to-goal,orca", "--scenario", "circle,random", "--num-robots", "2,3", "--seeds", "1")
    status, out, err = d4orm(*arguments, "--control-noise-std", "0,0.1", "--workers", "1", "--out", "here")
    assert status == 0, err
    written = {path.name for path in (tmp_path / "here").iterdir()}
    assert {"robustness.csv", "robustness.md", "robustness.png", STORE} <= written
    for kind, magic in (("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")):
        assert (tmp_path / "here" / f"robustness.{kind}").read_bytes().startswith(magic)
    with (tmp_path / "here" / "robustness.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * 2 * 2
    assert rows[0]["policy"] == "go-to-goal"
    assert float(rows[0]["rate"]) == 0
    text = (tmp_path / "here" / "robustness.md").read_text()
    assert "### random, 3 robots, holonomic2d" in text
    assert text.strip() in out


def test_the_table_row_by_row(tmp_path: Path) -> None:
    rates = [success_rate([trial(0, wall_time=0.25), trial(1, success=False, collided=2)])]
    assert markdown(rates).splitlines() == [
        "### circle, 2 robots, holonomic2d",
        "",
        f"| {' | '.join(HEADER)} |",
        f"|{'---|' * len(HEADER)}",
        "| go-to-goal | 0.1 | 1 of 2 (50%) | 9% to 91% | - | 1 | 0 | 0 | 5.00 | - | - | - | - | 0.38 | - | - "
        "| 0.062 (-0.202 to 0.327) |",
    ]
    paths = write_robustness(tmp_path, rates)
    assert sorted(path.name for path in paths) == sorted(path.name for path in tmp_path.iterdir())


def test_settings_reach_the_policies_that_have_them(d4orm, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, Any] = {}

    def run(study: Study, out: Any, **rest: Any) -> Any:
        seen.update((choice.label, choice.settings) for choice in study.configurations())
        raise ValueError("enough")

    monkeypatch.setattr(evaluate_command, "run_study", run)
    settings = ("--set", "cem.num_samples=32", "--set", "num_samples=64", "--set", "orca.time_horizon=2")
    d4orm("--policies", "d4orm,cem,orca", *settings, "--set", "preset=paper")
    assert seen == {
        "d4orm": {"num_samples": 64, "preset": "paper"},
        "cem": {"num_samples": 32, "preset": "paper"},
        "orca": {"time_horizon": 2},
    }
    seen.clear()
    d4orm(
        "--policy",
        "d4orm:num_samples=32",
        "--policy",
        "d4orm,mppi",
        "--set",
        "num_samples=64",
        "--set",
        "d4orm.credit=team",
    )
    assert seen == {
        "d4orm:num_samples=32": {"num_samples": 32, "credit": "team"},
        "d4orm": {"num_samples": 64, "credit": "team"},
        "mppi": {"num_samples": 64},
    }


# Bad input.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--policies", "gaol"), "policy 'gaol' is unknown"),
        (("--control-noise-std", "0,nan"), "control_noise_std is nan"),
        (("--control-noise-std", "none"), "--control-noise-std 'none' is not a list of numbers"),
        (("--trials", "0"), "names no seed"),
        (("--seeds", "99999999999"), "1000000"),
        (("--set", "speed=1"), "'speed' is a setting of none of the policies go-to-goal"),
        (("--set", "orca.time_horizon=1"), "'orca' is not among the policies"),
        (("--policies", "orca", "--set", "time_horizon=-1"), "time_horizon is -1"),
        (("--policies", "orca", "--set", "orca.speed=1"), "'speed' is no setting of policy 'orca'"),
    ],
)
def test_bad_input_is_one_line_and_status_two(d4orm, tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    """Options that ``d4orm evaluate`` has too are tried with that."""
    status, _, err = d4orm("--policies", "go-to-goal", *arguments)
    assert status == 2
    assert err.count("\n") == 1
    assert err.startswith("d4orm: ")
    assert message in err
    assert not list(tmp_path.rglob("*.sqlite"))


def test_a_library_that_is_missing_is_named_before_anything_runs(d4orm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrvo", None)
    status, _, err = d4orm("--policies", "go-to-goal,orca")
    assert status == 2
    assert err == "d4orm: policy 'orca' needs pyrvo; install it with: pip install 'd4orm-env[orca]'\n"


@pytest.mark.parametrize(
    "options",
    [("--policies", ""), ("--scenario", ""), ("--num-robots", ""), ("--control-noise-std", "")],
    ids=lambda given: given[0],
)
def test_nothing_to_do_is_refused(d4orm, tmp_path: Path, options: tuple[str, str]) -> None:
    status, _, err = d4orm("--policies", "go-to-goal", *options)
    assert (status, err.count("\n")) == (2, 1)
    assert not list(tmp_path.rglob("*.sqlite"))
