"""What every planner must do, whatever its method; and each sampling method against its equations."""

from __future__ import annotations

import csv
import itertools
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engine_support import engine_noise
from planner_support import Recorder, algorithm_1, cheap_planner, hop_problem, softmax, walled_in_problem

from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import trajectory_metrics
from d4orm_env.scenarios import make_problem
from d4orm_env.verify import verify
from d4orm_planners import IterationRecord, Plan, list_planners, make_planner
from d4orm_planners.base.planner_registry import PLANNERS, describe_policy
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.cpu_sampling import CpuSamplingEngine
from d4orm_planners.engine.sampling_types import SamplingTask, get_sampling_engine
from d4orm_planners.sampling.loop import SamplingPlanner, standard_normal
from d4orm_planners.sampling.settings import TUNED, alpha_bar, annealed
from d4orm_planners.tracking.steering import straight_drives

ALL = pytest.mark.parametrize("name", list_planners())
WITH_PRESETS = pytest.mark.parametrize("name", [name for name in list_planners() if PLANNERS[name].presets])
SAMPLING = tuple(name for name in list_planners() if issubclass(PLANNERS[name], SamplingPlanner))


def assert_same_plan(a: Plan, b: Plan) -> None:
    np.testing.assert_array_equal(a.controls, b.controls)
    for field in fields(a.trajectory):
        np.testing.assert_array_equal(getattr(a.trajectory, field.name), getattr(b.trajectory, field.name))
    for name in ("status", "solved", "iterations", "denoising_steps"):
        assert getattr(a, name) == getattr(b, name)
    # Who waits how long for whom is a matter of time, not of the seed.
    assert {**a.metrics, "waiting_share": 0} == {**b.metrics, "waiting_share": 0}
    assert [record.reward for record in a.history] == [record.reward for record in b.history]


@cache
def circle_plan(name: str, seed: int) -> Plan:
    """A cheap plan of four robots, which several tests look at."""
    return cheap_planner(name).solve(make_problem("circle", num_robots=4), seed=seed)


# The plan.


@ALL
def test_solve_returns_a_plan(name: str) -> None:
    problem = make_problem("heterogeneous", num_robots=4)
    plan = cheap_planner(name).solve(problem, seed=3)
    steps, robots = problem.horizon, problem.num_robots
    assert plan.planner == name
    assert plan.problem == problem
    assert plan.seed == 3
    assert plan.controls.shape == (steps, robots, problem.control_size)
    assert plan.controls.dtype == np.float32
    assert plan.trajectory.states.shape == (steps + 1, robots, problem.state_size)
    assert plan.trajectory.positions.shape == (steps + 1, robots, 2)
    assert plan.trajectory.rewards.shape == (steps, robots)
    assert plan.trajectory.arrived.shape == plan.trajectory.collided.shape == (steps + 1, robots)
    assert plan.trajectory.arrived.dtype == bool
    assert type(plan.solved) is bool
    assert plan.status in ("solved", "iteration_limit")
    assert (plan.status == "solved") == plan.solved
    assert 1 <= plan.iterations == len(plan.history) <= 2
    assert (plan.denoising_steps > 0) == (name not in ("ipopt", "mapf", "amswarm"))
    assert plan.wall_time > 0
    assert trajectory_metrics(problem, plan.trajectory).items() <= plan.metrics.items()
    assert plan.metrics["denoising_steps"] == plan.denoising_steps
    denoises = name not in ("ipopt", "mapf", "amswarm", "hybrid")  # hybrid may, or may not
    assert (0 < plan.metrics["denoising_share"] <= 1) == (plan.denoising_steps > 0)
    assert plan.metrics["denoising_share"] == 1 or not denoises
    assert plan.denoising_time is not None
    assert (plan.denoising_time > 0) == (plan.denoising_steps > 0)
    assert plan.denoising_time < plan.wall_time


@ALL
def test_the_history_tells_of_every_iteration(name: str) -> None:
    problem = make_problem("circle", num_robots=4)
    plan = cheap_planner(name).solve(problem, seed=0, max_iterations=3)
    assert [record.iteration for record in plan.history] == list(range(1, plan.iterations + 1))
    assert plan.history[-1].denoising_steps == plan.denoising_steps
    if name in SAMPLING:
        assert [record.denoising_steps for record in plan.history] == [5 * (i + 1) for i in range(plan.iterations)]
    best = [record.best_reward for record in plan.history]
    assert best[-1] == pytest.approx(plan.metrics["reward"])
    times = [record.wall_time for record in plan.history]
    assert times == sorted(times)
    assert times[-1] <= plan.wall_time
    for record in plan.history:
        assert 0 <= max(record.num_margin_violated, record.num_not_arrived) <= record.num_failed <= 4
        assert record.solved <= (record.num_failed == 0)


