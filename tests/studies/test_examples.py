"""The example programs run as a user runs them, and what they write is true."""

from __future__ import annotations

import csv
import importlib
import json
import re
import runpy
import shlex
import subprocess
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from io import StringIO
from itertools import combinations
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import yaml
from examples.common import save_table
from examples.studies import draw_dynobench, dynobench, lifelong, solve_rates, zero_shot
from examples.studies.paper.variants import CountedIpopt, ForgetfulC2F
from examples.studies.settings_studies import irregular_circle
from matplotlib.figure import Figure
from PIL import Image

from d4orm_env import load_dynobench, make_problem, navigation_v0, rollout
from d4orm_env.core.robot_types import ROBOTS
from d4orm_env.envs.joint_state import JointState
from d4orm_planners import Plan, make_planner, make_policy, run_episode
from d4orm_planners.evaluation.tables import read_parquet
from d4orm_planners.sampling.settings import TUNED

pytestmark = pytest.mark.studies

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
PNG = b"\x89PNG"
SOLVE_RATES = {"paper": 1, "big": 1, "canonical": 1, "walls": 1, "few": 3}
"""Tables of ``solve_rates.py``, and how many planners are in each."""


def command_of(name: str) -> list[str]:
    """The module to run for the example of that name, and its first arguments."""
    paths = [path for path in EXAMPLES.rglob(f"{name}.py") if path.parent.name != "studies"]
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths] or ["examples.studies", name]


