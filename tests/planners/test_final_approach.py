"""Plans that the rollout takes for solved and ``verify`` refuses: who is to blame is known, repaired, and told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from planner_support import cheap_planner

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.transition import SPEED_ALLOWANCE
from d4orm_env.scenarios import make_problem
from d4orm_env.verify import verify
from d4orm_planners import list_planners, make_planner
from d4orm_planners.base.candidate import Candidate, evaluate_controls
from d4orm_planners.base.planner import Iteration, Planner, PlannerConfig
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.tracking.steering import Rollouts, at_rest, drives, must_brake, straight_drives

FURTHER_IN = "d4orm_planners.base.solve.drive_further_in"


def quarters(model: str = "unicycle", goal_radius: float = 0.1, **changes: Any) -> Problem:
    """Two robots whose path to the goal radius is a whole number of strides, the first one's as float32 has it."""
    start = np.zeros((2, {"unicycle": 3, "velocity2d": 2}[model]))
    start[:, :2] = [[-1.25, 0], [-1.25, 2.0]]
    goal = start[:, :2] + [[2.0, 0], [0.77, 0]]
    return Problem(
        Team((model,) * 2, max_speed=0.5), start, goal, dt=0.1, goal_radius=goal_radius, horizon=100, **changes
    )


def straight(problem: Problem) -> FloatArray:
    return straight_drives(problem).controls[:, :, 0]


def leap() -> tuple[Problem, FloatArray]:
    """Two robots so small and so fast that they are past each other within a step, through each other."""
    start = np.array([[-0.75, 0], [0.75, 0]])
    team = Team(("velocity2d",) * 2, radius=0.02, max_speed=2.0)
    problem = Problem(team, start, -start, dt=0.4, margin=0.01, horizon=20)
    controls = np.zeros((20, 2, 2), np.float32)
    controls[:, 0, 0], controls[:, 1, 0] = 1.25, -1.25
    controls[3:] = 0
    return problem, controls


class Given(Planner):
    """A planner that knows one answer."""

    answer: FloatArray

    def iterate(self, search: SolveRun, state: Any) -> tuple[Any, Iteration]:
        return state, Iteration(self.answer)


def given(controls: FloatArray) -> Given:
    planner = Given(PlannerConfig(engine="cpu"))
    planner.answer = controls
    return planner


def evaluated(problem: Problem, controls: FloatArray) -> Candidate:
    return evaluate_controls(SolveRun(given(controls), problem, 0).engine, problem, controls)


def test_a_candidate_knows_whom_verify_refuses() -> None:
    problem = quarters()
    candidate = evaluated(problem, straight(problem))
    assert not candidate.failed.any()
    assert not candidate.solved
    assert candidate.unsolved.tolist() == [True, False]
    assert candidate.rank[:2] == (False, -1)
    assert candidate.report is not None
    assert "which rounding decides; drive further in" in str(candidate.report.violations[0])


def test_who_fails_at_the_steps_is_not_verified() -> None:
    problem = quarters()
    candidate = evaluated(problem, np.zeros_like(straight(problem)))
    assert candidate.report is None
    assert candidate.unsolved.all()


@pytest.mark.parametrize("name", list_planners())
def test_every_planner_drives_further_in(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, planner = quarters(), cheap_planner(name)
    monkeypatch.setattr(planner, "iterate", lambda search, state: (state, Iteration(straight(problem))))
    plan = planner.solve(problem)
    assert (plan.status, plan.iterations) == ("solved", 1)
    assert plan.verified
    # The other one does as it did.
    np.testing.assert_array_equal(plan.controls[:, 1], evaluated(problem, straight(problem)).controls[:, 1])


@pytest.mark.parametrize("model", ["unicycle", "velocity2d"])
@pytest.mark.parametrize("goal_radius", [0.1, 0.2])
@pytest.mark.parametrize("steps", range(2, 12))
def test_robots_that_drive_by_quarters_of_a_metre_arrive(model: str, goal_radius: float, steps: int) -> None:
    problem = quarters(model, goal_radius)
    problem = problem.replace(goal=problem.start[:, :2] + np.float32([[steps / 4, 0], [steps / 4, 0]]))
    assert given(straight(problem)).solve(problem, max_iterations=1).status == "solved"


def test_robots_drive_further_in_where_they_would_touch_something_beyond() -> None:
    """It drifts by its goal as fast as it may dock; in the reading in which it does not, on into an obstacle."""
    problem = Problem(
        Team(("holonomic2d",)), [[-0.5, 0, 0.25, 0]], [[0, 0]], World(2, circles=[[0.6, 0, 0.1]]),
        horizon=60, goal_speed=0.25 - SPEED_ALLOWANCE,
    )  # fmt: skip
    drifting = np.zeros((60, 1, 2), np.float32)
    report = evaluated(problem, drifting).report
    assert report is not None
    assert {violation.kind for violation in report.violations} == {"not arrived", "obstacle contact"}
    assert given(drifting).solve(problem, max_iterations=1).status == "solved"


def test_a_plan_that_verify_refuses_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FURTHER_IN, lambda search, candidate, evaluate: candidate)
    problem = quarters()
    plan = given(straight(problem)).solve(problem, max_iterations=3)
    assert plan.status == "iteration_limit"
    assert [record.num_failed for record in plan.history] == [1, 1, 1]
    assert list(plan.failures) == ["robot_0"]
    assert plan.failures["robot_0"].startswith("not arrived at 10.000 s, robot_0: 0.1")


