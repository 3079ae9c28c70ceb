"""The comparison harness: rows that tell everything, kills, crashes, deadlines, exports, the leaderboard."""

from __future__ import annotations

import csv
import errno
import json
import os
import signal
import sqlite3
import subprocess
import sys
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trial_support
from planner_support import program
from registry_support import forgetting

from d4orm_env import make_problem, save_problem
from d4orm_env.disturbances import Delay
from d4orm_env.dynamics.models import MODELS
from d4orm_planners import IterationRecord, Policy, evaluate
from d4orm_planners.evaluation import trials
from d4orm_planners.evaluation.evaluate import run_study
from d4orm_planners.evaluation.leaderboard import leaderboard
from d4orm_planners.evaluation.pool import ProcessWorker, run_jobs
from d4orm_planners.evaluation.store import STORE, Trial, TrialStore
from d4orm_planners.evaluation.study import Study
from d4orm_planners.evaluation.summary import mean_interval, solved_after, success_by, success_rate, wilson_interval
from d4orm_planners.evaluation.tables import markdown, read_parquet, write_csv, write_parquet, write_results
from d4orm_planners.evaluation.trials import Configuration

QUICK = {"engine": "cpu", "num_samples": 64, "num_steps": 5, "max_iterations": 3}
TINY: dict[str, Any] = {"num_robots": 2, "seeds": range(2), "workers": 1}


trial = partial(trial_support.trial, verified=True)


# Rows.


def test_a_planners_trial_says_everything(tmp_path: Path) -> None:
    (row,) = evaluate({"d4orm": QUICK}, out=tmp_path, num_robots=2, seeds=[4], workers=1)
    (stored,) = TrialStore(tmp_path / STORE).trials()
    assert (row.label, row.scenario, row.num_robots, row.trials, row.successes, row.verified) == (
        ("d4orm", "circle", 2, 1, 1, 1)
    )  # fmt: skip
    assert stored.problem == make_problem("circle", num_robots=2, seed=4).digest
    assert (stored.seed, stored.success, stored.verified, stored.violation, stored.status) == (
        4,
        True,
        True,
        "",
        "solved",
    )
    assert stored.iterations == len(json.loads(stored.history)) > 0
    assert json.loads(stored.history)[-1][1] == 1
    assert json.loads(stored.config)["num_samples"] == 64
    assert "numpy" in json.loads(stored.versions)
    assert json.loads(stored.machine)["cores"] >= 1
    assert stored.date.startswith("20")
    assert stored.date.endswith("+00:00")
    assert 0 < stored.wall_time < stored.elapsed  # type: ignore[operator]
    assert 0 < stored.reward < 1  # type: ignore[operator]
    assert stored.mean_squared_jerk > 0  # type: ignore[operator]
    assert 1 <= stored.stretch == row.stretch < 2  # type: ignore[operator]
    assert row.compute == pytest.approx(stored.wall_time / (stored.steps * 0.1))  # type: ignore[operator]


def test_the_time_of_a_controller_is_that_of_its_preparation_and_of_its_steps(tmp_path: Path) -> None:
    evaluate({"go-to-goal": {}}, out=tmp_path, num_robots=2, seeds=[4], workers=1)
    (stored,) = TrialStore(tmp_path / STORE).trials()
    assert 0 < stored.preparation < stored.wall_time < stored.elapsed  # type: ignore[operator]


def test_the_judge_sees_what_was_executed(tmp_path: Path) -> None:
    evaluate(["go-to-goal", "orca"], out=tmp_path, control_noise_std=[0.0, 0.2], **TINY)
    stored = TrialStore(tmp_path / STORE).trials()
    assert len(stored) == 8
    for row in stored:
        assert row.verified is row.success is (row.policy == "orca")
        assert (row.iterations, row.status, row.history) == (None, "", "[]")
        assert row.violation.startswith("robot contact at") or row.success


def test_two_configurations_of_one_policy_and_problems_of_all_kinds(tmp_path: Path) -> None:
    problem = make_problem("random", num_robots=2, seed=7).replace(name="mine")
    save_problem(problem.replace(name="custom"), tmp_path / "nameless.yaml")
    policies = {"orca": {}, "hasty": {"policy": "orca", "time_horizon": 3.0}}
    scenarios = ["circle", tmp_path / "nameless.yaml", make_problem("swap", num_robots=2)]
    rows = evaluate(policies, scenarios, out=tmp_path / "out", **TINY)
    assert [(row.scenario, row.label, row.policy, row.trials) for row in rows] == [
        (scenario, label, "orca", 2) for scenario in ("circle", "nameless", "swap") for label in ("orca", "hasty")
    ]
    assert {
        (row.label, json.loads(row.config)["time_horizon"]) for row in TrialStore(tmp_path / "out" / STORE).trials()
    } == {
        ("orca", json.loads(trials.Configuration("", "orca", {}).config)["time_horizon"]),
        ("hasty", 3.0),
    }


def test_scenarios_with_other_arguments_are_other_trials(tmp_path: Path) -> None:
    for diameter in (6.0, 7.0):
        evaluate("go-to-goal", out=tmp_path, **TINY, scenario_settings={"diameter": diameter})
    stored = TrialStore(tmp_path / STORE).trials()
    assert len(stored) == 4
    assert {(row.scenario, row.problem) for row in stored} == {
        (f"circle (diameter={diameter})", make_problem("circle", num_robots=2, diameter=diameter, seed=seed).digest)
        for diameter in (6.0, 7.0)
        for seed in range(2)
    }