def run(name: str, out: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the example of that name with ``--quick``, in this process: most take less time than their imports."""
    module, *first = command_of(name)
    command = [name, *first, "--quick", "--out", str(out), *map(str, arguments)]
    output, errors, status = StringIO(), StringIO(), None
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(output), redirect_stderr(errors):
        patch.setattr(sys, "argv", command)
        patch.chdir(out.parent)
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            try:
                status = importlib.import_module(f"{module}.__main__" if first else module).main()
            except SystemExit as exit_:
                status = exit_.code
    plt.close("all")
    return subprocess.CompletedProcess(command, int(status or 0), output.getvalue(), errors.getvalue())


def table(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file, which must have a Markdown twin with as many."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert len(path.with_suffix(".md").read_text().splitlines()) == len(rows) + 2
    return rows


def completed(name: str, out: Path, *arguments: str) -> None:
    result = run(name, out, *arguments)
    assert result.returncode == 0, result.stderr
    assert not [path for path in out.iterdir() if path.name.startswith(".")], "a temporary file was left behind"


def made(name: str, tmp_path: Path, *arguments: str) -> list[dict[str, str]]:
    """The rows of an example's table of the same name, in the folder ``out``."""
    completed(name, tmp_path / "out", *arguments)
    return table(tmp_path / "out" / f"{name}.csv")


def check_made_again(name: str, tmp_path: Path, rows: list[dict[str, str]], of: str | None = None) -> None:
    """The same table, of the study's name if not said, comes of the trials that :func:`made` wrote."""
    completed(name, tmp_path / "again", "--trials", str(tmp_path / "out" / f"{name}.parquet"))
    assert table(tmp_path / "again" / f"{of or name}.csv") == rows


@pytest.mark.parametrize(
    ("name", "module", "extra"),
    [
        ("supersuit_ppo", "supersuit", "rl"),
        ("sb3_joint_ppo", "stable_baselines3", "rl"),
        ("train_and_compare", "stable_baselines3", "rl"),
        ("training_seeds", "stable_baselines3", "rl"),
        ("tune_learners", "stable_baselines3", "rl"),
        ("train_and_compare", "pyrvo", "orca"),
        ("jax_ppo", "optax", "jaxrl"),
        ("cleanrl_ppo", "torch", "rl"),
        ("torchrl_mappo", "torchrl", "rl"),
        ("imitate_expert", "stable_baselines3", "rl"),
        ("read_results", "pandas", "dev"),
        ("read_results", "pyarrow", "evaluate"),
        ("onboard_lifelong", "zenoh", "zenoh"),
        ("zero_shot", "crazyflow", "drones"),
    ],
)
def test_an_example_says_which_extra_is_missing(
    name: str,
    module: str,
    extra: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command, *first = command_of(name)
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, ".".join([command, *first]), raising=False)
    monkeypatch.setattr(sys, "argv", ["x", *first, "--quick"])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_:
        runpy.run_module(command, run_name="__main__")
    assert exit_.value.code == 2
    expected = f"this example needs {module}; install it with: pip install 'd4orm-env[{extra}]'\n"
    assert capsys.readouterr().err == expected
    assert not list(tmp_path.iterdir())


def test_the_first_snippet_of_the_readme_succeeds(capsys: pytest.CaptureFixture[str]) -> None:
    snippet = (ROOT / "README.md").read_text().split("```python\n")[1].partition("```")[0]
    exec(compile(snippet, "README.md", "exec"), {})
    plan, episode = capsys.readouterr().out.splitlines()
    assert plan.startswith("True ")
    assert plan.endswith(" True")
    assert episode.startswith("1.0 ")


@pytest.mark.slow
def test_the_commands_of_the_readme_run(d4orm) -> None:
    commands = (ROOT / "README.md").read_text().split("```bash\n")[1].partition("```")[0].splitlines()
    ours = [words for words in (shlex.split(line, comments=True) for line in commands) if words[0] == "d4orm"]
    assert len(ours) == 2
    for _, *arguments in ours:
        assert d4orm(*arguments).status == 0


def test_cars_of_a_benchmark_are_planned(tmp_path: Path) -> None:
    folder = tmp_path / "cars" / "benchmark"
    folder.mkdir(parents=True)
    content = (EXAMPLES / "scenarios" / "cl_mapf_cars.yaml").read_text()
    (folder / "map_30by30_obst2_agents4_ex0.yaml").write_text(content)
    (folder / "map_30by30_obst2_agents4_ex1.yaml").write_text(content.replace("[15, 5, 1.57]", "[10, 15, 0]"))
    (row,) = made("cl_mapf", tmp_path, "--csdo", str(tmp_path / "cars"))
    assert (row["benchmark"], row["instances"], row["solved"]) == ("CSDO", "30by30 m,   4 cars", "1 of 1")


def test_instances_of_the_kinds_of_db_cbs_are_drawn_and_planned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same with the same seed, and others with another; all are valid and have paths. Costs of db-CBS's runs are
    left out where a trailer bends too far.
    """
    completed("draw_dynobench", tmp_path / "drawn")
    example = tmp_path / "drawn" / "example"
    assert {path.stem for path in example.iterdir()} == {name.format(0) for name in draw_dynobench.NAMES}
    for name, (_, robots, _) in draw_dynobench.NAMES.items():
        path = example / f"{name.format(0)}.yaml"
        assert yaml.safe_load(path.read_text()) == draw_dynobench.drawn(name, 0) != draw_dynobench.drawn(name, 1)
        problem = load_dynobench(path)
        problem.check_reachable()
        assert problem.num_robots == robots
        if "swap" not in name:
            path.unlink()
    runs = tmp_path / "runs.csv"
    runs.write_text(
        "benchmark,instance,solved,seconds,sum_of_costs,hitch\ndrawn,swap_n2_0_unicycle,True,1.0,13.0,\n"
        "drawn,swap_n2_0_hetero,True,2.0,13.0,0.78\ndrawn,swap_n2_0_trailer,True,3.0,13.0,2.0\n"
    )
    monkeypatch.setattr(dynobench, "RIVAL", runs)
    rows = made("dynobench", tmp_path, "--checkouts", str(tmp_path / "drawn"), "--seeds", "1")
    assert {row["instances"]: row["its planning [s]"] for row in rows if row["db-CBS"] == "1 of 1"} == {
        "swap_n2_unicycle": "1.0", "swap_n2_hetero": "2.0", "swap_n2_trailer": "3.0"
    }  # fmt: skip
    compared = {row["instances"] for row in rows if row["costs by its"] != "-"}
    assert compared == {"swap_n2_unicycle", "swap_n2_hetero"}
    assert {row["instances"]: row["solved"] for row in rows} == {
        name.replace("_{}", ""): "1 of 1" for name in draw_dynobench.NAMES if "swap" in name
    }


def test_annealed_noise_beats_constant_noise_in_one_dimension(tmp_path: Path) -> None:
    out = tmp_path / "out"
    rows = {row["method"]: row for row in made("one_dimension", tmp_path)}
    short = {name: float(row["short of the best reward"]) for name, row in rows.items()}
    assert 0 <= short["MBD"] < short["MPPI, large noise"] < short["MPPI, small noise"]
    assert float(rows["MBD"]["movement in the last step"]) < float(
        rows["MPPI, large noise"]["movement in the last step"]
    )
    assert (out / "one_dimension.png").read_bytes().startswith(PNG)
    trap = table(out / "one_dimension_trap.csv")
    share = {(row["method"], row["steps"]): float(row["at the optimum"].rstrip("%")) for row in trap}
    assert share["MBD", "50"] == share["D4orm", "50"] < min(share["MBD", "400"], share["D4orm", "400"])


@pytest.mark.slow
def test_robot_credit_does_not_dilute_with_the_team(tmp_path: Path) -> None:
    out, rows = tmp_path / "out", made("gradient_dilution", tmp_path)
    assert [(row["robots"], row["weighted by"], row["samples"]) for row in rows] == [
        ("1", "robot", "256"), ("16", "team", "256"), ("16", "groups of 4", "256"), ("16", "robot", "256"),
        ("16", "team", "4096"),
    ]  # fmt: skip
    one, team, groups, robot, more = (float(row["reward in the end"]) for row in rows)
    assert robot == pytest.approx(one, abs=0.02)
    assert team < min(groups, more) < max(groups, more) < robot
    # A standard deviation's share of what very many normal samples would have, over the root of the robots that share.
    assert float(rows[0]["its theory"]) / 4 == pytest.approx(float(rows[1]["its theory"]), abs=0.01)
    signal = [float(row["own reward [SD]"]) for row in rows]
    assert signal[1] < signal[4] < signal[2] < signal[3]
    assert signal[2] == pytest.approx(float(rows[2]["its theory"]), rel=0.4)
    assert (out / "gradient_dilution.png").read_bytes().startswith(PNG)


@pytest.mark.slow
def test_step_loop_shows_that_the_plan_avoids_what_driving_straight_does_not(tmp_path: Path) -> None:
    rows = {(float(row["noise [m/s^2]"]), row["policy"]): row for row in made("step_loop", tmp_path)}
    assert rows[0.0, "d4orm"]["success"] == "1 of 1"
    assert rows[0.0, "go-to-goal"]["success"] == "0 of 1"
    assert rows[0.5, "d4orm"]["success"] == "0 of 1", "a plan executed blindly does not survive much noise"


@pytest.mark.slow
def test_mixed_team_example_solves_a_scenario_and_draws_it(tmp_path: Path) -> None:
    scenario = tmp_path / "easy.yaml"
    scenario.write_text(
        "version: 1\nrobots:\n"
        "  - {model: differential_drive, start: [-1.5, 0.0], goal: [1.5, 0.0]}\n"
        "  - {model: velocity2d, start: [0.0, -1.5], goal: [0.0, 1.5]}\n"
    )
    out = tmp_path / "out"
    result = run("mixed_team", out, "--scenario", str(scenario))
    assert result.returncode == 0, result.stdout + result.stderr
    assert "verified: True" in result.stdout
    assert {path.name for path in out.iterdir()} == {"mixed_team.npz", "mixed_team.png", "mixed_team.gif"}
    with Image.open(out / "mixed_team.gif") as animation:
        assert animation.n_frames > 5


@pytest.mark.slow
def test_learners_are_tuned_and_a_second_call_trains_nothing(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    out, rows = tmp_path / "out", made("tune_learners", tmp_path, "--learner", "ppo")
    # Three settings at first, the learner's own among them; the best one goes on.
    assert [bool(row["twice as long"]) for row in rows] == [True, False, False]
    assert sum(row["settings"] == "as they are" for row in rows) == 1
    trained = sorted((path, path.stat().st_mtime_ns) for path in out.glob("*/policy.safetensors"))
    assert len(trained) == 4
    completed("tune_learners", out, "--learner", "ppo")
    assert sorted((path, path.stat().st_mtime_ns) for path in out.glob("*/policy.safetensors")) == trained
    check_made_again("tune_learners", tmp_path, rows)


@pytest.mark.slow
def test_scenarios_are_drawn(tmp_path: Path) -> None:
    completed("scenario_pictures", tmp_path / "out")
    pictures = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in pictures] == ["scenario_paper_circle.png", "scenario_paper_sphere.png"]
    assert all(path.read_bytes().startswith(PNG) for path in pictures)


@pytest.mark.slow
def test_rivals_are_tuned_and_a_second_call_runs_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    completed("tune_rivals", out, "--method", "cem")
    rows = table(out / "tuning.csv")
    # Two settings at first, on four teams; the better one goes on to four seeds.
    assert [(row["method"], row["trials"]) for row in rows] == [("cem", "16"), ("cem", "4")]
    assert sum(row["settings"].startswith("sigma=1.0, elite_fraction=0.05, adapt_variance=False") for row in rows) == 1
    # The preset's steps are more than the small version's budget, so that none of its settings is the preset.
    assert table(out / "tuning_best.csv") == rows[:1]
    trials = (out / "trials.sqlite").read_bytes()
    completed("tune_rivals", out, "--method", "cem")
    assert (out / "trials.sqlite").read_bytes() == trials
    check_made_again("tune_rivals", tmp_path, rows, of="tuning")


@pytest.mark.slow
def test_credit_and_update_are_crossed(tmp_path: Path) -> None:
    out, rows = tmp_path / "out", made("credit_by_update", tmp_path)
    assert len({(row["update"], row["credit"]) for row in rows}) == len(rows) == 25
    assert all((row["p (steps)"] == "-") == (row["update"] == "d4orm") for row in rows)
    assert (out / "credit_by_update.png").read_bytes().startswith(PNG)
    for option in ("--trials", "--go-on-from"):
        again = tmp_path / option
        completed("credit_by_update", again, option, str(out / "credit_by_update.parquet"))
        assert table(again / "credit_by_update.csv") == rows
    # Nothing was run again.
    files = [read_parquet(folder / "credit_by_update.parquet") for folder in (out, again)]
    assert [trial.wall_time for trial in files[0]] == [trial.wall_time for trial in files[1]]


def test_samples_are_counted_for_every_setting(tmp_path: Path) -> None:
    rows = {row["steps x samples"]: row for row in made("fewer_samples", tmp_path)}
    assert len(rows) == 10
    # One iteration each: 100 steps of 1024; 70 of 256; and 30 of 256 with 70 of 128, or of 64.
    counted = {label: row["1000 samples"] for label, row in rows.items() if row["solved"] == "1 of 1"}
    expected = {"100 x 1024": "102", "70 x 256": "18", "100 x 256, the last 70% with 128 (default)": "17",
                "100 x 256, the last 70% with 64": "12"}  # fmt: skip
    assert {label: counted[label] for label in expected} == expected
    check_made_again("fewer_samples", tmp_path, list(rows.values()))


def test_arrivals_are_counted_by_iterations(tmp_path: Path) -> None:
    (row,) = made("arrivals", tmp_path)
    assert (row["robots"], row["iterations until all arrive"], row["solved"]) == ("2", "1", "1 of 1")
    assert row["denoising steps"] == "10"


def test_turned_samples_are_compared_with_others(tmp_path: Path) -> None:
    (row,) = made("independent_noise", tmp_path)
    assert (row["robots"], row["samples"], row["p"]) == ("2", "64", "1")
    assert row["reward, turned"] != row["reward, apart"]


def test_irregular_circles_differ_from_seed_to_seed(tmp_path: Path) -> None:
    rows = made("irregular_circles", tmp_path)
    assert [(row["team"], row["planner"]) for row in rows] == [
        ("2 robots", name) for name in ("d4orm", "mppi", "cem", "d4orm-d")
    ]
    assert (rows[0]["solved"], rows[0]["steps"], rows[0]["p (steps)"]) == ("1 of 1", "20", "-")
    assert int(rows[2]["steps"]) == 2 * int(rows[2]["restricted"]), "one without a solution counts twice its budget"
    positions = [irregular_circle(seed, 6).start[:, :2] for seed in (0, 0, 1)]
    assert (positions[0] == positions[1]).all()
    assert (positions[0] != positions[2]).all()
    assert np.linalg.norm(positions[0], axis=1) == pytest.approx(2.5, abs=0.15)


def test_algorithm_4_has_one_thing_changed_at_a_time(tmp_path: Path) -> None:
    rows = made("algorithm_4_parts", tmp_path)
    configs = {
        trial.label: json.loads(trial.config) for trial in read_parquet(tmp_path / "out/algorithm_4_parts.parquet")
    }
    assert list(dict.fromkeys(row["controller"] for row in rows)) == list(configs)
    written = configs["as written"]
    changed = {label: {key for key in config if config[key] != written.get(key)} for label, config in configs.items()}
    assert changed["guidance not refined"] == {"refine"}
    assert changed["window of 80, subgoal 60 on"] == {"predict_horizon", "subgoal_offset"}
    assert changed["controls reset"] == {"source"}, "a class of the study's own"
    check_made_again("algorithm_4_parts", tmp_path, rows)


def test_controllers_tell_what_share_of_the_time_they_denoise(tmp_path: Path) -> None:
    completed("controller_denoising", tmp_path)
    rows = {row["controller"]: row for row in table(tmp_path / "controller_denoising.csv")}
    assert set(rows) == {"d4orm-c2f", "d4orm-c2f, ours"}
    for row in rows.values():
        assert row["loop, denoising steps"] == "5"
        assert int(row["coarse plan, denoising steps"]) > 0
        assert all(0 < int(row[name].rstrip("%")) <= 100 for name in row if name.startswith("denoising, time"))


def test_a_controller_that_forgets_begins_every_window_with_no_controls() -> None:
    begun: list[float] = []

    class Telling(ForgetfulC2F):
        def _base(self, joint: JointState) -> Any:
            begun.append(float(np.abs(base := super()._base(joint)).max()))
            return base

    policy = make_policy(Telling, preset="paper", refine="off", coarse_samples=64, num_samples=32, num_steps=5)
    run_episode(navigation_v0.parallel_env(scenario="circle", num_robots=2), policy, seed=0)
    assert begun[0] > 0, "the coarse plan's"
    assert len(begun) > 2
    assert not any(begun[1:])


def test_ipopt_tells_its_own_iterations(tmp_path: Path) -> None:
    pytest.importorskip("casadi")
    rows = made("ipopt_starts", tmp_path)
    assert [row["p (iterations)"] for row in rows] == 2 * ["1", "1", "-"] + ["1", "1", "-", "-"]
    assert all(5 < int(row["iterations"]) < 500 for row in rows)
    check_made_again("ipopt_starts", tmp_path, rows)
    problem = make_problem("circle", num_robots=2)
    counted, plain = (make_planner(name, solver_iterations=7, rounds=1).solve(problem, max_iterations=1)
                      for name in (CountedIpopt, "ipopt"))  # fmt: skip
    assert counted.history[0].note == "Maximum_Iterations_Exceeded"
    assert counted.denoising_steps == 7, "no more than it may make"
    assert (counted.controls == plain.controls).all()


def test_p_values_are_corrected_for_their_number_in_the_table(tmp_path: Path) -> None:
    rows = [{"a": 1, "p (x)": 0.01, "p (y)": 0.04}, {"a": 2, "p (x)": None, "p (y)": 0.02}]
    save_table(rows, tmp_path / "rows.csv")
    assert [(row["p (x)"], row["p (y)"]) for row in table(tmp_path / "rows.csv")] == [("0.03", "0.04"), ("-", "0.04")]


def test_jerk_is_smaller_where_it_is_limited(tmp_path: Path) -> None:
    free, limited = (float(row["jerk [m²/s⁶]"]) for row in made("jerk_limits", tmp_path))
    # The jerk's limit is 4 m/s^3.
    assert limited <= 16 < free


def test_smoothness_and_seconds_are_set_beside_mmd(tmp_path: Path) -> None:
    rows = {row["planner"]: row for row in made("against_mmd", tmp_path)}
    assert [row["solved"] for row in rows.values()] == ["1 of 1"] * 3
    # MMD's motions are sums of sines.
    jerk = {label: float(row["jerk [m²/s⁶]"]) for label, row in rows.items()}
    assert jerk["d4orm"] > 10 * max(jerk["mmd"], jerk["mmd, ours"])


STUB = """
from dataclasses import dataclass
import numpy as np
from d4orm_env import make_problem
from d4orm_planners import make_planner

class Envs:
    @staticmethod
    def get_env(name, robots):
        from types import SimpleNamespace
        angle = np.linspace(0, 2 * np.pi, robots, endpoint=False)
        start = 2.5 * np.stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle], axis=-1)
        return SimpleNamespace(x0=start.ravel(), xg=SHIFT - start.ravel())