@ALL
def test_the_controls_lead_to_the_trajectory(name: str) -> None:
    plan = circle_plan(name, 0)
    again = get_sampling_engine("cpu").rollout(plan.problem, plan.controls)
    np.testing.assert_allclose(again.states, plan.trajectory.states, atol=1e-5)
    np.testing.assert_array_equal(plan.controls, plan.trajectory.controls)


@ALL
@pytest.mark.parametrize("model", ["holonomic2d", "holonomic3d", "velocity2d", "differential_drive"])
def test_controls_keep_the_limits(name: str, model: str) -> None:
    problem = make_problem("circle", num_robots=3, model=model, max_speed=0.8, max_acceleration=0.5)
    controls = cheap_planner(name).solve(problem, seed=0, max_iterations=1).controls
    if model == "differential_drive":
        assert (np.abs(controls) <= problem.team.control_limits).all()
    else:
        limit = problem.team.control_limits[0, 0]
        assert (np.linalg.norm(controls, axis=-1) <= limit * (1 + 1e-6)).all()
    assert np.abs(controls).max() > 0.3


@ALL
def test_controls_are_zero_after_docking(name: str) -> None:
    plan = cheap_planner(name).solve(hop_problem(), seed=0, max_iterations=6)
    arrived = plan.trajectory.arrived[:-1]
    assert arrived.any()
    assert (plan.controls[arrived] == 0).all()
    assert (plan.controls[~arrived] != 0).any(axis=-1).mean() > 0.9


# Determinism.


@ALL
def test_the_same_seed_gives_the_same_plan(name: str) -> None:
    first, planner = circle_plan(name, 0), cheap_planner(name)
    for _ in range(2):
        assert_same_plan(first, planner.solve(first.problem, seed=0))