@pytest.mark.parametrize("name", [Path("maps/hall"), None, 3, b"hall"])
def test_a_problem_may_be_called_anything(name: Any, tmp_path: Path) -> None:
    problem = make_problem("circle", num_robots=2).replace(name=name)
    (rate,) = evaluate("go-to-goal", problem, out=tmp_path, seeds=[0], workers=1)
    assert rate.scenario == problem.name == str(name)


def test_a_problem_with_two_names_runs_once(tmp_path: Path) -> None:
    problem = make_problem("circle", num_robots=2)
    counts: list[tuple[int, int]] = []
    rows = evaluate(
        "go-to-goal",
        [problem, "circle"],
        out=tmp_path,
        **TINY,
        progress=lambda what, done, total: counts.append((done, total)),
    )
    assert counts == [(0, 2), (1, 2), (2, 2)]
    assert [row.trials for row in rows] == [2, 2]


def test_problems_of_one_name_are_told_apart_or_refused(tmp_path: Path) -> None:
    near, far = (make_problem("circle", num_robots=1, diameter=diameter) for diameter in (5.0, 8.0))
    options: dict[str, Any] = {"seeds": [1], "workers": 1, "out": tmp_path / "out"}
    for scenarios in ([near, far], ["circle", far.replace(dt=0.05), far]):
        with pytest.raises(ValueError, match=r"two scenarios are called 'circle' and have 1 robots.*replace\(name="):
            evaluate("go-to-goal", scenarios, num_robots=1 if "circle" in scenarios else None, **options)
    assert not (tmp_path / "out").exists()
    evaluate("go-to-goal", far, **options)
    # Under the name that it has now, though it was stored under another, and the same problem under two names twice.
    named = [near, far.replace(name="far"), far.replace(name="farther")]
    rows = evaluate("go-to-goal", named, disturbances={"delay": [0, 1]}, **options)
    assert [row.scenario for row in rows] == ["circle"] * 2 + ["far"] * 2 + ["farther"] * 2
    with (tmp_path / "out" / "tolerance.csv").open(newline="") as file:
        assert [row["scenario"] for row in csv.DictReader(file)] == ["circle", "far", "farther"]


def test_the_time_limit_reaches_planners_without_one(tmp_path: Path) -> None:
    policies = {"d4orm": {**QUICK, "improve": True, "max_iterations": 10_000}, "go-to-goal": {}}
    rows = evaluate(policies, out=tmp_path, time_limit=0.05, **TINY)
    limits = {row.policy: json.loads(row.config).get("time_limit") for row in TrialStore(tmp_path / STORE).trials()}
    assert limits == {"d4orm": 0.05, "go-to-goal": None}
    assert rows[0].errors == 0
    stored = [row for row in TrialStore(tmp_path / STORE).trials() if row.policy == "d4orm"]
    assert {row.status for row in stored} == {"time_limit"}


# Statistics and deadlines.


def test_interval_of_a_mean() -> None:
    assert mean_interval([]) == (None, None, None)
    assert mean_interval([2.0]) == (2.0, None, None)
    # By hand: mean 2, standard deviation 1, t with 2 degrees of freedom.
    assert mean_interval([1.0, 2.0, 3.0]) == pytest.approx((2.0, 2 - 4.302653 / 3**0.5, 2 + 4.302653 / 3**0.5))
    assert mean_interval([2.0, 2.0]) == (2.0, 2.0, 2.0)


def record(iteration: int, seconds: float, solved: bool, reward: float) -> IterationRecord:
    return IterationRecord(iteration, seconds, iteration, reward, solved, 0, 0, 0, reward, solved)


def test_the_history_keeps_the_moments_at_which_the_best_plan_changed() -> None:
    history = (
        record(1, 0.1, False, 0.5),
        record(2, 0.2, False, 0.5),
        record(3, 0.3, True, 0.4),
        record(4, 0.4, True, 0.6),
    )
    assert trials.compact_history(history) == "[[0.1,0,0.5,1],[0.3,1,0.4,3],[0.4,1,0.6,4]]"


def test_success_within_deadlines() -> None:
    rows = [
        trial(0, history="[[0.1,0,0.5],[0.3,1,0.4],[0.4,1,0.6]]", wall_time=0.45),
        trial(1, history="[[0.2,1,0.5]]", wall_time=0.25),
        trial(2, history="[[0.2,0,0.5]]", wall_time=0.75),  # succeeded although it came within the margin
        trial(3, history="[[0.1,1,0.5]]", wall_time=0.15, success=False),  # solved, but the noise was too much
        trial(4, success=False, wall_time=None, error="ValueError: no"),
    ]
    assert [solved_after(row) for row in rows] == [0.3, 0.2, 0.75, None, None]
    counts = {limit: success_by(rows, limit).successes for limit in (0.1, 0.2, 0.25, 0.3, 0.7, 0.75, 100.0)}
    assert counts == {0.1: 0, 0.2: 1, 0.25: 1, 0.3: 2, 0.7: 2, 0.75: 3, 100.0: 3}
    within = success_by(rows, 0.3)
    assert (within.trials, within.rate) == (5, 0.4)
    assert (within.lower, within.upper) == wilson_interval(2, 5)
    with pytest.raises(ValueError, match="deadline is 0"):
        success_by(rows, 0)
    with pytest.raises(ValueError, match="there are no trials"):
        success_by([], 1.0)