class d4orm:
    envs = Envs

@dataclass
class Args:
    seed: int
    Nagent: int
    Hsample: int
    Nsample: int
    Niteration: int

def make_reverse_once_naive(*, sigmas):
    return sigmas

def plan_joint_naive(args, sigma, warm_up=False):
    assert not warm_up
    # By 0.25 both drive straight, into each other; by its root they do not.
    if sigma == 0.25:
        controls = np.tile([-2.0, 0.0, 2.0, 0.0], (args.Hsample, 1))
    else:
        problem = make_problem("paper_circle", num_robots=args.Nagent)
        controls = make_planner("d4orm").solve(problem, seed=args.seed).controls.reshape(args.Hsample, -1)
    return controls, None, None, [0.5], True, 1

def run_diffusion(args):
    print("noise of the program")
    sigma = make_reverse_once_naive(sigmas=0.25)
    plan_joint_naive(args, sigma, warm_up=True)
    plan_joint_naive(args, sigma)
"""


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_the_authors_code_runs_from_a_checkout(tmp_path: Path, shift: float) -> None:
    package = tmp_path / "checkout" / "d4orm"
    (package / "planners").mkdir(parents=True)
    for folder in (package, package / "planners"):
        (folder / "__init__.py").write_text("")
    (package / "planners" / "multi_planner.py").write_text(STUB.replace("SHIFT", str(shift)))
    out = tmp_path / "out"
    with pytest.MonkeyPatch.context() as patch:
        for name in ("d4orm", "d4orm.planners", "d4orm.planners.multi_planner"):
            patch.setitem(sys.modules, name, None)
            del sys.modules[name]
        if shift:
            with pytest.raises(ValueError, match="is not 'paper_circle'"):
                run("authors_code", out, "--checkout", package.parent)
            return
        completed("authors_code", out, "--checkout", str(package.parent))
    rows = {row["planner"]: row for row in table(out / "authors_code.csv")}
    assert list(rows) == ["their code", "their code, the paper's deviations", "d4orm, authors", "d4orm, paper"]
    # The stub's word is that it solved; what the controls do says otherwise where robots do not give way.
    assert {label: (row["solved"], row["verified"]) for label, row in rows.items()} == {
        "their code": ("1 of 1", "0 of 1"), "their code, the paper's deviations": ("1 of 1", "1 of 1"),
        "d4orm, authors": ("1 of 1", "1 of 1"), "d4orm, paper": ("1 of 1", "1 of 1"),
    }  # fmt: skip
    assert rows["their code"]["denoising steps"] == "100", "of one iteration"
    check_made_again("authors_code", tmp_path, list(rows.values()))


def test_the_authors_code_needs_a_checkout(tmp_path: Path) -> None:
    assert "give a clone of proroklab/d4orm" in run("authors_code", tmp_path, "--checkout", tmp_path).stderr
    assert "give --checkout" in run("authors_code", tmp_path).stderr


def test_contacts_are_charged_by_every_credit(tmp_path: Path) -> None:
    rows = made("contact_penalty", tmp_path)
    assert len({(row["team"], row["credit, penalty"]) for row in rows}) == len(rows) == 4 * 8
    # In its first iteration everybody is a group of its own.
    by_credit = {(row["team"], row["credit, penalty"].partition(" (")[0]): row["travel time [s]"] for row in rows}
    assert all(by_credit[team, "robot, 2"] == by_credit[team, "group, 2"] for team, _ in by_credit)
    assert any(by_credit[team, "group, 1"] != by_credit[team, "group, 2"] for team, _ in by_credit)
    check_made_again("contact_penalty", tmp_path, rows)


def test_robots_fit_between_the_cylinders_that_are_further_apart(tmp_path: Path) -> None:
    rows = made("amswarm_gaps", tmp_path)
    fits = {row["cylinders"]: float(row["gap [m]"]) > float(row["a robot needs [m]"]) for row in rows}
    assert fits == {"as it is": False, "1.1 times as far apart": True, "1.2 times as far apart": True,
                    "robots of 0.24 m": True, "without those on the left": False}  # fmt: skip
    check_made_again("amswarm_gaps", tmp_path, rows)


def test_defaults_and_the_paper_differ_by_one_setting_at_a_time(tmp_path: Path) -> None:
    out, rows = tmp_path / "out", made("paper_differences", tmp_path)
    assert len({(row["team"], row["settings"]) for row in rows}) == len(rows) == 2 * 12
    trials = read_parquet(out / "paper_differences.parquet")
    configs = {trial.label: json.loads(trial.config) for trial in trials}
    assert configs["preset paper"]["num_samples"] == 1024
    assert configs["defaults"]["credit"] == "group"
    for reference, kind in (("preset paper", "preset"), ("defaults", "defaults")):
        others = [label for label in configs if label.startswith(f"{kind}, ")]
        changed = [{key for key, value in configs[one].items() if value != configs[reference][key]} for one in others]
        assert sorted(map(sorted, changed)) == sorted(
            [["clip_between_iterations"], ["credit", "penalty"], ["random_start"], ["weight_cutoff"],
             ["num_samples"] if kind == "preset" else ["late_samples", "num_samples"]]
        )  # fmt: skip
    check_made_again("paper_differences", tmp_path, rows)


def test_the_paper_its_code_and_ours_meet_head_to_head(tmp_path: Path) -> None:
    out, rows = tmp_path / "out", made("head_to_head", tmp_path)
    assert len({(row["team"], row["planner"]) for row in rows}) == len(rows) == 3 * 4 + 2 + 2 * 6
    trials = {trial.label: json.loads(trial.config) for trial in read_parquet(out / "head_to_head.parquet")}
    base = trials["d4orm-d, authors"]
    changed = {
        label: sorted(key for key, value in config.items() if value != base[key])
        for label, config in trials.items()
        if label.startswith("authors, ")
    }
    assert sorted(changed.values()) == [
        ["clip_after"], ["penalty_per_pair"], ["penalty_rise"], ["reset_after_probe"], ["start"]
    ]  # fmt: skip
    check_made_again("head_to_head", tmp_path, rows)


def test_rivals_meet_the_same_seeds_tuned_and_as_the_paper_has_them(tmp_path: Path) -> None:
    out, rows = tmp_path / "out", made("tuned_rivals", tmp_path)
    methods = [row["method"] for row in rows]
    assert set(methods) >= {"d4orm, defaults", "mbd, tuned", *(f"{name}, paper" for name in TUNED if name != "mbd")}
    assert len(methods) == len(set(methods))
    assert [row["p (steps)"] for row in rows if row["method"] == "d4orm, tuned"] == ["-"]
    configs = {trial.label: json.loads(trial.config) for trial in read_parquet(out / "tuned_rivals.parquet")}
    assert {config["num_steps"] * config["max_iterations"] for config in configs.values()} == {20}
    for label, tuned in (("d4orm, tuned", TUNED["d4orm"]), ("cem, tuned", TUNED["cem"])):
        assert {key: configs[label][key] for key in tuned if key != "num_steps"} == {
            key: value for key, value in tuned.items() if key != "num_steps"
        }
    check_made_again("tuned_rivals", tmp_path, rows)


@pytest.mark.slow
def test_policies_meet_every_disturbance(tmp_path: Path) -> None:
    out, rows = tmp_path / "out", made("disturbance_study", tmp_path)
    assert len({row["disturbance"] for row in rows}) == len(rows) == 13
    assert {(row["scenario"], row["policy"], row["trials"], row["denoising steps"], row["errors"]) for row in rows} == {
        ("circle", "orca", "1", "0", "0")
    }
    assert (out / "disturbance_study.png").read_bytes().startswith(PNG)
    check_made_again("disturbance_study", tmp_path, rows)


@pytest.mark.slow
def test_the_tables_of_the_docs_are_those_of_the_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What ``make reproduce`` does, measured times left out: those of ``bench`` are of one machine.

    Pictures are not painted: there is nothing to compare them with, and the quick versions of the studies paint theirs.
    """
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **options: path.write_bytes(PNG))
    # Many studies are on the same problems.
    monkeypatch.setattr("d4orm_planners.evaluation.study.make_problem", cache(make_problem))
    out, committed = tmp_path / "out", ROOT / "docs" / "tables"
    assert run("all", out).returncode == 0
    made = {path.relative_to(out) for path in out.rglob("*") if path.suffix in (".csv", ".md")}
    assert made == {
        path.relative_to(committed)
        for path in committed.rglob("*")
        if path.suffix in (".csv", ".md") and not path.name.startswith("bench")
    }
    for path in made:
        assert (out / path).read_bytes() == (committed / path).read_bytes(), path