@ALL
def test_threads_do_not_change_the_plan(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = make_problem("four_obstacles", num_robots=5)
    # Not a multiple of any tile, and more tiles than threads.
    settings = {"num_samples": 333} if name in SAMPLING else {}
    plans = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("D4ORM_NUM_THREADS", threads)
        plans.append(cheap_planner(name, **settings).solve(problem, seed=5))
    assert_same_plan(plans[0], plans[1])
    assert_same_plan(plans[0], plans[2])


@ALL
def test_another_seed_gives_another_plan(name: str) -> None:
    # Path finding knows some dozen plans for four robots, so that two seeds may well lead to the same one.
    seeds = (0, 1, 2) if name == "mapf" else (0, 1, 2**40)
    plans = [circle_plan(name, seed).controls for seed in seeds]
    assert not np.allclose(plans[0], plans[1], atol=1e-3)
    assert not np.allclose(plans[0], plans[2], atol=1e-3)


@ALL
def test_every_iteration_draws_its_own_numbers(name: str) -> None:
    search = SolveRun(cheap_planner(name), hop_problem(), 0, None)
    seeds = {search.iteration_seed(stream) for stream in Stream}
    search.advance()
    search.close()
    seeds |= {search.iteration_seed(stream) for stream in Stream}
    assert len(seeds) == 2 * len(Stream)


# Budget, callback, interruption.


@ALL
def test_the_iteration_limit_ends_an_unsolvable_problem(name: str) -> None:
    """The configured one, unless the call says otherwise; and the callback sees every iteration once."""
    planner, recorder = cheap_planner(name, max_iterations=1), Recorder()
    assert planner.solve(walled_in_problem()).iterations == 1
    plan = planner.solve(walled_in_problem(), max_iterations=3, callback=recorder)
    assert plan.status == "iteration_limit"
    assert not plan.solved
    assert plan.iterations == len(plan.history) == 3
    assert plan.metrics["success"] == 0
    assert all(isinstance(record, IterationRecord) for record in recorder.records)
    assert tuple(recorder.records) == plan.history


@ALL
def test_the_time_limit_ends_an_unsolvable_problem(name: str) -> None:
    plan = cheap_planner(name).solve(walled_in_problem(), time_limit=0.05, max_iterations=10**9)
    assert plan.status == "time_limit"
    assert not plan.solved
    assert plan.iterations == len(plan.history)


@ALL
def test_the_callback_can_stop_the_search(name: str) -> None:
    recorder = Recorder(stop_after=2)
    plan = cheap_planner(name).solve(walled_in_problem(), max_iterations=9, callback=recorder)
    assert plan.status == "stopped"
    assert plan.iterations == len(recorder.records) == 2


@ALL
def test_an_interrupted_search_returns_its_best_plan(name: str) -> None:
    problem = make_problem("circle", num_robots=3)
    recorder = Recorder(stop_after=2, error=KeyboardInterrupt())
    plan = cheap_planner(name, improve=True).solve(problem, max_iterations=9, callback=recorder)
    assert plan.status == "interrupted"
    assert plan.iterations == len(recorder.records) == 2
    assert plan.metrics["reward"] == pytest.approx(recorder.records[-1].best_reward)
    assert plan.solved == recorder.records[-1].best_solved
    # What was found is what a search that ended by itself would have found.
    same = cheap_planner(name, improve=True).solve(problem, max_iterations=2)
    np.testing.assert_array_equal(plan.controls, same.controls)


@ALL
def test_an_interrupt_within_an_iteration_returns_the_best_plan_too(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    planner = cheap_planner(name)
    iterate = planner.iterate

    def interrupted(search: SolveRun, state: Any) -> Any:
        if search.iteration == 1:
            raise KeyboardInterrupt
        return iterate(search, state)

    monkeypatch.setattr(planner, "iterate", interrupted)
    plan = planner.solve(walled_in_problem(), max_iterations=5)
    assert plan.status == "interrupted"
    assert plan.iterations == len(plan.history) == 1
    same = cheap_planner(name).solve(walled_in_problem(), max_iterations=1)
    np.testing.assert_array_equal(plan.controls, same.controls)


def test_an_error_in_the_callback_is_the_callers() -> None:
    recorder = Recorder(stop_after=1, error=RuntimeError("mine"))
    with pytest.raises(RuntimeError, match="mine"):
        cheap_planner("d4orm").solve(walled_in_problem(), callback=recorder)


# Where the search starts.


def straight_ahead(problem: Problem, acceleration: float = 1.0) -> np.ndarray:
    controls = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    controls[..., 0] = acceleration
    return controls


@ALL
def test_a_solution_given_is_returned_at_once(name: str) -> None:
    problem = hop_problem()
    given = straight_ahead(problem)
    recorder = Recorder()
    plan = cheap_planner(name).solve(problem, initial_controls=given, callback=recorder)
    assert plan.status == "solved"
    assert plan.solved
    assert plan.iterations == plan.denoising_steps == len(plan.history) == len(recorder.records) == 0
    arrived = plan.trajectory.arrived[:-1]
    np.testing.assert_array_equal(plan.controls, np.where(arrived[..., None], 0, given))


@ALL
def test_the_best_of_start_and_search_is_returned(name: str) -> None:
    # Nobody can do better than arrive; the walled-in robot cannot, so what it is given must win or be beaten fairly.
    problem = walled_in_problem()
    given = np.zeros((problem.horizon, 1, 2), np.float32)
    given[:14, 0, 0] = 1
    given[14:28, 0, 0] = -1
    start = get_sampling_engine("cpu").rollout(problem, given)
    plan = cheap_planner(name).solve(problem, initial_controls=given, max_iterations=2)
    assert plan.metrics["reward"] >= start.rewards.mean() - 1e-6


@pytest.mark.parametrize("name", SAMPLING)
def test_samples_that_were_left_out_are_in_the_history(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    denoise = CpuSamplingEngine.denoise
    monkeypatch.setattr(CpuSamplingEngine, "denoise", lambda *a, **k: denoise(*a, **k)._replace(excluded=3))
    plan = cheap_planner(name).solve(walled_in_problem(), max_iterations=2)
    # D4orm has two stages, and what D4orm-D does second is a repair, which has one.
    expected = {"d4orm": [6, 6], "d4orm-d": [6, 3]}.get(name, [3, 3])
    assert [record.excluded for record in plan.history] == expected


@pytest.mark.parametrize("name", ["d4orm", "mppi", "cem"])
def test_the_search_starts_from_the_controls_given(name: str) -> None:
    problem = walled_in_problem()
    given = straight_ahead(problem, 0.1)
    search = SolveRun(cheap_planner(name), problem, 0, given)
    base, mean = search.planner.initial(search)
    np.testing.assert_array_equal(base, given)
    assert not mean.any()


@pytest.mark.parametrize(
    ("controls", "message"),
    [
        (np.zeros((30, 3, 3)), r"shape \(30, 3, 3\).*\(30, 3, 2\)"),
        (np.zeros((29, 3, 2)), r"shape \(29, 3, 2\)"),
        (np.zeros((30, 2, 2)), r"shape \(30, 2, 2\)"),
        (np.full((30, 3, 2), np.nan), r"\[0, 0, 0\] is not finite"),
        (np.full((30, 3, 2), np.inf), "not finite"),
        ([["a"]], "initial_controls"),
    ],
)
def test_unusable_initial_controls_are_refused(controls: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        cheap_planner("d4orm").solve(hop_problem(), initial_controls=controls)
    assert "initial_controls" in str(caught.value)


# Improving.


@ALL
def test_improving_goes_on_to_the_budget_and_never_gets_worse(name: str) -> None:
    problem = hop_problem(2)
    first = straight_ahead(problem, 0.4)
    start = get_sampling_engine("cpu").rollout(problem, first)
    recorder = Recorder()
    plan = cheap_planner(name, improve=True).solve(problem, initial_controls=first, max_iterations=4, callback=recorder)
    assert plan.status == "iteration_limit"
    assert plan.iterations == 4
    assert plan.solved
    assert all(record.best_solved for record in recorder.records)
    best = [float(start.rewards.mean()), *(record.best_reward for record in recorder.records)]
    assert best == sorted(best)
    assert plan.metrics["reward"] == pytest.approx(best[-1])


def test_improving_improves() -> None:
    problem = hop_problem(2)
    start = get_sampling_engine("cpu").rollout(problem, straight_ahead(problem, 0.4))
    planner = make_planner("d4orm", engine="cpu", num_samples=128, num_steps=20, improve=True)
    plan = planner.solve(problem, initial_controls=straight_ahead(problem, 0.4), max_iterations=5)
    assert plan.solved
    assert plan.metrics["reward"] > start.rewards.mean() + 0.05
    assert plan.metrics["travel_time"] < trajectory_metrics(problem, start)["travel_time"]


def test_the_first_solution_ends_the_search_unless_asked_to_improve() -> None:
    problem = hop_problem()
    plan = make_planner("d4orm", engine="cpu", num_samples=128, num_steps=20).solve(problem)
    assert plan.status == "solved"
    assert plan.history[-1].solved
    assert not any(record.solved for record in plan.history[:-1])
    assert verify(problem, plan.controls).ok


def test_keeping_contact_free_but_not_the_margin_is_no_solution() -> None:
    # Side by side at 0.33 m, that is 0.03 m apart where the margin is 0.05 m.
    problem = hop_problem(2)
    start = problem.start.copy()
    start[1, 1] = 0.33
    close = problem.replace(start=start, goal=start[:, :2] + [0.5, 0])
    given = straight_ahead(close)
    assert verify(close, given).ok
    found = SolveRun(cheap_planner("d4orm"), close, 0, given).best
    assert not found.solved
    assert found.trajectory.margin_violated.any()
    assert not found.trajectory.collided.any()


# Settings.


@ALL
@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("num_samples", 1, "num_samples is 1.*at least 2"),
        ("num_samples", 64.0, "num_samples must be a whole number"),
        ("num_samples", True, "num_samples must be a whole number"),
        ("num_steps", 0, "num_steps is 0.*at least 1"),
        ("num_steps", "many", "num_steps must be a whole number"),
        ("temperature", 0, "temperature is 0.*positive"),
        ("temperature", -0.1, "temperature is -0.1.*positive"),
        ("temperature", float("nan"), "temperature is nan"),
        ("temperature", None, "temperature must be a number"),
        ("weight_cutoff", 1.0, "weight_cutoff is 1.*below 1"),
        ("weight_cutoff", -1e-3, "weight_cutoff is -0.001"),
        ("beta_start", 0.0, "beta_start is 0"),
        ("beta_start", -1e-4, "beta_start is -0.0001"),
        ("beta_start", 0.5, "beta_start 0.5 is above beta_end 0.02"),
        ("beta_end", 1.0, "beta_end is 1.*between 0 and 1"),
        ("beta_end", float("inf"), "beta_end is inf"),
        ("beta_end", float("nan"), "beta_end is nan"),
        ("credit", "everyone", "credit 'everyone' is unknown.*team, robot"),
        ("engine", "gpu", "engine 'gpu' is unknown.*auto, cpu, jax"),
        ("max_iterations", 0, "max_iterations is 0.*at least 1"),
        ("improve", "yes", "improve must be True or False"),
        ("sigma", 0, "sigma is 0"),
        ("sigma", float("nan"), "sigma is nan"),
        ("sigma_floor", -1, "sigma_floor is -1"),
        ("importance", -0.1, "importance is -0.1"),
        ("importance", 1.5, "importance is 1.5.*at most 1"),
        ("elite_fraction", 0, "elite_fraction is 0"),
        ("elite_fraction", 1.5, "elite_fraction is 1.5.*at most 1"),
        ("adapt_variance", 1, "adapt_variance must be True or False"),
        ("random_start", "no", "random_start must be True or False"),
        ("clip_between_iterations", 1, "clip_between_iterations must be True or False, not 1"),
        ("num_sample", 64, "'num_sample' is no setting of planner '.*num_samples"),
    ],
)
def test_a_bad_setting_is_refused_by_name(name: str, setting: str, value: Any, message: str) -> None:
    if setting not in PLANNERS[name].config_class.setting_names():
        message = f"'{setting}' is no setting of planner '{name}'; it takes engine, max_iterations"
    with pytest.raises(ValueError, match=message) as caught:
        make_planner(name, **{setting: value})
    assert "\n" not in str(caught.value)


@WITH_PRESETS
def test_an_unknown_preset_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"preset 'papers' of planner '{name}' is unknown.*paper"):
        make_planner(name, preset="papers")


@pytest.mark.parametrize("name", ["d4orm-c2f", "go-to-goal", "ppo"])
def test_a_policy_that_is_no_planner_is_pointed_to(name: str) -> None:
    with pytest.raises(ValueError, match=rf"'{name}' is no planner but a policy.*use make_policy\('{name}'\)"):
        make_planner(name)


@pytest.mark.parametrize("name", ["d4rom", "", "D4ORM", None, 4])
def test_an_unknown_planner_is_refused(name: Any) -> None:
    with pytest.raises(ValueError, match="is unknown; choose one of d4orm, d4orm-d, hybrid, d-d4orm, mppi"):
        make_planner(name)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed is -1"),
        ({"seed": 0.5}, "seed must be a whole number"),
        ({"time_limit": 0}, "time_limit is 0"),
        ({"time_limit": 1e17}, "time_limit is 1e.17; it must be at most 1e.06"),
        ({"time_limit": float("nan")}, "time_limit is nan"),
        ({"max_iterations": 0}, "max_iterations is 0"),
        ({"max_iterations": 2.5}, "max_iterations must be a whole number"),
    ],
)
def test_a_bad_argument_of_solve_is_refused_by_name(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cheap_planner("d4orm").solve(hop_problem(), **arguments)


def test_the_methods_of_the_paper_are_there() -> None:
    assert {"d4orm", "mppi", "cem", "mbd", "i-mbd", "ipopt"} <= set(list_planners())
    assert all(describe_policy(name) for name in list_planners())


@pytest.mark.parametrize("name", SAMPLING)
def test_the_paper_preset_has_the_papers_parameters(name: str) -> None:
    parameters = {
        "num_samples": 1024,
        "num_steps": 10_000 if name == "mbd" else 100,
        "temperature": 0.3,
        "beta_start": 1e-4,
        "beta_end": 2e-2,
        "credit": "team",
        "weight_cutoff": 0,
        "clip_between_iterations": name == "d4orm-d",
        "short_paths": False,
        "final_approach": False,
    }
    exclude = {
        "mppi": {"beta_start", "beta_end"},
        "cem": {"temperature", "weight_cutoff", "beta_start", "beta_end"},
        "mbd": {"clip_between_iterations"},
    }
    config = make_planner(name, preset="paper").config.keywords()
    assert parameters.keys() - config.keys() == exclude.get(name, set())
    assert {name: config[name] for name in parameters if name in config}.items() <= parameters.items()


@ALL
def test_a_preset_says_nothing_of_what_no_planner_has(name: str) -> None:
    known = {setting for kind in PLANNERS.values() for setting in kind.config_class.setting_names()}
    known |= set(PLANNERS["d-d4orm"].config_class.setting_names({"planner": "d4orm-d"}))
    assert all(preset.keys() <= known for preset in PLANNERS[name].presets.values())


def test_the_tuned_presets_are_the_best_of_the_tuning() -> None:
    with (Path(__file__).parents[2] / "docs" / "tables" / "tuning.csv").open(newline="") as file:
        best = {row["method"]: row["settings"] for row in reversed(list(csv.DictReader(file)))}
    assert best.keys() == TUNED.keys()
    for name, found in best.items():
        config = make_planner(name, preset="tuned").config.keywords()
        settings = dict(part.split("=") for part in found.split(", "))
        assert {setting: str(config[setting]) for setting in settings} == settings
        assert (config["num_samples"], config["credit"]) == (1024, "team")


def test_the_paper_presets_are_among_the_settings_of_the_tuning() -> None:
    with (Path(__file__).parents[2] / "docs" / "tables" / "tuning.csv").open(newline="") as file:
        tried = [(row["method"], row["settings"]) for row in csv.DictReader(file)]
    for name in TUNED:
        config = make_planner(name, preset="paper").config.keywords()
        own = [dict(part.split("=") for part in found.split(", ")) for method, found in tried if method == name]
        assert len(own) == 27
        assert {setting: str(config[setting]) for setting in own[0]} in own


def test_the_paper_presets_of_the_methods_own_parameters() -> None:
    assert make_planner("d4orm", preset="paper").config.random_start is False
    assert make_planner("d4orm", preset="paper").config.late_samples == 1
    assert make_planner("mppi", preset="paper").config.sigma == 1
    cem = make_planner("cem", preset="paper").config
    assert (cem.elite_fraction, cem.sigma, cem.adapt_variance) == (0.05, 1, False)
    mbd = make_planner("mbd", preset="paper").config
    assert mbd.num_steps == mbd.check_every * mbd.max_iterations == 10_000


def test_the_authors_presets_are_what_they_published() -> None:
    d4orm = make_planner("d4orm", preset="authors").config
    assert (d4orm.penalty_per_pair, d4orm.penalty, d4orm.random_start, d4orm.late_samples) == (True, 1, False, 1)
    cem = make_planner("cem", preset="authors").config
    assert (cem.penalty_per_pair, cem.adapt_variance, cem.carry_variance, cem.sigma_floor) == (True, True, True, 0.1)


@WITH_PRESETS
def test_every_preset_makes_a_planner(name: str) -> None:
    for preset in PLANNERS[name].presets:
        assert make_planner(name, preset=preset).name == name


@WITH_PRESETS
def test_settings_override_the_preset(name: str) -> None:
    config = make_planner(name, preset="paper", engine="cpu", max_iterations=7).config
    assert (config.engine, config.max_iterations) == ("cpu", 7)


# The equations. Every sampling method against a direct transcription of its formulas in float64, fed with the same
# noise.

SAMPLES, STEPS, TEMPERATURE, BETAS = 96, 4, 0.3, (1e-4, 2e-2)


def tiny_problem(num_robots: int) -> Problem:
    """Three steps; no robot comes near its goal or another one, so that no reward jumps."""
    return hop_problem(num_robots, horizon=3)


def method(name: str, **config: Any) -> Any:
    shared = {
        "engine": "cpu", "num_samples": SAMPLES, "num_steps": STEPS, "temperature": TEMPERATURE, "weight_cutoff": 0.0,
        "beta_start": BETAS[0], "beta_end": BETAS[1], "short_paths": False, "final_approach": False,
    }  # fmt: skip
    known = PLANNERS[name].config_class.setting_names()
    return make_planner(name, **{key: value for key, value in shared.items() if key in known}, **config)


def start_of(name: str, problem: Problem, **config: Any) -> SolveRun:
    given = np.random.default_rng(7).normal(0, 0.5, (problem.horizon, problem.num_robots, problem.control_size))
    return SolveRun(method(name, **config), problem, 11, given)


def rewards_of(search: SolveRun, base: np.ndarray) -> Any:
    """Rewards of samples by rolling each of them out alone: the team's for team credit, else every robot's."""
    engine, problem = get_sampling_engine("cpu"), search.problem

    def reward(samples: np.ndarray) -> np.ndarray:
        rollouts = (engine.rollout(problem, (base + sample).astype(np.float32)) for sample in samples)
        per_robot = np.array([rollout.rewards.mean(axis=0, dtype=np.float64) for rollout in rollouts])
        return per_robot.mean(axis=1) if search.planner.config.credit == "team" else per_robot

    return reward


def draws_of(search: SolveRun) -> Any:
    seed = search.iteration_seed()
    return lambda step: engine_noise(search.problem, seed, step, SAMPLES).astype(np.float64)


def assert_controls(search: SolveRun, expected: np.ndarray) -> None:
    _, got = search.planner.iterate(search, None)
    assert got.denoising_steps == STEPS
    # Chance hides nothing here: the planned change is a thousand times larger than what is tolerated.
    assert np.abs(expected - search.current.controls).max() > 0.05
    np.testing.assert_allclose(got.controls, expected, atol=5e-5)


CREDIT = pytest.mark.parametrize(("num_robots", "credit"), [(1, "team"), (2, "team"), (2, "robot")])


@CREDIT
def test_d4orm_is_algorithm_1_on_a_deformation(num_robots: int, credit: str) -> None:
    search = start_of("d4orm", tiny_problem(num_robots), credit=credit, late_samples=1.0, random_start=True)
    base = search.current.controls
    noise = standard_normal(search, search.problem.team, search.problem.horizon)
    assert noise.std() == pytest.approx(1, abs=0.7)
    deformation = algorithm_1(
        noise, list(alpha_bar(STEPS, *BETAS)), draws_of(search), rewards_of(search, base), TEMPERATURE
    )
    assert_controls(search, base + deformation)


@CREDIT
def test_d4orm_by_default_starts_its_deformation_at_zero(num_robots: int, credit: str) -> None:
    search = start_of("d4orm", tiny_problem(num_robots), credit=credit, late_samples=1.0)
    base = search.current.controls
    deformation = algorithm_1(
        np.zeros_like(base), list(alpha_bar(STEPS, *BETAS)), draws_of(search), rewards_of(search, base), TEMPERATURE
    )
    assert_controls(search, base + deformation)


@pytest.mark.parametrize(
    ("late", "parts"),
    [
        ({}, [(3, 40), (7, 20)]),
        ({"late_steps": 0.2, "late_samples": 0.25}, [(8, 40), (2, 10)]),
        ({"late_steps": 1.0}, [(10, 20)]),
        ({"late_steps": 0.0}, [(10, 40)]),
        ({"late_samples": 1.0}, [(10, 40)]),
        ({"late_samples": 0.001}, [(3, 40), (7, 2)]),
    ],
)
def test_late_steps_go_on_with_fewer_samples(late: Any, parts: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    make_planner("d4orm", num_samples=4, num_steps=2).solve(walled_in_problem(), max_iterations=1)  # compiles
    denoise, calls = CpuSamplingEngine.denoise, []

    def recorded(
        engine: Any, task: Any, rules: Any, mean: Any, scale: Any, num_samples: int, seed: int, *rest: Any
    ) -> Any:
        result = denoise(engine, task, rules, mean, scale, num_samples, seed, *rest)
        calls.append((mean, scale, num_samples, seed, result))
        return result

    monkeypatch.setattr(CpuSamplingEngine, "denoise", recorded)
    planner = make_planner("d4orm", num_samples=40, num_steps=10, final_approach=False, **late)
    search = SolveRun(planner, walled_in_problem(), 0, None)
    _, iteration = planner.iterate(search, None)
    assert [(len(scale), num_samples) for _, scale, num_samples, _, _ in calls] == parts
    np.testing.assert_array_equal(np.concatenate([call[1] for call in calls]), planner.noise_scale())
    assert len({call[3] for call in calls}) == len(calls)
    for before, after in itertools.pairwise(calls):
        np.testing.assert_array_equal(after[0], before[4].mean)
    assert iteration.denoising_steps == 10
    np.testing.assert_array_equal(iteration.controls, calls[-1][4].mean)


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("late_steps", 1.5, "late_steps is 1.5.*at most 1"), ("late_steps", -0.1, "late_steps"),
        ("late_samples", 0, "late_samples"), ("late_samples", 2, "late_samples is 2.*at most 1"),
        ("late_samples", "half", "late_samples"),
    ],
)  # fmt: skip
def test_shares_of_late_steps_are_checked(setting: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_planner("d4orm", **{setting: value})


@pytest.mark.parametrize("name", ["mbd", "i-mbd"])
def test_mbd_is_algorithm_1_on_the_controls_from_pure_noise(name: str) -> None:
    search = start_of(name, tiny_problem(1))
    noise = standard_normal(search, search.problem.team, search.problem.horizon)
    expected = algorithm_1(
        noise, list(alpha_bar(STEPS, *BETAS)), draws_of(search), rewards_of(search, np.float32(0)), TEMPERATURE
    )
    assert_controls(search, expected)


def test_i_mbd_goes_on_from_its_last_result_as_if_it_were_noise() -> None:
    search = start_of("i-mbd", tiny_problem(1))
    search.advance()
    expected = algorithm_1(
        search.current.planned,
        list(alpha_bar(STEPS, *BETAS)),
        draws_of(search),
        rewards_of(search, np.float32(0)),
        TEMPERATURE,
    )
    assert_controls(search, expected)


@pytest.mark.parametrize("clip", [None, False, True])
@pytest.mark.parametrize("name", ["d4orm", "mppi", "cem", "i-mbd"])
def test_an_iteration_starts_from_the_controls_as_planned_or_as_executed(name: str, clip: bool | None) -> None:
    limit, wanted, docks = 1, 5, 20
    given = np.zeros((30, 2, 2))
    given[:, :, 0] = [wanted, -wanted]  # One robot docks, the other drives away from its goal.
    settings = {} if clip is None else {"clip_between_iterations": clip}
    silent = {"beta_start": 1e-12, "beta_end": 1e-12} if name in ("d4orm", "i-mbd") else {"sigma": 1e-5}
    planner = make_planner(name, engine="cpu", num_samples=2, num_steps=1, **silent, **settings)
    search = SolveRun(planner, hop_problem(2), 0, given)
    search.iteration = 1
    assert search.current.trajectory.arrived[docks, 0]
    got = planner.iterate(search, None)[1].controls[:, :, 0]
    start = limit if clip or (clip is None and name == "d4orm") else wanted
    np.testing.assert_allclose(got[:10, 0], start, atol=1e-3)
    np.testing.assert_allclose(got[docks:, 0], 0, atol=1e-3)
    np.testing.assert_allclose(got[:, 1], -start, atol=1e-3)


def test_controls_that_are_scaled_up_for_ever_stay_finite() -> None:
    # By 1.66 in every iteration: 200 of them would be more than a float32 holds.
    plan = cheap_planner("i-mbd", num_samples=2, num_steps=1).solve(walled_in_problem(), max_iterations=200)
    assert plan.iterations == 200
    search = SolveRun(cheap_planner("i-mbd"), hop_problem(1), 0, np.full((30, 1, 2), 1e17))
    assert search.current.planned.max() == np.float32(1e12)
    assert np.abs(search.current.controls).max() <= 1


def test_mbd_goes_on_from_noise_again() -> None:
    search = start_of("mbd", tiny_problem(1))
    search.advance()
    noise = standard_normal(search, search.problem.team, search.problem.horizon)
    expected = algorithm_1(
        noise, list(alpha_bar(STEPS, *BETAS)), draws_of(search), rewards_of(search, np.float32(0)), TEMPERATURE
    )
    assert_controls(search, expected)


def test_mbd_is_the_same_run_however_often_it_is_looked_at() -> None:
    """But for the noise, which is an iteration's own; and after its last step it begins anew."""
    problem = tiny_problem(1)
    search = start_of("mbd", problem, check_every=3)
    scale, seen = search.planner.noise_scale(), []
    mean = search.planner.first_mean(standard_normal(search, problem.team, problem.horizon))
    for part in (scale[:3], scale[3:]):
        task, rules = SamplingTask(problem, np.zeros_like(mean)), search.planner.rules()
        mean = search.engine.denoise(task, rules, mean, part, SAMPLES, search.iteration_seed()).mean
        seen.append(search.advance().denoising_steps)
        np.testing.assert_allclose(search.current.planned, mean, atol=1e-5)
    assert seen == [3, STEPS]
    assert search.advance().denoising_steps == STEPS + 3


def test_cem_may_carry_its_variance_over() -> None:
    settings = {"adapt_variance": True, "sigma_floor": 0.01}
    searches = [start_of("cem", tiny_problem(1), carry_variance=carry, **settings) for carry in (False, True)]
    for search in searches:
        search.advance()
    np.testing.assert_array_equal(*(search.current.planned for search in searches))
    first, kept = (search.state.noise_factor for search in searches)
    np.testing.assert_array_equal(first, kept)
    before = searches[0].current.planned
    anew, carried = (np.abs(search.current.planned - before).max() for search in searches if search.advance())
    assert 0 < carried < anew
    with pytest.raises(ValueError, match=r"carry_variance is True.*set adapt_variance=True"):
        make_planner("cem", carry_variance=True)


@CREDIT
def test_mppi_is_a_softmax_update_under_a_fixed_covariance(num_robots: int, credit: str) -> None:
    search = start_of("mppi", tiny_problem(num_robots), credit=credit, sigma=0.6)
    base, reward, draw = search.current.controls, rewards_of(search, np.float32(0)), draws_of(search)
    controls = base.astype(np.float64)
    for step in range(STEPS):
        samples = controls + 0.6 * draw(step)
        rewards = reward(samples)
        columns = rewards[:, None].repeat(num_robots, axis=1) if rewards.ndim == 1 else rewards
        parts = [np.tensordot(softmax(columns[:, k], TEMPERATURE), samples[:, :, k], axes=1) for k in range(num_robots)]
        controls = np.stack(parts, axis=1)
    assert_controls(search, controls)


@pytest.mark.parametrize("adapt", [False, True])
def test_cem_is_the_mean_of_its_elite(adapt: bool) -> None:
    floor = 0.4
    search = start_of("cem", tiny_problem(1), sigma=0.6, elite_fraction=0.1, adapt_variance=adapt, sigma_floor=floor)
    reward, draw = rewards_of(search, np.float32(0)), draws_of(search)
    controls, sigma = search.current.controls.astype(np.float64), np.full(search.current.controls.shape, 0.6)
    floored = 0
    for step in range(STEPS):
        samples = controls + sigma * draw(step)
        elite = samples[np.argsort(reward(samples))[-round(0.1 * SAMPLES) :]]
        controls = elite.mean(axis=0)
        if adapt:
            floored += (elite.std(axis=0) < floor).sum()
            sigma = np.maximum(elite.std(axis=0), floor)
    # The floor must matter for some controls and not for others, or this would not test it.
    assert not adapt or 0 < floored < STEPS * sigma.size
    assert_controls(search, controls)


def test_the_noise_of_the_reference_is_standard_normal() -> None:
    draws = engine_noise(hop_problem(2, horizon=20), 3, 0, 512)
    assert draws.mean() == pytest.approx(0, abs=1e-6)
    assert draws.std() == pytest.approx(1, abs=0.01)
    assert np.abs(draws).max() < 6


@pytest.mark.parametrize("name", ["d4orm", "mppi", "cem"])
def test_credit_by_groups_is_that_of_those_in_conflict(name: str) -> None:
    problem = make_problem("circle", num_robots=4)
    drives = straight_drives(problem).controls[:, :, 0]  # everybody meets in the middle
    for start, same in ((None, "robot"), (drives, "team")):
        controls = []
        for credit in ("group", same):
            search = SolveRun(cheap_planner(name, credit=credit), problem, 0, start)
            search.advance()
            controls.append(search.current.controls)
        np.testing.assert_allclose(*controls, atol=1e-3)


def test_the_methods_sample_with_the_papers_deviation() -> None:
    np.testing.assert_array_equal(make_planner("d4orm", preset="paper").noise_scale(), annealed(100, 1e-4, 2e-2))
    np.testing.assert_array_equal(make_planner("i-mbd", preset="paper").noise_scale(), annealed(100, 1e-4, 2e-2))
    np.testing.assert_array_equal(make_planner("mppi", preset="paper").noise_scale(), np.ones(100, np.float32))
    np.testing.assert_array_equal(make_planner("cem", preset="paper").noise_scale(), np.ones(100, np.float32))