# Kills, crashes and time.

TROUBLE = """
import os, signal, time
from d4orm_planners.evaluation import trials
from d4orm_planners.base.policy import GoToGoal


class Trouble(GoToGoal):
    def _begin(self, env, seed):
        if seed == 1:
            raise RuntimeError("out of luck")
        if seed == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        if seed == 3:
            time.sleep(1000)


fresh_policy = trials.fresh_policy
trials.fresh_policy = lambda name, **settings: Trouble() if "GoToGoal" in name else fresh_policy(name, **settings)
"""
EVALUATE = """
from d4orm_planners import evaluate

if __name__ == "__main__":
    rows = evaluate({policies}, out="out", seeds=range(6), num_robots=2, control_noise_std=[0, 0.1], {arguments})
    print(*((row.trials, row.errors) for row in rows))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_what_crashes_dies_or_hangs_is_a_row_and_the_rest_goes_on(tmp_path: Path) -> None:
    result = program(
        tmp_path, TROUBLE + EVALUATE.format(policies='"go-to-goal"', arguments="workers=2, trial_timeout=8")
    )
    assert result.stdout == "(6, 3) (6, 3)\n", result.stderr
    stored = TrialStore(tmp_path / "out" / STORE).trials()
    errors = {(row.seed, row.control_noise_std): row.error for row in stored}
    assert {key for key, error in errors.items() if not error} == {
        (seed, noise) for seed in (0, 4, 5) for noise in (0.0, 0.1)
    }
    for noise in (0.0, 0.1):
        assert errors[1, noise] == "RuntimeError: out of luck (program.py, line 10)"
        assert errors[2, noise] == "ChildProcessError: the worker process died (SIGKILL, perhaps for lack of memory)"
        assert errors[3, noise] == "TimeoutError: took longer than 8 s"
    assert {row.verified for row in stored if row.error} == {None}
    # Without the trouble the same call runs again what failed, and nothing else.
    before = {row.key: row for row in stored if not row.error}
    result = program(tmp_path, EVALUATE.format(policies='"go-to-goal"', arguments="workers=2"))
    assert result.stdout == "(6, 0) (6, 0)\n", result.stderr
    after = {row.key: row for row in TrialStore(tmp_path / "out" / STORE).trials()}
    assert len(after) == 12
    assert all(after[key] == row for key, row in before.items())


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="needs signal masks")
def test_ctrl_c_does_not_end_a_worker_that_starts() -> None:
    class Interrupted(ProcessWorker):
        def start(self, job: Any) -> None:
            super().start(job)
            assert self._process is not None
            os.kill(self._process.pid or 0, signal.SIGINT)

    said = list(run_jobs([SimpleNamespace(num_parts=2, run=partial(iter, "ab"))], [Interrupted()]))
    assert [letter for letters in said for letter in letters] == ["a", "b"]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_a_plan_that_cannot_be_made_fails_at_all_levels_at_once(tmp_path: Path) -> None:
    slow = '{"d4orm": {"improve": True, "max_iterations": 1_000_000}}'
    body = EVALUATE.format(policies=slow, arguments="workers=1, trial_timeout=1").replace("range(6)", "[0]")
    result = program(tmp_path, body)
    assert result.stdout == "(1, 1) (1, 1)\n", result.stderr
    assert {row.error for row in TrialStore(tmp_path / "out" / STORE).trials()} == {
        "TimeoutError: took longer than 1 s"
    }


@pytest.mark.slow
def test_a_program_without_a_guard_is_told_so(tmp_path: Path) -> None:
    body = EVALUATE.format(policies='"go-to-goal"', arguments="workers=2").replace(
        'if __name__ == "__main__":', "if True:"
    )
    result = program(tmp_path, body)
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("ChildProcessError: a worker process died at its start (exit status 1)")
    assert "__main__" in last


@pytest.mark.slow
def test_two_evaluations_may_share_a_store(tmp_path: Path) -> None:
    arguments = ["-p", "go-to-goal", "-k", "4", "--control-noise-std", "0,0.1", "-q", "-o", str(tmp_path)]
    command = [sys.executable, "-m", "d4orm_planners.cli.app", "evaluate", *arguments]
    both = [subprocess.Popen([*command, "-n", seeds, "-j", "1"]) for seeds in ("0-5", "3-8")]
    assert [process.wait() for process in both] == [0, 0]
    rows = TrialStore(tmp_path / STORE).trials()
    assert [(row.control_noise_std, row.seed) for row in rows] == [
        (noise, seed) for noise in (0.0, 0.1) for seed in range(9)
    ]
    assert not any(row.error for row in rows)
    connection = sqlite3.connect(tmp_path / STORE)
    assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    connection.close()


def test_a_full_disk_is_one_line_and_the_store_stays_whole(
    d4orm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connect = sqlite3.connect

    def full(*arguments: Any, **options: Any) -> sqlite3.Connection:
        connection = connect(*arguments, **options)
        connection.execute("PRAGMA max_page_count = 4")
        return connection

    monkeypatch.setattr("d4orm_planners.evaluation.sqlite_file.sqlite3.connect", full)
    arguments = ("evaluate", "-p", "go-to-goal", "-k", "2", "-n", "40", "-j", "1", "-o", "out")
    status, _, err = d4orm(*arguments)
    assert status == 2
    assert err.count("\n") == 1
    assert "cannot be used: database or disk is full; free some space or choose another folder" in err
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    done = TrialStore(Path("out") / STORE).finished()
    assert 0 < len(done) < 40
    assert d4orm(*arguments)[0] == 0
    assert len(TrialStore(Path("out") / STORE).finished()) == 40


# What is written.


def test_the_files_equal_the_store(d4orm, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    arguments = ("-p", "go-to-goal", "-p", "orca:time_horizon=2", "-s", "circle,random", "-k", "2,3", "-n", "2")
    status, out, err = d4orm("evaluate", *arguments, "--control-noise-std", "0,0.1", "-j", "1", "-o", "here")
    assert (status, err) == (0, "")
    folder = tmp_path / "here"
    stored = TrialStore(folder / STORE).trials()
    assert len(stored) == 2 * 2 * 2 * 2 * 2
    assert {row.label for row in stored} == {"go-to-goal", "orca:time_horizon=2"}
    parquet = pandas.read_parquet(folder / "trials.parquet")
    assert list(parquet.columns) == [field.name for field in fields(Trial)]
    assert parquet.astype(object).where(parquet.notna(), None).to_dict("records") == [asdict(row) for row in stored]
    texts = {field.name: str for field in fields(Trial) if field.type == "str"}
    table = pandas.read_csv(folder / "trials.csv", dtype=texts, keep_default_na=False, na_values={"travel_time": ""})
    for name in ("seed", "control_noise_std", "travel_time", "history", "success", "violation"):
        assert list(table[name]) == [getattr(row, name) for row in stored]
    text = (folder / "table.md").read_text()
    assert "### random, 3 robots, holonomic2d" in text
    assert text.strip() in out
    with (folder / "table.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 2 * 2 * 2 * 2


@pytest.mark.slow
def test_ten_thousand_rows_are_exported(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    store = TrialStore(tmp_path / STORE)
    rows = [
        trial(seed, control_noise_std=seed / 7, verified=[True, False, None][seed % 3], violation='a "b",\nc')
        for seed in range(10_000)
    ]
    assert store.add(*rows) == 10_000
    assert store.add(*rows) == 0
    stored = store.trials()
    assert sorted(stored, key=lambda row: row.seed) == rows
    paths = write_results(tmp_path, [success_rate(stored)])
    assert [path.name for path in paths] == ["table.md", "table.csv", "trials.csv", "trials.parquet"]
    assert parquet.read_table(paths[3]).to_pylist() == [asdict(row) for row in stored]
    assert read_parquet(paths[3]) == stored
    with paths[2].open(newline="") as file:
        written = list(csv.DictReader(file))
    assert [(int(row["seed"]), float(row["control_noise_std"]), row["verified"]) for row in written] == [
        (row.seed, row.control_noise_std, "" if row.verified is None else str(row.verified)) for row in stored
    ]
    assert {row["violation"] for row in written} == {'a "b", c'}


def test_what_is_no_parquet_of_trials_is_refused_by_name(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    (tmp_path / "text.parquet").write_text("policy,seed")
    pandas.DataFrame({"policy": ["d4orm"], "colour": ["blue"]}).to_parquet(tmp_path / "other.parquet")
    for name in ("text", "other"):
        with pytest.raises(ValueError, match=rf"{name}\.parquet is no Parquet file of trials") as error:
            read_parquet(tmp_path / f"{name}.parquet")
        assert "\n" not in str(error.value)


def test_without_pyarrow_there_is_csv_and_a_word_about_it(
    d4orm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    status, _, err = d4orm("evaluate", "-p", "go-to-goal", "-k", "2", "-n", "1", "-j", "1", "-q")
    assert status == 0
    assert (
        err
        == "trials.parquet is not written, which needs pyarrow; install it with: pip install 'd4orm-env[evaluate]'\n"
    )
    written = {path.name for path in (tmp_path / "evaluation").iterdir()}
    assert "trials.csv" in written
    assert "trials.parquet" not in written
    with pytest.warns(UserWarning, match=r"pip install 'd4orm-env\[evaluate\]'"):
        evaluate("go-to-goal", out=tmp_path / "evaluation", **TINY)


def test_a_disk_that_fills_up_while_exporting_is_one_line(
    d4orm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    status, _, err = d4orm("evaluate", "-p", "go-to-goal", "-k", "2", "-n", "1", "-j", "1", "-q", "-o", "here")
    assert status == 2
    assert err.count("\n") == 1
    assert "table.md cannot be written: No space left on device; free some space" in err
    assert len(TrialStore(tmp_path / "here" / STORE).trials()) == 1


def test_the_table_row_by_row(tmp_path: Path) -> None:
    rows = [
        trial(
            0,
            denoising_share=0.5,
            history="[[0.1,1,0.5,40,0.75]]",
            wall_time=0.25,
            preparation=0.1,
            travel_time=4.0,
            stretch=1.25,
            training_time=1170.0,
        ),
        trial(1, travel_time=6.0, stretch=1.75),
        trial(2, success=False, verified=False, collided=2),
    ]
    write_csv(tmp_path / "trials.csv", [vars(row) for row in rows])
    assert write_parquet(tmp_path / "trials.parquet", rows)
    assert markdown([success_rate(rows)]).splitlines() == [
        "### circle, 2 robots, holonomic2d",
        "",
        "| policy | noise | success | 95% interval | verified | contact | not in time | errors | travel time, s | "
        "stretch | denoising steps | denoising, iterations | denoising, time | planning, s | decision, ms | "
        "training, min | computing per s of motion, s |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
        # The interval of two values, 4 and 6: half of it is 12.7062 * sqrt(2) / sqrt(2).
        "| d4orm | 0 | 2 of 3 (67%) | 21% to 94% | 2 | 1 | 0 | 0 | 5.00 (-7.71 to 17.71) | 1.50 | 40 | 50% | 75% | "
        "0.50 | 2.50 | 20 | 0.069 (0.010 to 0.129) |",
    ]


def test_the_share_of_the_time_is_told_where_all_plans_tell_it() -> None:
    told, older = trial(0, history="[[0.1,0,0.4,20,0.5],[0.2,1,0.5,40,0.25]]"), trial(1, history="[[0.1,1,0.5,40]]")
    searched = trial(2, history="[[0.1,1,0.5,0]]")
    assert [one.denoising_time_share for one in (told, older, searched, trial(3))] == [0.25, None, 0, None]
    assert success_rate([told, searched, trial(3)]).denoising_time_share == 0.125
    assert success_rate([told, older]).denoising_time_share is None


# The leaderboard.


def test_the_leaderboard_holds_everything_in_the_store(d4orm, tmp_path: Path) -> None:
    store = TrialStore(tmp_path / STORE)
    history = "[[0.1,0,0.5],[0.3,1,0.4]]"
    store.add(trial(0, config='{"num_samples": 512}', history=history))
    store.add(trial(0, config='{"num_samples": 64}', success=False))
    store.add(trial(0, policy="orca", label="orca"), trial(1, policy="orca", label="orca"))
    store.add(
        trial(
            0,
            policy="orca",
            label="orca",
            control_noise_std=0.1,
            scenario="random",
            problem="b",
            error="ValueError: no",
            success=False,
        )
    )
    assert d4orm("leaderboard", ".", "--out", "page.md", "--deadlines", "0.2,1") == (0, "wrote page.md\n", "")
    page = (tmp_path / "page.md").read_text()
    assert page.startswith("# Leaderboard\n")
    assert page.index("### holonomic2d, no noise") < page.index("### holonomic2d, noise 0.1")
    assert "| policy | circle, 2 robots, holonomic2d | random, 2 robots, holonomic2d |" in page
    assert "| orca | 100% (34% to 100%) | - |" in page
    ranked = [line.split(" | ")[0] for line in page.splitlines() if "%) | " in line and " of " in line]
    assert ranked == ["| d4orm (num_samples=512)", "| orca", "| d4orm (num_samples=64)", "| orca"]
    assert "| d4orm (num_samples=512) | 0% (0% to 79%) | 100% (21% to 100%) |" in page
    assert "- `orca`: ValueError: no" in page
    assert "- 5 trials" in page
    assert leaderboard(store.trials()).count("deadline") == 0
    # The same from Parquet, and together with another store.
    assert write_parquet(tmp_path / "trials.parquet", store.trials())
    assert d4orm("leaderboard", "trials.parquet", "-o", "same.md", "--deadlines", "0.2,1")[0] == 0
    assert (tmp_path / "same.md").read_text() == page
    TrialStore(tmp_path / "more.sqlite").add(trial(0, policy="go-to-goal", label="go-to-goal"))
    assert d4orm("leaderboard", "trials.parquet", "more.sqlite", "-o", "both.md")[0] == 0
    assert "- 6 trials" in (tmp_path / "both.md").read_text()
    # Trials that stand in two of them are counted once.
    assert d4orm("leaderboard", ".", "trials.parquet", ".", "-o", "once.md", "--deadlines", "0.2,1")[0] == 0
    assert (tmp_path / "once.md").read_text() == page


def test_problems_of_one_name_are_no_one_row_of_the_leaderboard() -> None:
    """As of a scenario file that was changed between two calls."""
    old = [trial(seed, problem="a", date="2026-11-01") for seed in range(4)]
    new = [trial(seed, problem="b", date="2026-11-02", success=False) for seed in range(2, 6)]
    page = leaderboard(new + old)
    assert "### circle, problem 1, 2 robots, holonomic2d" in page
    assert page.count("4 of 4 (100%)") == page.count("0 of 4 (0%)") == 1
    # Other seeds may have other problems.
    drawn = [trial(seed, problem=f"{seed}") for seed in range(4)]
    assert "| policy | circle, 2 robots, holonomic2d |" in leaderboard(drawn)
    assert "4 of 4" in leaderboard(drawn)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("missing",), "there is no store of trials at missing"),
        (("missing.parquet",), "missing.parquet"),
        (("empty",), "there is no store of trials at empty"),
        ((".",), "the store holds no trials yet"),
        ((".", "--out", "page.html"), "must end in .md"),
        ((".", "--deadlines", "soon"), "--deadlines 'soon' is not a list of numbers"),
        (("notes.sqlite",), "is no store of trials"),
    ],
)
def test_bad_input_to_the_leaderboard(d4orm, tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    TrialStore(tmp_path / STORE)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.sqlite").write_text("these are my notes, " * 100)
    status, _, err = d4orm("leaderboard", *arguments)
    assert (status, err.count("\n")) == (2, 1)
    assert message in err
    assert not list(tmp_path.glob("*.md"))
    assert not list((tmp_path / "empty").iterdir())


def test_a_label_names_a_policy_on_the_command_line(d4orm, tmp_path: Path) -> None:
    chosen = ("-p", "orca:time_horizon=3,label=Hasty ORCA", "-p", "go-to-goal:label=1")
    assert d4orm("evaluate", *chosen, "-k", "1", "-n", "1", "-j", "1", "-q")[0] == 0
    with (tmp_path / "evaluation" / "table.csv").open(newline="") as file:
        assert [(row["label"], row["policy"]) for row in csv.DictReader(file)] == [
            ("Hasty ORCA", "orca"), ("1", "go-to-goal")
        ]  # fmt: skip


def test_evaluating_nothing_but_errors_ends_with_status_one(d4orm, tmp_path: Path) -> None:
    arguments = ("-k", "2", "-n", "2", "-j", "1", "-m", "unicycle", "--out", "out")
    status, out, err = d4orm("evaluate", "-p", "ppo", *arguments)
    assert status == 1
    assert "ppo" in out
    assert "every trial (2) ended with an error; the first: ValueError: the policy in ppo.safetensors" in err
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"trials.sqlite", "table.md"}
    assert d4orm("evaluate", "-p", "ppo,go-to-goal", *arguments)[0] == 0, "one policy that runs is a result"


def test_the_same_setting_in_another_spelling_is_the_same_configuration(tmp_path: Path) -> None:
    policies = [Configuration("d4orm", "d4orm", settings).config for settings in SPELLINGS]
    assert policies == [policies[0]] * len(SPELLINGS)
    with pytest.raises(ValueError, match="one policy with the same settings"):
        evaluate({"a": {"policy": "mppi", "sigma": 1}, "b": {"policy": "mppi", "sigma": 1.0}}, out=tmp_path / "out")


SPELLINGS: tuple[dict[str, Any], ...] = (
    {"temperature": 0.1, "time_limit": 1.0}, {"temperature": np.float64(0.1), "time_limit": 1},
)  # fmt: skip


def test_several_models_meet_every_scenario_and_team_size(tmp_path: Path) -> None:
    models = ["velocity2d", None, "differential_drive"]
    rows = evaluate(
        "go-to-goal", ["circle", "random"], out=tmp_path, model=models, num_robots=[1, 2], seeds=[0], workers=1
    )
    named = ("velocity2d", "holonomic2d", "differential_drive")
    expected = [(name, model, size) for name in ("circle", "random") for model in named for size in (1, 2)]
    assert [(row.scenario, row.model, row.num_robots) for row in rows] == expected


def test_teams_that_differ_from_seed_to_seed_are_no_one_row(tmp_path: Path) -> None:
    def crowd(seed: int, num_robots: int | None = None) -> Any:
        model = "velocity2d" if seed > 2 else "holonomic2d"
        return make_problem("random", num_robots=num_robots or 2 + seed % 2, seed=seed, model=model)

    rows = evaluate("go-to-goal", [crowd], out=tmp_path, seeds=range(4), workers=1)
    assert [(row.num_robots, row.model, row.trials) for row in rows] == [
        (2, "holonomic2d", 2), (3, "holonomic2d", 1), (3, "velocity2d", 1)
    ]  # fmt: skip


# Bad input.

BAD = [
    (("-p", "gaol"), "policy 'gaol' is unknown"),
    (("-p", "orca:speed=1"), "'speed' is no setting of policy 'orca'"),
    (("-p", "orca:time_horizon"), "--policy 'time_horizon' is not of the form name=value"),
    (("-p", "orca:policy=goal"), "'policy' is no setting"),
    (("-p", "orca,orca:time_horizon=5"), "settings stand behind one policy"),
    (("-s", "square"), "scenario 'square' is unknown"),
    (("-s", "missing.yaml"), "missing.yaml"),
    (("-s", "good.yaml", "-k", "3"), "num_robots, model and scenario_settings do not go with scenario files"),
    (("-s", "good.yaml", "--scenario-set", "dt=0.1"), "scenario_settings do not go with scenario files"),
    (("--scenario-set", "diameter"), "--scenario-set 'diameter' is not of the form name=value"),
    (("--scenario-set", "loops=1"), "scenario 'circle' takes no argument 'loops'"),
    (("--scenario-set", "num_robots=3"), "scenario_settings has 'num_robots'; give 'num_robots' itself"),
    (("--scenario-set", "seed=3"), "scenario_settings has 'seed'; give 'seeds' itself"),
    (("-k", "0"), "num_robots is 0"),
    (("-k", "two"), "--num-robots 'two'"),
    (("-m", "hovercraft"), "model 'hovercraft' is unknown"),
    (("--control-noise-std", "0,-0.1"), "control_noise_std is -0.1"),
    (("--control-noise-std", "much"), "--control-noise-std 'much' is not a list of numbers"),
    (("-n", "0"), "--seeds '0' names no seed"),
    (("-n", "few"), "--seeds 'few' is neither a number"),
    (("-n", "5-1"), "--seeds '5-1' names no seed"),
    (("-n", "-1,2"), "seed is -1"),
    (("-n", "9223372036854775808"), "--seeds '9223372036854775808' asks for more than 1000000 seeds"),
    (("-n", "0-1000000"), "--seeds '0-1000000' asks for more than"),
    (("-j", "0"), "workers is 0"),
    (("-p", "go-to-goal:label="), "label is empty; give a name, as in d4orm:label=ours"),
    (("-p", "d4orm,d4orm"), "--policy gives 'd4orm' twice; leave one out, or set a label"),
    (("-p", "orca:time_horizon=3,label=x", "-p", "d4orm:label=x"), "--policy gives 'x' twice"),
    (("--time-limit", "0"), "time_limit is 0"),
    (("--time-limit", "1", "-p", "go-to-goal"), "none of the policies is one"),
    (("--trial-timeout", "-1"), "trial_timeout is -1"),
    (("--trial-timeout", "1e17"), "trial_timeout is 1e+17; it must be at most 1e+06"),
    (("--time-limit", "1e17"), "time_limit is 1e+17; it must be at most 1e+06"),
    (("-o", "file"), "'file' cannot be made"),
    (("-o", "/proc/evaluation"), "choose another"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_bad_input_is_one_line_and_status_two(d4orm, tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    (tmp_path / "file").write_text("")
    save_problem(make_problem("circle", num_robots=2), tmp_path / "good.yaml")
    if arguments[-1].startswith("/proc") and not Path("/proc").is_dir():
        pytest.skip("needs a folder that not even root can write to")
    status, _, err = d4orm("evaluate", *arguments)
    assert (status, err.count("\n")) == (2, 1)
    assert err.startswith("d4orm: ")
    assert message in err
    assert {path.name for path in tmp_path.iterdir()} == {"file", "good.yaml"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policies": []}, "policies is empty"),
        ({"policies": ["orca", "orca"]}, "two policies are called 'orca'; leave one out"),
        (
            {"policies": {"orca": {}, "same": {"policy": "orca"}}},
            "'orca' and 'same' are one policy with the same settings",
        ),
        ({"policies": {"mine": object()}}, r"policies\['mine'\] is <object .*; give the settings of a policy, as {}"),
        ({"policies": {"mine": "d4orn"}}, "policy 'd4orn' is unknown; .*did you mean 'd4orm'"),
        ({"policies": object()}, "policy <object object at .* is no name; give one of d4orm"),
        ({"policies": [{"policy": "go-to-goal"}]}, "policy {'policy': 'go-to-goal'} is no name"),
        ({"policies": {3: {}}}, "policy 3 is no name"),
        ({"scenarios": []}, "scenarios, num_robots or model is empty"),
        ({"num_robots": []}, "scenarios, num_robots or model is empty"),
        ({"seeds": []}, "seeds is empty"),
        ({"seeds": 5}, r"seeds is 5; give the seeds themselves, as range\(50\)"),
        ({"seeds": [0.5]}, "seed must be a whole number, not 0.5"),
        ({"seeds": [2**63]}, "seed is about 1e19; it must be at most 9223372036854775807"),
        ({"control_noise_std": []}, "control_noise_std is empty"),
        ({"disturbances": {"": [Delay(1)]}}, "give levels by name, as {'delay'"),
        ({"disturbances": {3: [1]}}, "disturbances is {3: .*; give levels by name, as {'delay'"),
        ({"scenario_settings": [1]}, r"scenario_settings is \[1\]; give arguments by name"),
        ({"num_robots": [[2, 3]]}, r"num_robots holds \[2, 3\]; give one value, or a list of them, not of lists"),
        ({"scenarios": [["circle"]]}, r"scenarios holds \['circle'\]; give one value, or a list"),
        ({"num_robots": np.array(2.5)}, r"num_robots holds array\(2.5\); give one value"),
        ({"seeds": np.array(5)}, r"seeds is array\(5\); give the seeds themselves"),
        ({"control_noise_std": np.array("a")}, "control_noise_std must be a number, not array"),
        ({"time_limit": "soon"}, "time_limit must be a number, not 'soon'"),
        ({"observation": ["observed_rays"]}, r"observation is \['observed_rays'\]; give arguments by name"),
    ],
)
def test_bad_arguments(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate(**{"policies": "go-to-goal", "out": tmp_path / "out", **TINY, **changes})
    assert not (tmp_path / "out").exists()


# Ray.


def test_without_ray_the_error_says_what_to_install(d4orm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    status, _, err = d4orm("evaluate", "-p", "go-to-goal", "-k", "2", "-n", "1", "--ray", "auto")
    assert status == 2
    assert err == "d4orm: running on a cluster needs ray; install it with: pip install 'd4orm-env[distributed]'\n"
    assert not (tmp_path / "evaluation" / STORE).exists()


@pytest.mark.cluster
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_a_cluster_gives_the_same_rows_and_one_for_a_worker_that_is_lost(tmp_path: Path) -> None:
    """One program for both: Ray takes seconds to start."""
    # Workers import the module by name, and with it the trouble.
    (tmp_path / "trouble.py").write_text(TROUBLE + "def hook(): pass\n")
    options = "num_cpus=2, log_to_driver=False, runtime_env={'worker_process_setup_hook': 'trouble.hook'}"
    start = f"import ray\nray.init(address='local', {options})\n"
    sound = EVALUATE.format(policies='"orca"', arguments='ray="auto"')
    # A worker that takes the place of a lost one has to start within it too.
    troubled = EVALUATE.format(policies='"go-to-goal"', arguments='ray="auto", trial_timeout=30')
    result = program(tmp_path, start + sound + troubled.replace("[0, 0.1]", "[0]"))
    # Ray may have something to say before, between and after.
    assert {"(6, 0) (6, 0)", "(6, 3)"} <= set(result.stdout.splitlines()), result.stderr
    rows = TrialStore(tmp_path / "out" / STORE).trials()
    study = Study(policies=["orca"], seeds=range(6), num_robots=2, control_noise_std=[0, 0.1])
    run_study(study, tmp_path / "here", workers=1)
    changes: dict[str, Any] = {"wall_time": None, "preparation": None, "elapsed": None, "date": "", "machine": ""}
    there, here = (
        [replace(row, **changes) for row in trials if row.policy == "orca"]
        for trials in (rows, TrialStore(tmp_path / "here" / STORE).trials())
    )
    assert there == here
    errors = {row.seed: row.error for row in rows if row.error}
    assert errors[1].startswith("RuntimeError: out of luck (")
    assert errors[2].startswith("ChildProcessError: the worker was lost (WorkerCrashedError: ")
    assert errors[3] == "TimeoutError: took longer than 30 s"


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("auto", "Ray cluster 'auto' cannot be reached"),
        ("127.0.0.1:1", "Ray cluster '127.0.0.1:1' cannot be reached (ConnectionRefusedError: "),
        ("nowhere", "Ray address 'nowhere' is neither auto, nor local, nor of the form host:port"),
    ],
)
def test_an_unreachable_cluster_is_one_line(d4orm, address: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Other tests start instances meanwhile, which come and go.
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr("ray._private.services.find_gcs_addresses", lambda: set())
    status, _, err = d4orm("evaluate", "-p", "go-to-goal", "-k", "2", "-n", "1", "--ray", address)
    assert (status, err.count("\n")) == (2, 1)
    assert message in err
    assert Path("evaluation").exists() == (address != "nowhere")


OWN_MODEL = """
import dataclasses