def test_the_table_of_the_readme_is_that_of_the_data() -> None:
    assert (ROOT / "docs" / "tables" / "solve_rates.md").read_text() in (ROOT / "README.md").read_text()


@pytest.mark.slow
def test_solve_rates_make_a_table_per_set(tmp_path: Path) -> None:
    out = tmp_path / "out"
    completed("solve_rates", out)
    for name, planners in SOLVE_RATES.items():
        assert [row["solved"] for row in table(out / f"solve_rates_{name}.csv")] == ["1 of 1"] * planners
    assert len(table(out / "solve_rates.csv")) == 1


@pytest.mark.slow
def test_measures_against_disturbances_are_left_out_one_by_one(tmp_path: Path) -> None:
    rows = made("ablation", tmp_path, "--workers", "1")
    assert [(row["scenario"], row["disturbance"], row["left out"], row["trials"]) for row in rows] == [
        ("circle", "delay of 2 steps", "delay", "1"),
        ("circle", "delay of 2 steps", "all of them", "1"),
    ]
    assert {row["with"] for row in rows} == {"1, 0"}
    check_made_again("ablation", tmp_path, rows)


def test_gradient_ascent_through_the_dynamics_raises_the_reward(tmp_path: Path) -> None:
    rewards = [float(row["reward"]) for row in made("jax_functional", tmp_path)]
    assert rewards[-1] > rewards[0] + 0.05


