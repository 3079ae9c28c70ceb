"""The benchmark and the warm-up: what they measure and write. How fast anything is, is not tested here."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from numba.core import config

from d4orm_env.dynamics.models import COMMON, MODEL_CODES, NUM_BUILT_IN, get_model
from d4orm_env.scenarios import make_problem
from d4orm_planners.base.provenance import commit, describe_machine
from d4orm_planners.evaluation import bench_report, measuring, probes
from d4orm_planners.evaluation.benchmark import CONTROL_LOOPS, parts, run_parts, thread_counts
from d4orm_planners.evaluation.measuring import MODELS, QUICK, SECTIONS, BenchmarkSettings, Spread, measure
from d4orm_planners.evaluation.probes import measure_startup

sys.path.append(str(Path(__file__).parents[1] / "release"))
from bench_compare import slower

TINY: dict[str, Any] = {
    "num_robots": (2, 3),
    "models": ("holonomic2d",),
    "num_samples": 64,
    "horizon": 10,
    "num_steps": 2,
    "repetitions": 1,
    "time_limit": 0.2,
    "most_robots_slow": 2,
    "env_steps": 10,
    "num_worlds": 3,
    "plan_robots": (2,),
    "seeds": 2,
    "plan_time_limit": 5.0,
    "thread_robots": (3,),
    "memory_robots": 2,
    "obstacles": (3,),
    "far_obstacles": (5,),
    "map_cells": (4,),
    "big_random": (3,),
    "big_warehouse": (2,),
    "big_drives": (),
    "big_boxes": (),
    "big_free_boxes": (),
    "big_seeds": 1,
    "improved_robots": (3,),
    "loop_robots": (3,),
    "loops": 2,
}


@pytest.fixture(scope="module")
def results() -> dict[str, list[Any]]:
    """One benchmark on sizes that take no time, but for the compiling of everything from nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("D4ORM_NUM_THREADS", "3")
        todo = [part for part in parts(BenchmarkSettings(**TINY)) if part[0] != "startup"]
    seen: list[tuple[int, int]] = []
    results = run_parts(todo, lambda what, done, total: seen.append((done, total)))
    assert seen == [(done, len(todo)) for done in range(len(todo) + 1)]
    return results


def test_spread_is_the_five_numbers() -> None:
    spread = Spread.of([5.0, 1.0, 2.0, 4.0, 3.0])
    assert spread == Spread(3.0, 2.0, 4.0, 1.0, 5.0, 5)
    assert spread.times(10) == Spread(30.0, 20.0, 40.0, 10.0, 50.0, 5)


@pytest.mark.parametrize(("ticks", "count"), [([1.0, 1.0, 1.0, 1.0], 3), ([2.0, 3.0, 9.0, 9.0], 2)])
def test_measure_leaves_the_first_call_out_and_stops(
    monkeypatch: pytest.MonkeyPatch, ticks: list[float], count: int
) -> None:
    clock = [0.0]
    calls = iter([100.0, *ticks])
    monkeypatch.setattr(measuring.time, "perf_counter", lambda: clock[0])

    def work() -> None:
        clock[0] += next(calls)

    spread = measure(BenchmarkSettings(repetitions=3, time_limit=4.0), work)
    assert spread.count == count
    assert spread.largest == max(ticks[:count])


@pytest.mark.slow
def test_every_engine_rule_and_size_is_measured(results: dict[str, list[Any]]) -> None:
    cases = {(row["engine"], row["rules"], row["num_robots"]) for row in results["denoising"]}
    assert cases == {
        ("cpu", "default", 2), ("cpu", "paper", 2), ("jax", "paper", 2), ("plain", "paper", 2),
        ("cpu", "default", 3), ("cpu", "paper", 3),
    }  # fmt: skip
    assert set(results) == set(SECTIONS) - {"startup"}


@pytest.mark.parametrize(("cores", "counts"), [(1, []), (2, [2]), (3, [2, 3]), (8, [2, 4, 8]), (12, [2, 4, 8, 12])])
def test_threads_double_up_to_the_cores(monkeypatch: pytest.MonkeyPatch, cores: int, counts: list[int]) -> None:
    monkeypatch.setenv("D4ORM_NUM_THREADS", str(cores))
    assert thread_counts() == counts


