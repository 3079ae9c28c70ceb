"""The command line: what it does, and that bad input gets one clear line, exit status 2, and leaves no file behind."""

from __future__ import annotations

import importlib.metadata
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

import numpy as np
import pytest
import typer

from d4orm_env import make_problem
from d4orm_env.dynamics.models import MODELS
from d4orm_planners import make_planner
from d4orm_planners.base.plan import Plan
from d4orm_planners.cli import outputs
from d4orm_planners.engine.score import score_kernel
from d4orm_planners.hybrid import compile_ahead

QUICK = ("--set", "num_samples=64", "--set", "num_steps=5", "--max-iterations", "1")


def test_plan_writes_the_plan_and_its_pictures(d4orm, tmp_path: Path) -> None:
    files = ("--out", "plan.npz", "--picture", "plan.png", "--animation", "plan.gif")
    outcome = d4orm("plan", "--num-robots", "2", "--seed", "3", *files)
    assert outcome.status == 0, outcome.err
    plan = Plan.load(tmp_path / "plan.npz")
    assert plan.solved
    assert plan.seed == 3
    assert plan.problem.num_robots == 2
    assert "solved" in outcome.out
    assert "yes" in outcome.out
    assert {path.name for path in tmp_path.iterdir()} == {"plan.npz", "plan.png", "plan.gif"}


def test_plan_writes_a_replay(d4orm, tmp_path: Path) -> None:
    outcome = d4orm("plan", "--num-robots", "2", "--out", "plan.html")
    assert outcome.status == 0, outcome.err
    assert "wrote plan.html" in outcome.out
    assert "circle, 2 robots by hybrid" in (tmp_path / "plan.html").read_text(encoding="utf-8")


def test_a_stretch_that_is_unknown_is_a_dash(capsys: pytest.CaptureFixture[str]) -> None:
    plan = make_planner("d4orm", engine="cpu", num_samples=16, num_steps=2).solve(
        make_problem("circle", num_robots=2, horizon=5), max_iterations=1
    )
    outputs.print_plan(plan)
    row = next(line for line in capsys.readouterr().out.splitlines() if "stretch" in line)
    assert row.split()[1:-1] == ["stretch", "│", "-"]


@pytest.mark.slow
def test_planning_and_running_take_the_recommended_planner(d4orm) -> None:
    assert d4orm("plan", "--num-robots", "2", "--out", "plan.npz", "--quiet").status == 0
    assert Plan.load("plan.npz").planner == make_planner().name
    chosen = [d4orm("run", "--num-robots", "4", *given) for given in ((), ("--policy", make_planner().name))]
    assert chosen[0].out == chosen[1].out
    assert d4orm("run", "--num-robots", "4", "--policy", "").status == 2


def test_run_compares_policies_side_by_side(d4orm, tmp_path: Path) -> None:
    outcome = d4orm("run", "--num-robots", "2", "--compare", "go-to-goal, random", "--out", "compare.html")
    assert outcome.status == 0, outcome.err
    page = (tmp_path / "compare.html").read_text(encoding="utf-8")
    assert page.index('"title": "go-to-goal"') < page.index('"title": "random"')


def test_a_model_for_each_robot(d4orm, tmp_path: Path) -> None:
    chosen = ("--model", "holonomic2d,velocity2d", "--num-robots", "2", "--out", "plan.npz")
    assert d4orm("plan", *chosen, *QUICK).status in (0, 1)
    assert Plan.load(tmp_path / "plan.npz").problem.team.models == ("holonomic2d", "velocity2d")


def test_run_takes_settings_of_policies(d4orm, tmp_path: Path) -> None:
    policies = ("--compare", "d4orm:num_samples=64,max_iterations=1", "--compare", "go-to-goal")
    outcome = d4orm("run", "--num-robots", "2", *policies, "--out", "compare.html")
    assert outcome.status == 0, outcome.err
    assert '"title": "d4orm:num_samples=64,max_iterations=1"' in (tmp_path / "compare.html").read_text(encoding="utf-8")
    assert d4orm("run", "--num-robots", "2", "--policy", "orca:time_horizon=3", "--quiet").status == 0


@pytest.mark.parametrize("model", MODELS)
def test_what_is_compiled_ahead_fits_robots_of_every_model(model: str) -> None:
    assert compile_ahead.smallest_problem((model,) * 3).num_robots == 3