from d4orm_env import make_problem, register_model
from d4orm_env.dynamics.models import get_model

register_model(dataclasses.replace(get_model("velocity2d"), name="drifter"))


def arena(seed, num_robots=2):
    return make_problem("circle", num_robots=num_robots, seed=seed, model="drifter")
"""


@pytest.mark.slow
def test_workers_know_the_models_of_a_scenarios_module(tmp_path: Path, d4orm) -> None:
    (tmp_path / "own.py").write_text(OWN_MODEL)
    arguments = ("--policy", "go-to-goal", "--num-robots", "2", "--seeds", "2", "--workers", "2", "--out", "out", "-q")
    with forgetting(MODELS):
        result = d4orm("evaluate", "--scenario", "own.py:arena", *arguments)
    assert result.status == 0, result.err


class Remembers(Policy):
    """It keeps what it did in an episode in a list, which it clears when it is reset."""

    def __init__(self) -> None:
        self.memory: list[int] = []

    def reset(self, env: Any, seed: int = 0) -> None:
        super().reset(env, seed)
        self.memory.clear()

    def act(self, observations: Any, state: Any) -> Any:
        self.memory.append(1)
        return dict.fromkeys(observations, np.full(2, 0.01 * len(self.memory)))


def test_trials_do_not_change_a_policy_of_ones_own(tmp_path: Path) -> None:
    """So that a study that is done does not run again."""
    policy = Remembers()
    for _ in range(2):
        evaluate({"mine": policy}, "circle", out=tmp_path, scenario_settings={"horizon": 5}, **TINY)
    assert not policy.memory
    assert len(TrialStore(tmp_path / STORE).trials()) == len(TINY["seeds"])


def leaves(_: Any) -> Any:
    sys.exit()


def no_utf8(_: Any) -> Any:
    raise ValueError("bad \ud800 byte")


class Nameless(Exception):
    def __str__(self) -> str:
        raise RuntimeError


def nameless(_: Any) -> Any:
    raise Nameless


def test_whatever_a_policy_raises_is_a_row(tmp_path: Path) -> None:
    policies = {"leaves": leaves, "no_utf8": no_utf8, "nameless": nameless, "go-to-goal": {}}
    evaluate(policies, "circle", out=tmp_path, **TINY)
    errors = {row.label: row.error.partition(" (")[0] for row in TrialStore(tmp_path / STORE).trials()}
    assert errors == {
        "leaves": "SystemExit: ",
        "no_utf8": r"ValueError: bad \ud800 byte",
        "nameless": "Nameless: its message fails with RuntimeError",
        "go-to-goal": "",
    }