@pytest.mark.slow
def test_the_numbers_hang_together(results: dict[str, list[Any]]) -> None:
    for row in results["denoising"]:
        assert row["ns_per_robot_step"] == pytest.approx(row["step"].median * 1e9 / (64 * 10 * row["num_robots"]))
        assert 0 < row["step"].smallest <= row["step"].median <= row["step"].largest
    for row in results["environments"]:
        assert row["steps_per_second"] == pytest.approx(1 / row["seconds_per_step"].median)
    assert [(row["num_robots"], row["threads"]) for row in results["threads"]] == [(3, 2), (3, 3)]
    for row in results["threads"]:
        assert row["speedup"].count == row["iteration"].count == row["one_thread"].count >= 1
    for row in results["obstacles"]:
        assert row["ratio"].count == row["iteration"].count >= 1
    walls = make_problem("rooms", 8).world.num_obstacles
    assert [(row["obstacles"], row["disturbances"]) for row in results["environments"]] == [
        *[(0, 0), (5, 0), (0, 3), (0, 0), (0, 0), (100, 0)] * 2, (walls, 0), (0, 0), (0, 0), (0, 0)
    ]  # fmt: skip
    names = {row["environment"] for row in results["environments"]}
    assert {"make_vec, rooms along paths", "FunctionalEnv"} <= names
    assert {f"{one}, {of}" for one in ("parallel_env", "make_vec") for of in ("32 rays", "rectangles")} <= names
    assert [(row["obstacles"], row["where"]) for row in results["obstacles"]] == [(3, "near"), (5, "far")]
    assert [(row["model"], row["mode"]) for row in results["robots"]] == list(CONTROL_LOOPS)
    assert all(row["loop"].count > 30 and row["loop_95"] > 0 for row in results["robots"])
    (index,) = results["index"]
    assert 0 < index["bytes"] < 2**20
    (memory,) = results["memory"]
    assert 30 * 2**20 < memory["imported"] <= memory["peak"] < 2**32
    default, paper = results["plans"]
    assert (default["rules"], paper["rules"]) == ("default", "paper")
    assert default["solved"] == default["seeds"] == default["seconds"].count == 2


def test_every_model_that_comes_with_the_package_is_measured_and_the_plain_loop_where_it_has_it() -> None:
    todo = parts(BenchmarkSettings(**{**TINY, "models": MODELS, "engines": ("cpu", "plain")}))
    measured = {what for section, what, _ in todo if section == "denoising"}
    # Cars with trailers do not fit on the circle.
    expected = {name for name in tuple(MODEL_CODES)[:NUM_BUILT_IN] if not get_model(name).trailers}
    assert {what.split()[1] for what in measured} == expected
    assert {what.split()[1] for what in measured if what.endswith("plain")} == set(COMMON)


@pytest.mark.slow
def test_whole_iterations_that_would_take_too_long_are_left_out(results: dict[str, list[Any]]) -> None:
    assert all(row["iteration"] is not None for row in results["denoising"])
    settings = BenchmarkSettings(**{**TINY, "engines": ("cpu",), "num_robots": (2,), "iteration_limit": 1e-6})
    _, _, work = next(parts(settings))
    row = work()
    assert row["iteration"] is None
    assert bench_report.milliseconds(row["iteration"]) == "-"


def test_the_record_tells_processors_of_one_name_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "CPU_NAME", None)
    assert re.fullmatch(r".+ \([\w.+-]+\)", str(describe_machine.__wrapped__()["processor"]))
    monkeypatch.setattr(config, "CPU_NAME", "generic")
    assert str(describe_machine.__wrapped__()["processor"]).endswith(" (generic)")


