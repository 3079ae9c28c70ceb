"""D4orm solves what it must: circles of every model, mixed teams, space and obstacles, and knows when it has not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from planner_support import hop_problem, walled_in_problem

from d4orm_env.scenarios import make_problem
from d4orm_env.verify import verify
from d4orm_planners import Plan, make_planner
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.cpu_sampling import CpuSamplingEngine
from d4orm_planners.engine.sampling_types import SamplingTask, get_sampling_engine
from d4orm_planners.sampling.d4orm import D4orm

BUDGET = 25
"""Five times the iterations that any of some twenty seeds takes: other rounding makes another plan."""

SOON = [
    pytest.param({"scenario": "circle", "num_robots": 4}, id="circle-4"),
    pytest.param({"scenario": "circle", "num_robots": 8}, id="circle-8"),
    pytest.param({"scenario": "circle", "num_robots": 12}, id="circle-12"),
    pytest.param({"scenario": "circle", "num_robots": 8, "model": "differential_drive"}, id="differential-drive-8"),
    pytest.param({"scenario": "circle", "num_robots": 8, "model": "velocity2d"}, id="velocity2d-8"),
    pytest.param({"scenario": "circle", "num_robots": 8, "model": "holonomic3d"}, id="holonomic3d-8"),
    pytest.param({"scenario": "heterogeneous", "num_robots": 8}, id="heterogeneous-8"),
]


def assert_solves(case: dict[str, Any], seed: int, max_iterations: int, **config: Any) -> Plan:
    """The default planner solves the case; whatever it claims is checked here anew."""
    problem = make_problem(**case)
    plan = make_planner("d4orm", engine="cpu", **config).solve(problem, seed=seed, max_iterations=max_iterations)
    assert plan.solved, [(record.num_not_arrived, record.num_margin_violated) for record in plan.history]
    assert plan.status == "solved"
    report = verify(problem, plan.controls)
    assert report.ok, report.violations
    assert np.isfinite(report.arrival_times).all()
    again = get_sampling_engine("cpu").rollout(problem, plan.controls)
    assert again.arrived[-1].all()
    assert not again.margin_violated.any()
    assert plan.metrics["success"] == 1
    assert plan.metrics["makespan"] == pytest.approx(report.arrival_times.max(), abs=1.5 * problem.dt)
    return plan


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("case", SOON)
def test_default_settings_solve_soon(case: dict[str, Any], seed: int) -> None:
    assert_solves(case, seed, BUDGET)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 7))
@pytest.mark.parametrize("case", SOON)
def test_default_settings_solve_more_seeds(case: dict[str, Any], seed: int) -> None:
    assert_solves(case, seed, BUDGET)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("case", "limit"),
    [
        pytest.param({"scenario": "circle", "num_robots": 12, "model": "holonomic3d"}, BUDGET, id="holonomic3d-12"),
        pytest.param({"scenario": "circle", "num_robots": 16}, 2 * BUDGET, id="circle-16"),
    ],
)
def test_default_settings_solve_larger_teams(case: dict[str, Any], limit: int, seed: int) -> None:
    assert_solves(case, seed, limit)


@pytest.mark.parametrize("seed", [0, 1])
def test_obstacles_in_space(seed: int) -> None:
    assert_solves({"scenario": "amswarm_2"}, seed, BUDGET)


@pytest.mark.parametrize("seed", [0, 1])
def test_obstacles_in_the_plane(seed: int) -> None:
    assert_solves({"scenario": "four_obstacles", "num_robots": 4}, seed, BUDGET)


def test_the_papers_algorithm_solves_too() -> None:
    problem = make_problem("circle", num_robots=4, goal_speed=np.inf)
    plan = make_planner("d4orm", preset="paper", engine="cpu").solve(problem, seed=0, max_iterations=BUDGET)
    assert plan.solved
    assert verify(problem, plan.controls).ok
    assert plan.denoising_steps == 100 * plan.iterations


@pytest.mark.slow
def test_the_papers_algorithm_solves_what_the_paper_does() -> None:
    assert_solves({"scenario": "paper_circle", "num_robots": 16}, 0, 2 * BUDGET, preset="paper")


def test_a_team_of_one() -> None:
    plan = assert_solves({"scenario": "circle", "num_robots": 1}, 0, 5)
    # Five metres, less the goal radius, from rest: 1 s to reach 1 m/s within half a metre, then full speed.
    assert 5.4 <= plan.metrics["makespan"] <= 6.5


def test_a_walled_in_goal_ends_at_the_budget_unsolved() -> None:
    problem = walled_in_problem()
    plan = make_planner("d4orm", engine="cpu", num_samples=128, num_steps=20).solve(problem, max_iterations=4)
    assert plan.status == "iteration_limit"
    assert plan.iterations == 4
    assert not plan.solved
    assert not any(record.solved or record.best_solved for record in plan.history)
    # Either it stays outside, or it went through the wall and that was noticed.
    assert not plan.trajectory.arrived[-1].all() or plan.trajectory.margin_violated.any()


def test_robots_that_start_at_their_goals_are_done() -> None:
    problem = make_problem("circle", num_robots=3)
    there = problem.replace(goal=problem.start[:, :2])
    plan = make_planner("d4orm", engine="cpu").solve(there)
    assert plan.solved
    assert plan.iterations == 0
    assert not plan.controls.any()


def test_iterations_bring_the_reward_up() -> None:
    problem = make_problem("circle", num_robots=4)
    planner = make_planner("d4orm", engine="cpu", num_samples=128, num_steps=20, improve=True)
    history = planner.solve(problem, max_iterations=4).history
    assert history[-1].best_reward > history[0].best_reward > 0.2


def test_robot_credit_learns_faster_than_team_credit() -> None:
    # The team's mean dilutes each robot's part: after one iteration without collisions the difference is large.
    problem = make_problem("circle", num_robots=16)
    gained = {}
    for credit in ("team", "robot"):
        planner = make_planner("d4orm", engine="cpu", num_samples=256, num_steps=20, credit=credit)
        search = SolveRun(planner, problem, 0, None)
        task = SamplingTask(problem, search.current.controls, collisions=False, credit=credit)
        result = search.engine.denoise(task, planner.rules(), task.base, planner.noise_scale(), 256, 0)
        controls = search.engine.rollout(problem, task.base + result.mean)
        gained[credit] = 1 - np.linalg.norm(controls.positions[1:] - problem.goal, axis=-1).mean() / 5
    assert gained["robot"] > gained["team"] + 0.1


def test_without_a_solution_the_teams_reward_and_more_samples_take_turns() -> None:
    class Recorded(CpuSamplingEngine):
        def denoise(self, task: Any, rules: Any, mean: Any, noise_scale: Any, num_samples: int, *more: Any) -> Any:
            asked.append((task.credit, num_samples))
            return super().denoise(task, rules, mean, noise_scale, num_samples, *more)

    asked: list[tuple[str, int]] = []
    planner = make_planner("d4orm", engine="cpu", credit="alternate", num_samples=8, num_steps=2, late_samples=1.0)
    search = SolveRun(planner, walled_in_problem(), 0, None, Recorded())
    for _ in range(26):
        search.advance()
    in_turn = [("robot", 8), ("team", 8)] * 4
    expected = [*in_turn, *[("team", 32)] * 8, *in_turn, *[("team", 32)] * 2]
    assert asked[-26:] == expected, "the first of all compiles, if nothing has before"


def test_the_teams_reward_has_all_samples_at_every_step_where_no_solution_is_found() -> None:
    planner = make_planner("d4orm", engine="cpu", credit="alternate", num_samples=8, num_steps=10, late_samples=0.5)
    assert isinstance(planner, D4orm)
    search = SolveRun(planner, walled_in_problem(), 0)
    drawn = []
    for _ in range(9):
        drawn.append([(len(scale), samples) for scale, samples in planner.stages(search)])
        search.advance()
    assert drawn == [[(3, 8), (7, 4)]] * 8 + [[(10, 32)]]


def test_who_pays_for_both_sides_of_a_contact_makes_way() -> None:
    # Fast drives cross each other between slower robots: going through costs each less than making way.
    problem = make_problem("paper_heterogeneous", num_robots=8)
    iterations = {
        penalty: [
            make_planner("d4orm", engine="cpu", penalty=penalty).solve(problem, seed=seed, max_iterations=8).iterations
            for seed in range(4)
        ]
        for penalty in (1.0, 2.0)
    }
    assert np.mean(iterations[2.0]) < np.mean(iterations[1.0])
    assert max(iterations[2.0]) < 8


@pytest.mark.parametrize("name", ["d4orm", "i-mbd", "mbd", "mppi", "cem", "d4orm-d"])
def test_a_violation_costs_what_is_asked(name: str) -> None:
    search = SolveRun(make_planner(name, engine="cpu", penalty=4.0), hop_problem(2), 0, None)
    # D4orm-D's is that of its repairs.
    assert search.planner.task(search, search.current.controls).penalty == 4.0


def test_both_engines_plan_the_same() -> None:
    # Half a second, in which nobody comes near its goal or another: no reward jumps, so that rounding stays rounding.
    problem = hop_problem(2, horizon=5)
    settings = {"num_samples": 128, "num_steps": 5, "max_iterations": 1}
    on_cpu = make_planner("d4orm", engine="cpu", **settings).solve(problem, seed=3)
    on_jax = make_planner("d4orm", engine="jax", **settings).solve(problem, seed=3)
    assert np.abs(on_cpu.controls).max() > 0.1
    np.testing.assert_allclose(on_jax.controls, on_cpu.controls, atol=2e-3)
    assert on_jax.history[0].reward == pytest.approx(on_cpu.history[0].reward, abs=1e-4)


@pytest.mark.slow
def test_the_jax_engine_solves() -> None:
    problem = make_problem("circle", num_robots=4)
    planner = make_planner("d4orm", engine="jax", num_samples=256, num_steps=30)
    plan = planner.solve(problem, seed=0, max_iterations=BUDGET)
    assert plan.solved
    assert verify(problem, plan.controls).ok