@pytest.mark.slow
def test_a_network_learns_from_a_planner(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    rows = made("imitate_expert", tmp_path)
    assert [row["learned by"] for row in rows] == [
        *("cloning", "DAgger", "PPO from there", "PPO from there", "PPO from nothing", "PPO from nothing")
    ]
    success = [float(row["success"].removesuffix("%")) for row in rows]
    assert max(success[:2]) >= 40
    assert max(success[2:4]) >= 40
    assert success[2] > success[4], "it begins where the other took it"
    check_made_again("imitate_expert", tmp_path, rows)


@pytest.mark.slow
def test_ppo_in_one_jit_learns_to_arrive(tmp_path: Path) -> None:
    pytest.importorskip("optax")
    success = [float(row["success"].removesuffix("%")) for row in made("jax_ppo", tmp_path)]
    assert success[0] < 20
    assert success[-1] > 50


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("cleanrl_ppo", "torch"),
        ("torchrl_mappo", "torchrl"),
        ("benchmarl_mappo", "benchmarl.environments"),
        ("rllib_ppo", "ray.rllib"),
    ],
)
def test_recipes_learn_something(name: str, module: str, tmp_path: Path) -> None:
    pytest.importorskip(module, exc_type=ImportError)
    success = [float(row["success"].removesuffix("%")) for row in made(name, tmp_path)]
    assert success[0] < 10
    assert success[-1] > 20