def test_repairs_see_whom_verify_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FURTHER_IN, lambda search, candidate, evaluate: candidate)
    problem = quarters()
    plan = make_planner("d4orm-d", engine="cpu").solve(problem, initial_controls=straight(problem), max_iterations=3)
    assert plan.solved, plan.failures
    # Not the whole team is deformed for it.
    np.testing.assert_array_equal(plan.controls[:, 1], evaluated(problem, straight(problem)).controls[:, 1])


def test_robots_that_leap_through_each_other_are_both_to_blame() -> None:
    problem, controls = leap()
    candidate = evaluated(problem, controls)
    assert not candidate.failed.any()
    assert candidate.unsolved.all()
    plan = given(controls).solve(problem, max_iterations=1)
    assert all("robot contact" in reason for reason in plan.failures.values())
    assert list(plan.failures) == ["robot_0", "robot_1"]


def test_who_is_refused_is_at_fault_until_it_moves() -> None:
    problem, controls = leap()
    candidate = evaluated(problem, controls)
    team = WorkingPlan(SolveRun(given(controls), problem, 0), candidate.trajectory, candidate.report)
    faults, first = team.faults([0, 1])
    assert faults.tolist() == [1, 1]
    assert first.tolist() == [2, 2]  # they meet within the second step
    path = drives(problem, *at_rest(problem), [[0], [0]], np.full((2, 1, 1, 2), [[0.0, 1.0]]))
    team.take_best([0], Rollouts(path.controls[:, :1], path.states[:, :1], path.arrived[:1], 2))
    assert team.faults([0, 1])[0].tolist() == [0, 1]
    # What it does already is no other way.
    before = team.controls.copy()
    team.take_best([1], Rollouts(controls[:, [1], None], team.states[:, [1], None], np.ones((1, 1), bool), 2))
    assert team.faults([0, 1])[0].tolist() == [0, 1]
    np.testing.assert_array_equal(team.controls, before)


def test_a_solved_plan_has_no_failures() -> None:
    problem = quarters()
    assert given(straight(problem)).solve(problem, max_iterations=1).failures == {}


# Robots that must slow down to dock.


@pytest.mark.parametrize("name", ["d4orm", "d4orm-d", "mppi", "cem", "mbd", "i-mbd"])
def test_samplers_brake_for_their_goals_and_the_papers_do_not(name: str) -> None:
    problem = make_problem("circle", num_robots=3)
    config = {"engine": "cpu", "num_samples": 64, "num_steps": 20, "max_iterations": 5}
    plan = make_planner(name, **config).solve(problem, seed=0)
    assert plan.solved, plan.failures
    report = verify(problem, plan.controls)
    assert report.dynamics_ok
    assert (report.arrival_speeds <= problem.goal_speed + 1e-4).all()
    exclude = make_planner(name, **config, final_approach=False).solve(problem, seed=0)
    # Repairs of D4orm-D do so in any case.
    assert plan.metrics["travel_time"] < exclude.metrics["travel_time"] or name == "d4orm-d"
    assert make_planner(name, preset="paper").config.keywords()["final_approach"] is False


def test_goals_that_stop_robots_need_no_final_approach() -> None:
    problem = make_problem("circle", num_robots=3, goal_speed=np.inf)
    plans = [
        make_planner("d4orm", engine="cpu", num_samples=32, num_steps=10, final_approach=final).solve(
            problem, seed=0, max_iterations=1
        )
        for final in (True, False)
    ]
    np.testing.assert_array_equal(plans[0].controls, plans[1].controls)


@pytest.mark.parametrize("seed", range(3))
def test_robots_that_need_not_brake_turn_to_goal_headings(seed: int) -> None:
    team = Team(("unicycle",) * 2)
    start, goal, headings = [[0, 0, 0.86], [0, 3, -2.88]], [[1.87, -0.71], [1.45, 1.62]], [1.97, np.nan]
    problem = Problem(team, start, goal, goal_heading=headings, horizon=150)
    plan = make_planner("d4orm", engine="cpu").solve(problem, seed=seed, max_iterations=2)
    assert plan.solved, plan.failures


def test_who_cannot_wait_with_braking() -> None:
    problem = make_problem("circle", num_robots=4, diameter=8.0)
    goals = problem.goal
    direction = goals / np.linalg.norm(goals, axis=1, keepdims=True)
    # From 1 m/s it takes 0.5 m and a step of 0.1 m to the radius of 0.075 m around the goal.
    away = np.array([0.6, 0.7, 0.05, 3.0])[:, None]
    states = np.concatenate([goals - away * direction, direction * [[1.0], [1.0], [0.0], [1.0]]], axis=1)
    controls = np.zeros((4, 2), np.float32)
    args = states.astype(np.float32), controls, goals
    assert must_brake(problem, *args).tolist() == [True, False, True, False]
    assert not must_brake(problem.replace(goal_speed=np.inf), *args).any()