def test_the_commit_is_that_of_the_checkout() -> None:
    git = ["git", "-C", str(Path(__file__).parents[2]), "rev-parse", "--short=12", "HEAD"]
    found = subprocess.run(git, capture_output=True, text=True)
    if found.returncode:
        pytest.skip("the tests are in no checkout")
    assert commit().removesuffix("+") == found.stdout.strip()


@pytest.mark.slow
def test_report_files(results: dict[str, list[Any]], tmp_path: Path) -> None:
    settings = BenchmarkSettings(**TINY)
    bench_report.write_report(tmp_path, settings, bench_report.circumstances("d4orm bench"), results)
    assert {path.name for path in tmp_path.iterdir()} == {"bench.json", "bench.md"}
    document = json.loads((tmp_path / "bench.json").read_text())
    assert document["format"] == bench_report.FORMAT
    assert document["settings"]["num_robots"] == [2, 3]
    assert document["commit"] == commit()
    assert document["machine"]["processor"]
    assert document["machine"]["libraries"]["numba"]
    step = results["denoising"][0]["step"]
    assert document["denoising"][0]["step"]["median"] == pytest.approx(step.median)
    text = (tmp_path / "bench.md").read_text()
    assert "`d4orm bench`" in text
    for title in ("Denoising", "Environment steps", "Memory", "First feasible verified plan"):
        assert title in text
    tables = [line for line in text.splitlines() if line.startswith("|")]
    assert len(tables) > 5 * 3


def test_the_command_takes_its_lists(d4orm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[BenchmarkSettings] = []

    def pretend(settings: BenchmarkSettings) -> list[Any]:
        seen.append(settings)
        return [("memory", "one number", lambda: {"num_robots": 1, "imported": 2**20, "peak": 2**21})]

    monkeypatch.setattr("d4orm_planners.cli.bench.parts", pretend)
    options = ("--num-robots", "4,8", "--models", "velocity2d", "--engines", "cpu,jax", "--seeds", "3", "--quick")
    assert d4orm("bench", "--out", "new", *options).status == 0
    (settings,) = seen
    assert (settings.num_robots, settings.models, settings.engines) == ((4, 8), ("velocity2d",), ("cpu", "jax"))
    assert (settings.seeds, settings.num_steps) == (3, QUICK["num_steps"])
    document = json.loads((tmp_path / "new" / "bench.json").read_text())
    assert document["settings"]["seeds"] == 3
    assert document["memory"] == [{"num_robots": 1, "imported": 2**20, "peak": 2**21}]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--num-robots", "4,x"), "list of whole numbers"),
        (("--num-robots", "0"), "num_robots is 0"),
        (("--models", "boat"), "boat"),
        (("--engines", "gpu"), "gpu"),
        (("--seeds", "0"), "seeds is 0"),
    ],
)
def test_bad_input_is_one_line(d4orm, tmp_path: Path, options: tuple[str, ...], message: str) -> None:
    status, _, error = d4orm("bench", "--out", "new", *options)
    assert status == 2
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_a_first_plan_is_made_and_told_apart_from_compiling() -> None:
    _, told = probes._run(probes._FIRST_PLAN, "circle", 2)
    assert told["solved"]
    assert 0 < told["planning"] <= told["solve"]


CACHED = """
import json, os, pathlib
mark = pathlib.Path(os.environ["NUMBA_CACHE_DIR"], "kernel")
solve = 1.0 if mark.exists() else 3.0
mark.touch()
print(json.dumps({"solve": solve, "planning": 1.0}))
"""
"""As long as what it stands for would take, which compiles when it finds nothing in the cache."""


def test_startup_is_measured_with_an_empty_cache_and_then_with_a_full_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "_FIRST_PLAN", CACHED)
    run, solves = probes._run, []

    def noted(*arguments: Any, **options: Any) -> Any:
        seconds, told = run(*arguments, **options)
        solves.append(told["solve"])
        return seconds, told

    monkeypatch.setattr(probes, "_run", noted)
    startup = measure_startup("circle", num_robots=2, repetitions=2)
    assert solves == [3.0, 1.0, 1.0]
    assert startup["compiling"] == 2.0
    assert startup["warm"].count == 2
    assert startup["cold"] > 0