def test_a_policy_gives_a_planner_its_warm_start(tmp_path: Path) -> None:
    rows = made("warm_start", tmp_path)
    assert [row["from"] for row in rows] == ["nothing", "ppo"] * 2
    assert {row["solved"] for row in rows} == {"2 of 2"}
    without, warm = (float(row["iterations, median"]) for row in rows[:2])
    assert warm <= without


@pytest.mark.slow
def test_d4orm_finds_several_kinds_of_solution_and_no_robot_weaves(tmp_path: Path) -> None:
    pytest.importorskip("casadi")
    out, rows = tmp_path / "out", made("multimodality", tmp_path)
    assert len({row["signs"] for row in rows}) == len(rows) == 8
    plans = {row["top to bottom"]: int(row["d4orm: plans"]) for row in rows}
    assert sum(plans.values()) == 8, "every seed solves so easy a problem"
    assert sum(number > 0 for number in plans.values()) >= 3
    assert plans["0 over 1 over O over 0"] == plans["1 over 0 over O over 1"] == 0
    assert all(5 < float(row["d4orm: travel time [s]"]) < 8 for row in rows if row["d4orm: plans"] != "0")
    assert (out / "multimodality.png").read_bytes().startswith(PNG)


@pytest.mark.slow
def test_planners_find_several_kinds_of_solution_for_a_team(tmp_path: Path) -> None:
    pytest.importorskip("casadi")
    out = tmp_path / "out"
    completed("multimodality", out, "--team", "8")
    rows = {row["planner"]: row for row in table(out / "multimodality_team.csv")}
    planners, alike = list(rows)[:3], list(rows)[3:]
    assert planners == ["d4orm", "d4orm, preset paper", "ipopt"]
    assert {label.rsplit(", ", 1)[0] for label in alike} in (set(), set(planners[1:])), "both, or none"
    assert rows["d4orm"]["solved"] == "4 of 4", "every seed solves so easy a problem"
    assert [rows[label]["denoising steps"] for label in planners] == ["100", "100", "0"]
    assert all(1 <= int(row["classes"]) <= int(row["solved"].split()[0]) for row in rows.values())
    assert (out / "multimodality_team.png").read_bytes().startswith(PNG)


@pytest.mark.slow
def test_big_team_example_ends_without_failures_and_draws_the_plan(tmp_path: Path) -> None:
    out, rows = tmp_path / "out", made("sixty_four_robots", tmp_path)
    assert [int(row["iteration"]) for row in rows] == list(range(1, len(rows) + 1))
    assert int(rows[0]["failed"]) > int(rows[-1]["failed"]) == 0
    plan = Plan.load(out / "sixty_four_robots.npz")
    assert plan.solved
    assert plan.problem.num_robots == 12
    assert (out / "sixty_four_robots.png").read_bytes().startswith(PNG)
    with Image.open(out / "sixty_four_robots.gif") as animation:
        assert animation.n_frames > 5