@pytest.mark.parametrize(
    ("planner", "scenario", "samples"),
    [
        ("hybrid", "circle", True), ("hybrid", "random", False), ("hybrid", "warehouse", False),
        ("d4orm-d", "random", True), ("d4orm", "warehouse", True),
    ],
)  # fmt: skip
def test_what_samples_is_compiled_ahead_where_a_first_plan_samples(
    monkeypatch: pytest.MonkeyPatch, planner: str, scenario: str, samples: bool
) -> None:
    sampled: list[object] = []
    problem, said = make_problem(scenario, 8, seed=0), []
    monkeypatch.setattr(compile_ahead, "in_another_process", lambda call: SimpleNamespace(wait=lambda: None))
    monkeypatch.setattr(compile_ahead, "sample_once", sampled.append)
    for missing in ([score_kernel(problem.team.models)], [score_kernel(problem.team.models), None], []):
        monkeypatch.setattr(compile_ahead, "has_to_be_compiled", lambda kernel, m=missing: kernel in m or None in m)
        compile_ahead.compile_for_planning(make_planner(planner), problem, lambda: said.append("compiling"))
    # With all kernels missing something is always compiled, with none nothing.
    assert (len(sampled), len(said)) == (2 * samples, 1 + samples)


def test_of_a_big_team_some_robots_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    failures = {f"robot_{robot}": "ends 5 m from its goal" for robot in range(400)}
    plan: Any = SimpleNamespace(solved=False, status="time_limit", iterations=1, failures=failures)
    with pytest.raises(typer.Exit):
        outputs.require_solved(plan)
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 + outputs.MOST_REASONS + 1
    assert said[-1] == "  and 380 other robots; Plan.failures has all"


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--compare", "go-to-goal,random"), "--compare needs --out"),
        (
            ("--compare", "go-to-goal", "--policy", "d4orm", "--out", "a.html"),
            "--policy does not go with --compare go-to-goal",
        ),
        (("--compare", "go-to-goal,nobody", "--out", "a.html"), "nobody"),
        (("--out", "a.htm"), "must end in .html"),
    ],
)
def test_what_cannot_be_compared_is_said(d4orm, tmp_path: Path, options: Sequence[str], complaint: str) -> None:
    outcome = d4orm("run", "--num-robots", "2", *options)
    assert outcome.status == 2
    assert complaint in outcome.err
    assert not list(tmp_path.iterdir())


def test_run_executes_a_plan_file(d4orm) -> None:
    assert d4orm("plan", "--num-robots", "2", "--out", "plan.npz", "--quiet").status == 0
    outcome = d4orm("run", "plan.npz")
    assert outcome.status == 0, outcome.err
    assert "success" in outcome.out


def test_run_tells_which_pictures_it_has_written(d4orm) -> None:
    files = ("--out", "run.html", "--picture", "run.png", "--animation", "run.gif")
    outcome = d4orm("run", "--policy", "go-to-goal", "--num-robots", "1", *files)
    assert outcome.status == 0, outcome.err
    assert outcome.out.splitlines()[-3:] == [f"wrote {name}" for name in files[1::2]]


def test_run_of_a_policy_that_collides_exits_with_one(d4orm) -> None:
    outcome = d4orm("run", "--policy", "go-to-goal", "--num-robots", "2")
    assert outcome.status == 1
    assert "robots in contact" in outcome.out


@pytest.mark.parametrize(
    "names", [("--num-robots", "--num-obstacles", "--control-noise-std"), ("--robots", "--obstacles", "--noise")]
)
@pytest.mark.slow
def test_options_have_the_names_of_arguments_and_shorter_ones(d4orm, names: tuple[str, ...]) -> None:
    outcome = d4orm("run", "--policy", "random", *(part for name in names for part in (name, "2")))
    assert outcome.status == 1, outcome.err


def test_no_solution_in_the_budget_exits_with_one_and_still_writes_the_best_plan(d4orm, tmp_path: Path) -> None:
    outcome = d4orm("plan", "--num-robots", "8", *QUICK, "--out", "plan.npz")
    assert outcome.status == 1
    assert outcome.err.startswith("no solution found")
    assert not Plan.load(tmp_path / "plan.npz").solved