PLAN = (
    "import hashlib\n"
    "from d4orm_env import make_problem\n"
    "from d4orm_planners import make_planner\n"
    "problem = make_problem('{}', num_robots=4, seed=0)\n"
    "plan = make_planner('d4orm', num_samples=96, num_steps=20{}).solve(problem, seed=0, max_iterations=2)\n"
    "print(hashlib.sha256(plan.controls.tobytes()).hexdigest())\n"
)


def python(folder: Path, *arguments: str, **environment: str) -> str:
    """What an interpreter prints."""
    result = subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, cwd=folder,
        env={**os.environ, **environment},
    )  # fmt: skip
    assert result.returncode in ((0, 1) if "run" in arguments else (0,)), result.stderr
    assert "Traceback" not in result.stderr
    return result.stdout


@pytest.mark.slow
def test_the_process_that_compiles_plans_what_later_ones_plan(tmp_path: Path) -> None:
    # numba tells what it writes.
    settings = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "NUMBA_DEBUG_CACHE": "1"}
    # The kernels of the engine only: digests tell of all others, compiled or not, see test_portability.
    plan = PLAN.format("circle", ", short_paths=False, final_approach=False")
    first, later = (python(tmp_path, "-c", plan, **settings).splitlines() for _ in range(2))
    assert "data saved to" in "".join(first[:-1])
    assert "data saved to" not in "".join(later[:-1])
    assert len(first[-1]) == 64
    assert first[-1] == later[-1]


def kernels(told: str) -> set[str]:
    """Files of the kernels that numba tells to have loaded from its cache or written there."""
    return set(re.findall(r"data (?:loaded from|saved to) '([^']+)'", told))


@pytest.mark.slow
def test_after_a_warm_up_nothing_is_left_to_compile(tmp_path: Path) -> None:
    def d4orm(*arguments: str) -> str:
        return python(tmp_path, "-m", "d4orm_planners.cli.app", *arguments, NUMBA_DEBUG_CACHE="1")

    again = d4orm("warmup")
    if not re.search(r"^0 kernels compiled", again, re.MULTILINE):
        again = d4orm("warmup")
    assert re.search(r"^0 kernels compiled.* [1-9]\d* found in the cache", again, re.MULTILINE), again
    assert any("find_motion" in kernel for kernel in kernels(again)), "no manoeuvres"
    told = python(tmp_path, "-c", PLAN.format("heterogeneous", ""), NUMBA_DEBUG_CACHE="1")
    told += d4orm("plan", "--num-robots", "3", "--out", "plan.npz", "--quiet")
    for command in (
        ("plan.npz", "--control-noise-std", "0.01"),
        ("--policy", "d4orm-c2f", "--disturb", "control_noise=0.5"),
        ("--policy", "d4orm-c2f", "--scenario", "rooms", "--num-robots", "6"),
    ):
        told += d4orm("run", *command, "--quiet")  # succeeds or not, where noise is that strong
    # Other tests have put theirs into the same cache.
    assert kernels(told)
    assert sorted(kernels(told) - kernels(again)) == []


def test_every_section_has_a_table() -> None:
    assert tuple(bench_report._SECTIONS) == SECTIONS
    assert {part[0] for part in parts(BenchmarkSettings(**TINY))} <= set(SECTIONS)


def test_rows_that_got_slower_are_told() -> None:
    def report(step: float, iterations: float = 1.0) -> dict[str, Any]:
        row = {"engine": "cpu", "num_robots": 8, "step": {"median": step}, "iterations": {"median": iterations}}
        return {"date": "today", "denoising": [row]}

    base = [report(0.010), report(0.030), report(0.011)]
    assert slower(base, [report(0.0121), report(0.0119), report(0.0120, 9.0)]) == []
    assert slower(base, [report(0.0132), report(0.0001), report(0.0140)]) == [
        " 1.20 times  denoising: cpu 8, step: 0.011 -> 0.0132 s"
    ]
    assert slower(base, [{"denoising": [{"engine": "jax", "step": {"median": 9.0}}]}]) == []
