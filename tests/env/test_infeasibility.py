"""Problems without a solution: what is proved, ends every planner at once, and is told; and what must not be proved."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planner_support import cheap_planner, hop_problem, sealed_problem, walled_in_problem

from d4orm_env import load_problem, save_problem
from d4orm_env.core.infeasibility import prove_infeasible
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.scenarios import list_scenarios, make_problem
from d4orm_planners import Plan, list_planners, make_planner


def passage(width: float, *, robots: int = 1, upper: float = 3.0, **changes: object) -> Problem:
    """Robots of radius 0.15 m that keep 0.05 m, and a passage 2 m long to the other half of their room."""
    boxes = [[1, -upper, 3, -width / 2], [1, width / 2, 3, upper]]
    start = np.array([[0, y, 0, 0] for y in range(robots)], float)
    goal = start[:, :2] + [4, 0]
    world = World(boxes=boxes, lower=[-1, -3], upper=[5, 3])
    return Problem(Team(("holonomic2d",) * robots), start, goal, world, **changes)


def beside_wall(gap: float, speed: float, model: str = "holonomic2d") -> Problem:
    """A robot so far from a wall that drives towards it or away from it at first."""
    team, world = Team((model,), max_acceleration=1.0), World(boxes=[[-5, -1, 5, 0]])
    start = [[0, 0.15 + gap, 0, speed, 0, 0][: team.state_size]]
    return Problem(team, start, [[0, 3]], world, dt=0.1, margin=0.2)


@pytest.mark.parametrize("name", list_planners())
def test_every_planner_ends_at_once_where_nothing_is_a_solution(name: str, tmp_path: Path) -> None:
    plan = cheap_planner(name).solve(sealed_problem(), callback=lambda record: pytest.fail("there is no iteration"))
    assert (plan.status, plan.solved, plan.iterations, plan.history) == ("infeasible", False, 0, ())
    assert plan.failures == {"robot_0": "has no free path to its goal: walls are closed all round the one or the other"}
    plan.save(tmp_path / "plan.npz")
    loaded = Plan.load(tmp_path / "plan.npz")
    assert (loaded.status, loaded.failures) == ("infeasible", plan.failures)


def test_a_file_is_told_of_when_it_is_read(tmp_path: Path) -> None:
    save_problem(walled_in_problem(), tmp_path / "scene.yaml")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_problem(tmp_path / "scene.yaml")  # too small a proof for so little room
    save_problem(sealed_problem(), tmp_path / "scene.yaml")
    with pytest.warns(UserWarning, match="scene.yaml: nothing solves this problem: robot_0 has no free path"):
        assert load_problem(tmp_path / "scene.yaml") == sealed_problem()


def test_a_file_that_calls_a_problem_infeasible_is_not_believed(tmp_path: Path) -> None:
    plan = cheap_planner("d4orm").solve(walled_in_problem(), max_iterations=1)
    replace(plan, status="infeasible").save(tmp_path / "plan.npz")
    assert Plan.load(tmp_path / "plan.npz").status == "refuted"
    solved = make_planner("d4orm", engine="cpu").solve(hop_problem())
    with pytest.raises(ValueError, match="one of them must be wrong"):
        replace(solved, status="infeasible")


@pytest.mark.parametrize("name", ["hybrid", "mapf", "mmd"])
def test_a_reason_that_proves_nothing_is_kept(name: str) -> None:
    few = {"num_samples": 64, "num_steps": 5, "repair_samples": 64, "repair_steps": 5}
    known = make_planner(name).config.setting_names()
    planner = make_planner(name, engine="cpu", **{key: value for key, value in few.items() if key in known})
    plan = planner.solve(walled_in_problem(), max_iterations=2)
    assert (plan.status, plan.iterations) == ("iteration_limit", 2)
    assert "robot_0 has no path from start to goal that is 0.2 m clear of obstacles" in plan.history[0].note
    assert plan.history[0].unreachable == (0,)
    assert "has no path from start to goal that is 0.2 m clear of obstacles" in plan.failures["robot_0"]


def test_what_path_finding_knew_is_in_a_plans_file(tmp_path: Path) -> None:
    plan = make_planner("mapf").solve(walled_in_problem(), max_iterations=1)
    plan.save(tmp_path / "plan.npz")
    loaded = Plan.load(tmp_path / "plan.npz")
    assert loaded.history == plan.history
    assert loaded.failures == plan.failures


@pytest.mark.parametrize("command", [("plan",), ("run",), ("run", "--policy", "go-to-goal")])
def test_the_command_line_says_what_is_proved(d4orm, tmp_path: Path, command: tuple[str, ...]) -> None:
    save_problem(sealed_problem(), tmp_path / "ring.yaml")
    outcome = d4orm(*command, "--scenario", "ring.yaml", "--quiet")
    assert outcome.status == 1
    assert outcome.err.splitlines() == [
        "there is no solution",
        "  robot_0 has no free path to its goal: walls are closed all round the one or the other",
    ]


# What is proved.


@pytest.mark.parametrize(("width", "proved"), [(0.0, True), (0.2, True), (0.25, True), (0.32, False), (0.5, False)])
def test_a_passage_too_narrow_for_the_body_is_a_wall(width: float, proved: bool) -> None:
    assert set(prove_infeasible(passage(width, robots=2))) == ({0, 1} if proved else set())


def test_slow_robots_cannot_leap_over_the_margin() -> None:
    # The margin of 5 cm does not fit by 4 cm a side. In a step robots get 10 cm, or 1 cm.
    narrow = passage(0.32)
    assert not prove_infeasible(narrow)
    slow = Problem(Team(("holonomic2d",), max_speed=0.1), narrow.start, narrow.goal, narrow.world)
    assert list(prove_infeasible(slow)) == [0]


def test_a_path_round_the_wall_is_a_path() -> None:
    assert not prove_infeasible(passage(0.0, upper=2.0))
    outside = passage(0.0)
    assert not prove_infeasible(Problem(outside.team, outside.start, outside.goal, World(boxes=outside.world.boxes)))


@pytest.mark.parametrize(
    ("walls", "proved"), [([[1, -210, 3, 210]], True), ([[1, -210, 3, -0.125], [1, 0.125, 3, 210]], False)]
)
def test_a_room_of_400_m_is_cut_into_coarser_cells_which_prove_less(walls: list[list[float]], proved: bool) -> None:
    world = World(boxes=walls, lower=[-200, -200], upper=[200, 200])
    problem = Problem(Team(("holonomic2d",)), [[0, 0, 0, 0]], [[4, 0]], world)
    assert list(prove_infeasible(problem)) == [0] * proved


def test_only_who_is_walled_off_is_named() -> None:
    sealed = sealed_problem()
    start, goal = np.array([[0, 0, 0, 0], [0, 2, 0, 0]]), np.array([[3, 0], [3, 2]])
    assert list(prove_infeasible(Problem(Team(("holonomic2d",) * 2), start, goal, sealed.world))) == [0]


@pytest.mark.parametrize(
    ("gap", "speed", "proved"),
    # It gains 5 mm by accelerating, and 5 cm by its speed.
    [(0.19, 0.0, True), (0.196, 0.0, False), (0.14, 0.5, True), (0.146, 0.5, False)],
)
def test_a_start_within_the_margin_must_be_left_in_one_step(gap: float, speed: float, proved: bool) -> None:
    proofs = prove_infeasible(beside_wall(gap, speed))
    assert set(proofs) == ({0} if proved else set())
    if proved:
        assert proofs[0] == (
            f"starts {gap:.3g} m from an obstacle or the bounds, and cannot come clear of them by the margin of 0.2 m "
            "within one step"
        )


@pytest.mark.parametrize(("gap", "proved"), [(0.09, True), (0.11, False)])
def test_a_first_order_robot_may_start_at_full_speed(gap: float, proved: bool) -> None:
    assert bool(prove_infeasible(beside_wall(gap, 0.0, "velocity2d"))) == proved


@pytest.mark.parametrize(("gap", "proved"), [(0.19, True), (0.1995, False)])
def test_a_robot_of_limited_jerk_gains_a_little_in_its_first_step(gap: float, proved: bool) -> None:
    assert bool(prove_infeasible(beside_wall(gap, 0.0, "holonomic2d_jerk"))) == proved


@pytest.mark.parametrize("arrival", ["dock", "stay"])
@pytest.mark.parametrize(("apart", "proved"), [(0.44, True), (0.46, False)])
def test_goals_too_near_to_each_other_are_no_goals(arrival: str, apart: float, proved: bool) -> None:
    # Two radii of 0.15 m and a margin of 0.3 m, less twice the goal radius of 0.075 m.
    start = np.zeros((3, 4))
    start[:, 1] = [0, 2, 4]
    goal = np.array([[3, 0], [3, apart], [3, 4]])
    problem = Problem(Team(("holonomic2d",) * 3), start, goal, margin=0.3, goal_radius=0.075, arrival=arrival)
    proofs = prove_infeasible(problem)
    assert set(proofs) == ({0, 1} if proved else set())
    if proved:
        assert proofs[1] == (
            "has a goal 0.14 m from robot_0's, and the two cannot come clear of each other by the margin of 0.3 m "
            "within the goal radius"
        )


def test_a_solution_given_is_no_longer_asked_for_proofs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("d4orm_planners.base.planner.prove_infeasible", lambda problem: pytest.fail("it was asked"))
    problem = hop_problem()
    given = np.zeros((problem.horizon, 3, 2), np.float32)
    given[..., 0] = 1
    assert cheap_planner("d4orm").solve(problem, initial_controls=given).status == "solved"


# What must not be proved.


@pytest.mark.parametrize("scenario", [name for name in list_scenarios() if name != "map"])
def test_no_scenario_is_infeasible(scenario: str) -> None:
    assert not prove_infeasible(make_problem(scenario, seed=0))


@given(
    circles=st.lists(st.tuples(*[st.floats(-2.5, 2.5)] * 2, st.floats(0.1, 0.8)), min_size=1, max_size=14),
    radius=st.floats(0.01, 0.4),
    bounded=st.booleans(),
)
def test_who_has_a_way_is_not_walled_off(
    circles: list[tuple[float, float, float]], radius: float, bounded: bool
) -> None:
    world = World(circles=circles, **({"lower": [-4, -3], "upper": [4, 3]} if bounded else {}))
    try:
        problem = Problem(Team(("velocity2d",), radius=radius), [[-3, 0]], [[3, 0]], world)
    except ValueError:
        return
    if np.isfinite(problem.shortest_paths.length).all():
        assert not prove_infeasible(problem)