@pytest.mark.slow
def test_demo_plans_executes_verifies_and_says_where(d4orm, tmp_path: Path) -> None:
    outcome = d4orm("demo", "--num-robots", "3", "--out", "pictures")
    assert outcome.status == 0, outcome.err
    written = {path.name for path in (tmp_path / "pictures").iterdir()}
    assert written == {"plan.npz", "plan.png", "execution.gif", "execution.html"}
    assert "verified" in outcome.out
    for name in written:
        assert name in outcome.out


def test_demo_shows_the_denoising(d4orm, tmp_path: Path) -> None:
    outcome = d4orm("demo", "--denoising", "--num-robots", "3", "--out", "pictures")
    assert outcome.status == 0, outcome.err
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {"denoising.png", "denoising.html"}
    assert "denoising step 100 of" in (tmp_path / "pictures" / "denoising.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_scenario_file(d4orm, tmp_path: Path) -> None:
    robot = "{model: velocity2d, start: [0, 0], goal: [1, 0]}"
    (tmp_path / "mine.yaml").write_text(f"version: 1\nname: mine\nrobots:\n  - {robot}\n")
    assert d4orm("plan", "--scenario", "mine.yaml", "--quiet").status == 0


def test_arguments_of_a_scenario(d4orm) -> None:
    settings = ("--scenario-set", "diameter=2e0", "--scenario-set", "margin=0.1")
    assert d4orm("plan", "--num-robots", "2", *settings, *QUICK, "--out", "plan.npz", "--quiet").status in (0, 1)
    assert Plan.load(Path("plan.npz")).problem == make_problem("circle", 2, diameter=2.0, margin=0.1)


@pytest.mark.parametrize("command", ["scenarios", "planners"])
def test_lists(d4orm, command: str) -> None:
    outcome = d4orm(command)
    assert outcome.status == 0
    assert {"scenarios": "amswarm_5", "planners": "d4orm"}[command] in outcome.out
    assert "``" not in outcome.out


@pytest.mark.parametrize(
    ("name", "listed", "missing"),
    [
        ("cem", {"sigma", "elite_fraction"}, "temperature"),
        ("d-d4orm", {"planner", "nodes", "late_samples"}, "repair_steps"),
        ("d4orm-c2f", {"weight_cutoff", "deadline"}, "nodes"),
        ("d4orm-d", {"penalty_rise", "paper, authors"}, "nodes"),
        ("go-to-goal", {"no settings"}, "sigma"),
    ],
)
def test_the_settings_of_one_are_listed(d4orm, name: str, listed: set[str], missing: str) -> None:
    outcome = d4orm("planners", name)
    assert outcome.status == 0
    assert all(setting in outcome.out for setting in listed)
    assert missing not in outcome.out


BAD = [
    (("plan", "--num-robots", "0"), "num_robots is 0"),
    (("plan", "--num-robots", "three"), "not 'three'"),
    (("plan", "--planner", "nope"), "planner 'nope' is unknown; choose one of d4orm"),
    (("plan", "--preset", "nope"), "preset 'nope'"),
    (("plan", "--scenario", "nope"), "scenario 'nope' is unknown"),
    (("plan", "--scenario", "map"), "scenario 'map' needs map=, the path of a .map file"),
    (("plan", "--scenario", "map", "--scenario-set", "map=missing.map"), "missing.map: cannot be read"),
    (("run", "--scenario", "map", "--scenario-set", "map=nan.yaml"), "nan.yaml: has no field 'image'"),
    (("plan", "--scenario", "maze", "--scenario-set", "loops"), "'loops' is not of the form name=value, as diameter=8"),
    (("plan", "--scenario", "maze", "--scenario-set", "loop=1"), "takes no argument 'loop'"),
    (("plan", "--scenario-set", "num_robots=3"), "--scenario-set num_robots is said by --num-robots; use that"),
    (("plan", "--scenario", "good.yaml", "--scenario-set", "dt=1"), "--scenario-set does not go with a scenario"),
    (("plan", "--scenario", "missing.yaml"), "missing.yaml"),
    (("plan", "--scenario", "nan.yaml"), "finite"),
    (("plan", "--scenario", "overlap.yaml"), "overlap"),
    (("plan", "--scenario", "good.yaml", "--num-robots", "4"), "--num-robots does not go with a scenario file"),
    (("plan", "--model", "hovercraft"), "model 'hovercraft' is unknown"),
    (("plan", "--engine", "gpu"), "engine 'gpu' is unknown"),
    (("plan", "--set", "num_samples"), "name=value"),
    (("plan", "--set", "num_samples=1"), "num_samples is 1"),
    (("plan", "--set", "nonsense=1"), "nonsense"),
    (("plan", "--set", "num_samples=64", "--set", "num_samples=65"), "--set gives 'num_samples' twice"),
    (("plan", "--planner", "cem", "--set", "temperature=1"), "'temperature' is no setting of planner 'cem'; it takes"),
    (("plan", "--planner", "d4orm-c2f"), "use make_policy('d4orm-c2f'), or d4orm run --policy d4orm-c2f"),
    (("planners", "d4rom"), "did you mean 'd4orm'?"),
    (("plan", "--set", "temperature=[1"), "the value is not YAML"),
    (("plan", "--set", "temperature=!!python/name:os.system"), "tags are not supported"),
    (("plan", "--set", "temperature=1e400"), "temperature is inf"),
    (("plan", "--set", "improve=yes"), "improve must be True or False, not 'yes'"),
    (("plan", "--engine", "cpu", "--set", "engine=jax"), "--engine and --set engine say the same"),
    (("plan", "--engine", "auto", "--set", "engine=cpu"), "--engine and --set engine say the same"),
    (("plan", "--preset", "paper", "--set", "preset=paper"), "--preset and --set preset say the same"),
    (("plan", "--max-iterations", "2", "--set", "max_iterations=3"), "--max-iterations and --set max_iterations"),
    (("plan", "--planner", "d-d4orm", "--set", "nodes=100000000"), "nodes is 100000000; it must be at most 1024"),
    (("plan", "--planner", "d-d4orm", "--set", "num_samples=1e21"), "num_samples must be a whole number, not 1e+21"),
    (("plan", "--scenario", "endless.yaml"), "horizon is 100000000"),
    (("plan", "--seed", "-1"), "seed is -1"),
    (("plan", "--time-limit", "0"), "time_limit is 0"),
    (("plan", "--max-iterations", "0"), "max_iterations is 0"),
    (("plan", "--out", "plan.txt"), "must end in .npz"),
    (("plan", "--out", "missing/plan.npz"), "does not exist; create it"),
    (("plan", "--out", "loop.npz"), "loop.npz: Too many levels of symbolic links"),
    (("plan", "--scenario", "x" * 9999), "is unknown"),
    (("plan", "--scenario", f"{'x' * 9999}.yaml"), "File name too long"),
    (("plan", "--picture", "plan.bmp"), "must end in .png"),
    (("plan", "--no-such-option",), "--no-such-option"),
    (("plan", "--height", "1"), "arguments of scenarios go by --scenario-set height=..."),
    (("run", "truncated.npz"), "truncated.npz is not a readable plan"),
    (("run", "absent.npz"), "absent.npz"),
    *(
        (("run", "whole.npz", option, value), f"{option} does not go with a plan file; whole.npz has a problem")
        for option, value in (
            ("--scenario", "circle"), ("--num-robots", "2"), ("--model", "velocity2d"), ("--num-obstacles", "0"),
            ("--policy", "d4orm"), ("--scenario-set", "diameter=6"),
        )
    ),
    (("bench", "--seeds", "99999999999"), "1000000"),
    (("bench", "--num-robots", "4,99999"), "num_robots is 99999; it must be at most 10000"),
    (("run", "--control-noise-std", "-1"), "control_noise_std is -1"),
    (("run", "--policy", "nope"), "policy 'nope' is unknown"),
    (("run", "--policy", "d4orm-c2f", "--preset", "nope"), "preset 'nope' of policy 'd4orm-c2f' is unknown"),
    (("run", "--policy", "orca", "--preset", "paper"), "'preset' is no setting of policy 'orca'"),
    (("run", "--policy", "orca,d4orm"), "--policy 'orca,d4orm' names several; give one, or all of them to --compare"),
    (("run", "--policy", "d4orm:nope=1"), "'nope' is no setting of planner 'd4orm'"),
    (("run", "--policy", "d4orm:name=1"), "'name' is no setting; the name stands before the colon"),
    (("run", "--policy", "d4orm:preset=paper", "--preset", "authors"), "'d4orm:preset=paper' name two presets"),
    (("plan", "--num-robots", "2", "-k", "3"), "--num-robots is given 2 times; give it once"),
    (("export", "plan.npz", "--out", ""), "--out is empty; give it a value, or leave it out"),
    (("evaluate", "--policy="), "--policy is empty; give it a value, or leave it out"),
    (("leaderboard", ""), "stores is empty; give it a value, or leave it out"),
    (("export", "whole.npz", "--format", "crazyswarm2", "--rate", "10", "-o", "a"), "--rate 10 would count"),
    (("demo", "--out", "good.yaml"), "good.yaml"),
    (("demo", "--num-robots", "0"), "num_robots"),
    (("demo", "--denoising", "--engine", "gpu", "--out", "a/b"), "engine 'gpu' is unknown"),
    (("evaluate", "--trial-timeout", "nan"), "trial_timeout is nan"),
    (("evaluate", "--scenario", "missing.yaml", "--out", "a/b"), "missing.yaml"),
    (("evaluate", "--seeds", "9-3"), "--seeds '9-3' names no seed; give a number"),
    (("evaluate", "--disturb", "push.speed=1,,2"), "the list is not YAML"),
    (("robustness", "--workers", "0"), "workers is 0"),
    (("leaderboard", "missing", "--out", "a.txt"), "'a.txt' must end in .md"),
    (("leaderboard", "missing", "--out", "a/b.md"), "does not exist; create it"),
    (("nonsense",), "nonsense"),
    (("train",), "Missing argument 'algorithm'. See d4orm train --help."),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[" ".join(arguments)[:80] for arguments, _ in BAD])
def test_bad_input_is_one_line_and_status_two(d4orm, tmp_path: Path, arguments: Sequence[str], message: str) -> None:
    line = "version: 1\nname: x\nrobots:\n"
    robot = "  - {model: velocity2d, start: [%s, 0], goal: [%s, 1]}\n"
    (tmp_path / "good.yaml").write_text(line + robot % (0, 0))
    (tmp_path / "nan.yaml").write_text(line + robot % (".nan", 0))
    (tmp_path / "endless.yaml").write_text(line + robot % (0, 0) + "horizon: 100000000\n")
    (tmp_path / "overlap.yaml").write_text(line + robot % (0, 0) + robot % (0.1, 5))
    (tmp_path / "loop.npz").symlink_to("loop.npz")
    assert d4orm("plan", "--scenario", "good.yaml", "--quiet", *QUICK, "--out", "whole.npz").status in (0, 1)
    (tmp_path / "truncated.npz").write_bytes((tmp_path / "whole.npz").read_bytes()[:500])
    before = sorted(tmp_path.rglob("*"))
    outcome = d4orm(*arguments)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1
    assert outcome.err.startswith("d4orm: ")
    assert len(outcome.err) < 2100
    assert message in outcome.err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.filterwarnings("default")
def test_a_warning_is_one_line_without_a_line_of_the_program(d4orm, tmp_path: Path) -> None:
    robots = "  - {model: velocity2d, start: [%g, 0], goal: [%g, 1]}\n"
    (tmp_path / "tight.yaml").write_text("version: 1\nname: x\nrobots:\n" + robots * 2 % (0, 0, 0.34, 2))
    outcome = d4orm("run", "--scenario", "tight.yaml", "--policy", "go-to-goal", "--quiet")
    assert outcome.err.startswith("d4orm: warning: problem 'x': the start of robot_1 is 0.04 m from robot_0, and the ")
    assert outcome.err.count("\n") == 1
    assert "schema.py" not in outcome.err


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("plan", "--out", "pipe.npz"), "pipe.npz is a device or a pipe"),
        (("run", "pipe.npz"), "pipe.npz is not a readable plan (is not a file; give the path of a plan)"),
        (("run", "--scenario", "pipe.yaml"), "pipe.yaml: is not a file; give the path of a YAML file"),
        (("run", "--scenario", "map", "--scenario-set", "map=pipe.map"), "pipe.map: is not a file"),
        (
            ("run", "--scenario", "map", "--scenario-set", "map=map.yaml"),
            "map.yaml: is not a file; give the path of an",
        ),
        (("leaderboard", "pipe.parquet"), "pipe.parquet is no Parquet file of trials (is not a file; give the path"),
        (("leaderboard", "pipe.sqlite"), "there is no store of trials at pipe.sqlite"),
        (("node", "--config", "pipe.yaml"), "pipe.yaml: is not a file"),
    ],
)
def test_a_pipe_is_refused_and_not_waited_for(d4orm, tmp_path: Path, arguments: Sequence[str], message: str) -> None:
    for suffix in ("npz", "yaml", "map", "parquet", "sqlite"):
        os.mkfifo(tmp_path / f"pipe.{suffix}")
    (tmp_path / "map.yaml").write_text("image: pipe.npz\nresolution: 1\norigin: [0, 0, 0]\n")
    outcome = d4orm(*arguments)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1
    assert message in outcome.err