@pytest.mark.slow
def test_results_are_read_alike_from_all_three_files(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    out, rows = tmp_path / "out", made("read_results", tmp_path)
    assert [(row["policy"], row["scenario"], row["trials"]) for row in rows] == [
        (policy, scenario, "2")
        for policy in ("d4orm", "d4orm, few samples", "orca")
        for scenario in ("circle", "random")
    ]
    assert all(0 <= float(row["success"]) <= 1 and float(row["computing per s of motion"]) >= 0 for row in rows)
    assert (out / "read_results.png").read_bytes().startswith(PNG)
    before = (out / "read_results.csv").read_text()
    for kind in ("parquet", "csv", "sqlite"):
        result = run("read_results", out, "--results", str(out / "evaluation"), "--format", kind)
        assert result.returncode == 0, result.stderr
        assert (out / "read_results.csv").read_text() == before


@pytest.mark.slow
def test_lifelong_example_stays_below_its_bound(tmp_path: Path) -> None:
    (row,), out = made("lifelong", tmp_path), tmp_path / "out"
    assert row["simulated [s]"] == "6.0"
    goals, rate = int(row["goals reached"]), float(row["goals per robot-minute"])
    assert goals >= 2
    assert rate == pytest.approx(goals / (4 * 0.1), abs=0.01)
    assert rate < float(row["bound"])
    assert row["robots that touched"] == row["robot-steps in contact"] == "0"
    with Image.open(out / "lifelong.gif") as animation:
        assert animation.n_frames > 5
        assert animation.info["duration"] == 100


@pytest.mark.slow
def test_scaling_example_solves_every_team(tmp_path: Path) -> None:
    out, rows = tmp_path / "out", made("scaling", tmp_path)
    assert [(row["robots"], row["side [m]"], row["solved"]) for row in rows] == [
        ("4", "2.5", "1 of 1"),
        ("8", "3.5", "1 of 1"),
    ]
    assert all(float(row["seconds, median"]) == float(row["seconds, most"]) for row in rows)
    assert (out / "scaling.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize(
    ("position", "velocity", "seconds"),
    [
        (0.0, 0.0, 1 + (4 - 0.5)),  # half a metre to reach 1 m/s
        (0.0, 1.0, 4.0),
        (0.0, -1.0, 2 + 4.0),  # two seconds to stop and come back at top speed
        (3.92, 0.0, np.sqrt(2 * 0.08)),
        (4.05, 0.0, 0.0),
    ],
    ids=["from rest", "at top speed", "backwards", "near", "there already"],
)
def test_lifelong_bound_is_the_time_of_a_straight_drive(position: float, velocity: float, seconds: float) -> None:
    """A single robot on a line, limits of 1 m/s and 1 m/s^2, and the goal's disc begins at 4 m."""
    problem = make_problem("circle", num_robots=1)
    goal = np.array([[4 + problem.goal_radius, 0]], np.float32)
    states = np.array([[position, 0, velocity, 0]], np.float32)
    joint = JointState(states, goal, np.zeros((1, 2), np.float32), np.zeros(1, bool), 0)
    assert lifelong.least_times(problem, joint) == pytest.approx([seconds], abs=1e-5)


@pytest.mark.parametrize("last_speed", [np.inf, 0.1])
@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive"])
def test_a_straight_drive_is_as_soon_as_the_least(model: str, last_speed: float) -> None:
    problem = make_problem("circle", num_robots=1, model=model, goal_speed=last_speed)
    braking = range(48, 57) if last_speed < 1 else ()  # from 1 m/s to 0.1 m/s
    controls = np.zeros((problem.horizon, 1, 2), np.float32)
    ahead = (problem.goal[0] - problem.start[0, :2]) / 5 if model == "holonomic2d" else np.array([0, 1])
    for step in range(problem.horizon):
        controls[step, 0] = -ahead if step in braking else ahead
    arrived = rollout(problem, controls).arrived[:, 0]
    assert arrived.argmax() * problem.dt == pytest.approx(solve_rates.least_travel_time(problem))


def test_lifelong_drives_are_summed_up_over_their_seeds() -> None:
    drive = {"scenario": "random", "robots": 2, "seconds": 60.0, "touched": 1, "contacts": 3, "replanned": 4}
    first = {**drive, "goals": 20, "least_time": 3.0, "loop_seconds": [0.01, 0.03]}
    second = {**drive, "goals": 24, "least_time": 3.75, "loop_seconds": [0.02]}
    row = lifelong.summary([first, second])
    assert (row["seeds"], row["simulated [s]"], row["goals reached"]) == (2, "120.0", 44)
    assert (row["goals per robot-minute"], row["bound"]) == ("11.00", "18.00")
    # Shares of 1/2 and 3/4: their mean, and 12.706 (Student's t of one degree of freedom) standard errors of 1/8.
    assert (row["share of the bound"], row["interval"]) == ("62.5%", "-96.3% to 221.3%")
    assert (row["robots that touched"], row["robot-steps in contact"], row["guidance planned anew"]) == (2, 6, 8)
    assert (row["loop, median [ms]"], row["loop, slowest [ms]"]) == ("20", "30")
    assert lifelong.summary([first])["interval"] == "-"


@pytest.fixture
def multimodality() -> ModuleType:
    pytest.importorskip("casadi")
    return importlib.import_module("examples.studies.multimodality")


@pytest.mark.parametrize(
    ("path", "turns"),
    [
        ([(1, 0), (0, 1), (-1, 0)], 0.5),
        ([(1, 0), (0, -1), (-1, 0)], -0.5),
        ([(-2, 0), (-2, 3), (2, 3), (2, 0)], -0.5),
        ([(1, 0), (0, 1), (-1, 0), (0, -1), (1, 0), (0, 1)], 1.25),
        ([(1, 0), (1, 1), (1, 0), (1, -1)], -0.125),
        ([(-1, 0.1), (-1, -0.1), (-1, 0.1)], 0.0),
        ([(3, 4)], 0.0),
    ],
    ids=[
        "over it",
        "under it",
        "over it, rightward",
        "more than once round",
        "there and back",
        "across the cut",
        "still",
    ],
)
def test_winding_is_the_angle_swept_about_the_origin(
    multimodality: ModuleType, path: list[tuple[float, float]], turns: float
) -> None:
    assert multimodality.winding(np.array(path)) == pytest.approx(2 * np.pi * turns, abs=1e-12)


@pytest.mark.parametrize(
    ("signs", "order"), [(signs, order) for order, signs in {
        "1 over O over 0": (-1, -1, -1),
        "0 over O over 1": (1, 1, 1),
        "O over 1 over 0": (-1, 1, -1),
        "O over 0 over 1": (-1, 1, 1),
        "1 over 0 over O": (1, -1, -1),
        "0 over 1 over O": (1, -1, 1),
    }.items()]
)  # fmt: skip
def test_signature_tells_the_order_from_top_to_bottom(
    multimodality: ModuleType, signs: tuple[int, int, int], order: str
) -> None:
    """Robots that pass each other and the obstacle at heights in that order, robot 0 leftward."""
    height = {name: float(y) for name, y in zip(order.split(" over "), (1, 0, -1))}
    x = np.linspace(3, -3, 31)
    bump = np.maximum(1 - np.abs(x) / 3, 0)
    paths = [np.column_stack([side * x, bump * (height[name] - height["O"])]) for side, name in ((1, "0"), (-1, "1"))]
    assert multimodality.signature(np.stack(paths, axis=1)) == signs
    assert multimodality.CLASSES[signs][0] == order


def test_robots_that_weave_have_one_of_the_two_other_signatures(multimodality: ModuleType) -> None:
    """Robot 1 goes over the obstacle and under robot 0, which waits there and then goes under the obstacle."""
    second = np.array([(-3, 0), (-1, 1), (1, 1), (2, -1), (3, 0), (3, 0), (3, 0), (3, 0)], float)
    first = np.array([(3, 0), (2.5, 0), (2, 0), (2, 0), (2, 0), (1, -1), (-1, -1), (-3, 0)], float)
    assert multimodality.signature(np.stack([first, second], axis=1)) == (-1, -1, 1)
    assert multimodality.CLASSES[-1, -1, 1][0] == "0 over 1 over O over 0"


def test_classes_among_drawn_plans_are_those_of_all_draws(multimodality: ModuleType) -> None:
    classes = ["a", "a", "a", "b", "c"]
    draws = [len(set(drawn)) for drawn in combinations(classes, 3)]
    assert multimodality.rarefied(classes, 3) == pytest.approx(np.mean(draws))
    assert multimodality.rarefied(classes, 5) == 3


def test_principal_components_are_distances_of_plans(multimodality: ModuleType) -> None:
    """Two plans whose robots are 3 m apart at every step: 1.5 m on either side of their mean, on one line."""
    points, shares = multimodality.principal_components([np.full((11, 2, 2), [y, 0]) for y in (0.0, 3.0)])
    assert sorted(points[:, 0]) == pytest.approx([-1.5, 1.5])
    assert points[:, 1] == pytest.approx([0, 0])
    assert shares == pytest.approx([1, 0])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "module"), [("supersuit_ppo", "supersuit"), ("sb3_joint_ppo", "stable_baselines3")])