@pytest.mark.parametrize("setting", ["beta_start=1e-4", "beta_end=2E-2", "late_steps=7e-1", "late_samples=.5"])
def test_numbers_may_have_an_exponent_without_a_point(d4orm, setting: str) -> None:
    default = d4orm("plan", "--num-robots", "2", *QUICK, "--out", "default.npz", "--quiet")
    given = d4orm("plan", "--num-robots", "2", *QUICK, "--set", setting, "--out", "given.npz", "--quiet")
    assert given.status == default.status
    np.testing.assert_array_equal(Plan.load(Path("given.npz")).controls, Plan.load(Path("default.npz")).controls)


def test_settings_have_an_option_of_their_own_or_set(d4orm) -> None:
    settings = ("--set", "engine=cpu", "--set", "preset=paper", "--set", "max_iterations=1")
    assert d4orm("plan", "-p", "d4orm", "-k", "2", *QUICK[:4], *settings, "--quiet").status in (0, 1)


def test_version(d4orm) -> None:
    outcome = d4orm("--version")
    assert (outcome.status, outcome.out) == (0, f"d4orm {importlib.metadata.version('d4orm-env')}\n")


def test_no_command_shows_the_help(d4orm) -> None:
    assert d4orm().out == d4orm("--help").out


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs a folder that not even root can write to")
@pytest.mark.parametrize("arguments", [("plan", "--out", "/proc/plan.npz"), ("demo", "--out", "/proc/demo")])
def test_unwritable_folder(d4orm, arguments: Sequence[str]) -> None:
    outcome = d4orm(*arguments)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1
    assert "choose another" in outcome.err