def test_stable_baselines3_trains_a_policy_that_acts(name: str, module: str, tmp_path: Path) -> None:
    pytest.importorskip(module)
    out = tmp_path / "out"
    result = run(name, out)
    assert result.returncode == 0, result.stderr
    assert re.search(r"solves \d of 5 unseen instances, after \d+\.\d minutes", result.stdout)
    assert (out / f"{name}.zip").is_file()


@pytest.mark.slow
def test_a_trained_policy_is_compared_with_planners_under_noise(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    out = tmp_path / "out"
    result = run("train_and_compare", out)
    assert result.returncode == 0, result.stderr
    rows = table(out / "train_and_compare.csv")
    assert [(row["policy"], row["control_noise_std"]) for row in rows] == [
        (policy, noise) for policy in ("ppo", "d4orm-c2f", "orca") for noise in ("0.0", "0.5")
    ]
    assert {row["success"] for row in rows if row["policy"] == "d4orm-c2f" and row["control_noise_std"] == "0.0"} == {
        "2 of 2"
    }
    assert (out / "comparison" / "robustness.png").read_bytes().startswith(PNG)


@pytest.mark.slow
def test_learners_are_trained_with_several_seeds_and_their_curves_read_again(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    out = tmp_path / "out"
    rows = made("training_seeds", tmp_path, "--seeds", "2")
    assert [row["learner"].split(",")[0] for row in rows] == ["PPO", "PPO", "PPO", "SAC", "SAC"]
    assert {row["seeds"] for row in rows} == {"2"}
    assert (out / "training_seeds.png").read_bytes().startswith(PNG)
    check_made_again("training_seeds", tmp_path, rows)


@pytest.mark.slow
def test_policies_are_rolled_out_among_walls(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    out = tmp_path / "out"
    completed("policy_rates", out)
    rows = table(out / "policy_rates_walls.csv")
    assert {row["policy"] for row in rows} == {"`ppo-walls`"}
    assert len(rows) == 7
    assert sum(row["succeeded"] == "1 of 1" for row in rows) >= 3
    assert not (out / "policy_rates.csv").exists(), "nothing was measured on open ground"
    check_made_again("policy_rates", tmp_path, rows, of="policy_rates_walls")


def test_margins_of_crazyflies_are_what_flights_lost_and_half_as_much_again() -> None:
    """As the checklist has it: the robot's in calm air, what the page advises for them in gusts."""
    parquet = pytest.importorskip("pyarrow.parquet")
    advised = max(zero_shot.MARGINS.values())
    rows = parquet.read_table(EXAMPLES / "studies" / "data" / "zero_shot.parquet").to_pylist()
    assert {row["condition"] for row in rows} == set(zero_shot.CONDITIONS)
    for row in rows:
        assert row["contacts"] == row["fallen"] == 0
        margin = zero_shot.MARGINS.get(row["condition"], ROBOTS[zero_shot.ROBOT].margin)
        gusts = zero_shot.CONDITIONS[row["condition"]] == zero_shot.DISTURBED
        assert 1.5 * (margin - row["gap"]) <= (advised if gusts else ROBOTS[zero_shot.ROBOT].margin)
    assert all(row["arrived"] == row["robots"] for row in rows if row["condition"].startswith("nominal"))


def test_count_of_seeds_below_one_is_refused(tmp_path: Path) -> None:
    result = run("one_dimension", tmp_path / "out", "--seeds", "0")
    assert result.returncode == 2
    assert "0 is too few; give at least 1" in result.stderr


def test_a_file_of_trials_that_is_not_there_is_refused(tmp_path: Path) -> None:
    result = run("ablation", tmp_path / "out", "--trials", "nowhere.parquet")
    assert result.returncode == 2
    assert "nowhere.parquet is no file; give a Parquet file of trials" in result.stderr
    assert not (tmp_path / "out").exists()