COMMANDS = ("demo", "plan", "run", "evaluate", "leaderboard", "robustness", "scenarios", "planners")


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_help(d4orm, command: list[str]) -> None:
    outcome = d4orm(*command, "--help")
    assert outcome.status == 0
    assert "--help" in outcome.out


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\nfrom d4orm_planners.cli import app as cli\n"
        "try:\n    cli.main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = ('numba', 'jax', 'torch', 'matplotlib', 'pettingzoo', 'pyarrow', 'pyrvo', 'ray')\n"
        "print([m for m in heavy if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env={**os.environ, "COLUMNS": "100"}
    )
    assert result.stdout.splitlines()[-1] == "[]"


def command_line(*arguments: str, shell: str = '"$@"', **environment: str) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, run by a shell."""
    return subprocess.run(
        ["sh", "-c", shell, "sh", sys.executable, "-m", "d4orm_planners.cli.app", *arguments],
        capture_output=True, text=True, errors="replace", env={**os.environ, **environment},
    )  # fmt: skip


@pytest.mark.skipif(sys.platform != "linux", reason="needs a shell and /dev/full")
@pytest.mark.parametrize(
    ("shell", "status", "lines"),
    [
        ('("$@"; echo $? >&2) | head -n 1', "0", 0),
        ('("$@"; echo $? >&2) | true', "0", 0),
        ('"$@" >&-; echo $? >&2', "0", 0),
        ('"$@" <&- >&-; echo $? >&2', "0", 0),
        ('"$@" > /dev/full; echo $? >&2', "2", 1),
    ],
)
def test_what_becomes_of_the_output_decides_on_nothing(shell: str, status: str, lines: int) -> None:
    complaint = command_line("scenarios", shell=shell).stderr.splitlines()
    assert complaint[-1] == status
    assert len(complaint) == 1 + lines


@pytest.mark.skipif(os.name != "posix", reason="needs a shell")
def test_without_a_stream_for_complaints_the_status_says_it() -> None:
    assert command_line("planners", "nobody", shell='"$@" 2>&-').returncode == 2
    assert command_line("planners", "nobody", shell='"$@" <&- >&- 2>&-').returncode == 2


@pytest.mark.skipif(os.name != "posix", reason="needs a shell")
def test_a_character_that_the_output_lacks_ends_nothing(tmp_path: Path) -> None:
    options = ("--policy", "go-to-goal", "--num-robots", "2", "--out", str(tmp_path / "\u00e4\u4e2d.html"))
    outcome = command_line("run", *options, PYTHONIOENCODING="latin-1:strict")
    assert (outcome.returncode, outcome.stderr) in ((0, ""), (1, ""))
    assert outcome.stdout.rstrip().endswith("\\u4e2d.html")


def test_a_file_that_ends_too_early_is_not_taken_for_ctrl_c(d4orm, monkeypatch: pytest.MonkeyPatch) -> None:
    def ended(name: str) -> None:
        raise EOFError("Ran out of input")

    monkeypatch.setattr("d4orm_planners.cli.listings.default_settings", ended)
    outcome = d4orm("planners", "d4orm")
    assert outcome.status == 2
    assert outcome.err == "d4orm: something that was read ended too early (Ran out of input)\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_nothing_half_written(
    d4orm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    before = signal.getsignal(signal.SIGTERM)

    def interrupted(file: BinaryIO, **arrays: object) -> None:
        file.write(b"half")
        signal.raise_signal(number)

    monkeypatch.setattr(np, "savez_compressed", interrupted)
    outcome = d4orm("plan", "--num-robots", "2", *QUICK, "--out", "plan.npz", "--quiet")
    assert outcome.status == 130
    assert not list(tmp_path.iterdir())
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize("name", ["link.npz", "x" * 251 + ".npz", "\u00e4" * 125 + ".npz", "-.npz"])
def test_a_plan_is_written_whatever_the_name_is(d4orm, tmp_path: Path, name: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "link.npz").symlink_to("folder/plan.npz")
    outcome = d4orm("plan", "--num-robots", "2", *QUICK, f"--out={name}", "--quiet")
    assert outcome.status in (0, 1), outcome.err
    assert Plan.load(tmp_path / name).problem.num_robots == 2
    assert (tmp_path / "link.npz").is_symlink()
    assert (tmp_path / "folder" / "plan.npz").exists() == (name == "link.npz")


@pytest.mark.parametrize(
    ("target", "complaint"),
    [("nowhere/plan.npz", "does not exist"), ("folder", "is a folder"), ("link.npz", "Too many")],
)
def test_a_link_that_leads_to_no_file_is_refused_before_planning(
    d4orm, tmp_path: Path, target: str, complaint: str
) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "link.npz").symlink_to(target)
    outcome = d4orm("plan", "--out", "link.npz")
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1
    assert complaint in outcome.err


def test_warmup_says_beforehand_that_nothing_can_be_kept(
    d4orm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("d4orm_planners.cli.warmup.warm_up", lambda: pytest.fail("it compiles"))
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path / "cache"))

    def full(**options: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as context:
        context.setattr("d4orm_env.engine.caching.TemporaryFile", full)
        outcome = d4orm("warmup")
        assert outcome.status == 2
        assert outcome.err.count("\n") == 1
        assert "cannot be written to (No space left on device); set NUMBA_CACHE_DIR" in outcome.err
    monkeypatch.setattr("d4orm_env.engine.caching._CacheFolder._locator_classes", [])
    monkeypatch.setattr("d4orm_env.engine.caching._is_private", lambda folder: True)
    assert "no cache folder can be written to; set NUMBA_CACHE_DIR" in d4orm("warmup").err


def test_without_a_terminal_progress_is_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for interval, lines in ((0.0, ["1 of 2, 0 s: a", "2 of 2, 0 s: b"]), (60.0, [])):
        monkeypatch.setattr(outputs, "LOG_INTERVAL", interval)
        with outputs.parts_progress() as progress:
            progress("a", 1, 2)
            progress("b", 2, 2)
        assert capsys.readouterr().err.splitlines() == lines
