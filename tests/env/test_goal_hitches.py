"""Hitch angles with which trailers must arrive."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from d4orm_env import Problem, Team, World, load_problem, rollout, save_problem, verify
from d4orm_env.footprints import Box, Train
from d4orm_planners import make_planner

FIRST = 0.3
"""Hitch angle of the first trailer at its goal [rad]."""


def problem_of(hitches: Any = ((FIRST, np.nan, np.nan), (np.nan, np.nan, np.nan)), **arguments: Any) -> Problem:
    """A car that stands bent at its goal, 0.02 m away, beside one without a goal heading."""
    team = Team(("car_with_1_trailer", "unicycle"))
    start = [[0, 0, 0, FIRST], [0, 3, 0, 0]]
    usual: dict[str, Any] = {"goal_heading": [0.0, np.nan], "goal_hitches": hitches, "horizon": 3}
    return Problem(team, start, [[0.02, 0], [0.02, 3]], **usual | arguments)


@pytest.mark.parametrize("engine", ["cpu", "jax"])
@pytest.mark.parametrize(
    ("angle", "arrives"), [(FIRST, True), (FIRST + 0.09, True), (FIRST - 0.11, False), (-FIRST, False)]
)
def test_a_robot_arrives_with_its_trailer_as_it_should_be(engine: str, angle: float, arrives: bool) -> None:
    problem = problem_of([[angle, np.nan, np.nan], [np.nan] * 3])
    controls = np.zeros((3, 2, 2), np.float32)
    trajectory = rollout(problem, controls, engine=engine)
    assert trajectory.arrived[-1].tolist() == [arrives, True]
    report = verify(problem, controls)
    assert report.ok == arrives
    if not arrives:
        (violation,) = report.violations
        assert re.search(r"0\.\d+ rad from its goal heading or a hitch angle \(tolerance 0.1 rad\)", violation.detail)


def test_a_trailer_is_brought_to_its_hitch_angle() -> None:
    """Round a curve, whose last swing ends at it, and not only in line or in a circle."""
    team = Team(("car_with_2_trailers",), own_limits={"max_steering": 1.0})
    problem = Problem(
        team, [[0, 0, 0, 0, 0]], [[4, 2]], horizon=300, goal_heading=1.0, goal_heading_tolerance=0.01,
        goal_hitches=[[0.2, -0.1]],
    )  # fmt: skip
    plan = make_planner(engine="cpu").solve(problem, seed=0)
    assert plan.solved
    assert verify(problem, plan.controls).ok
    np.testing.assert_allclose(plan.trajectory.states[-1, 0, 3:], [0.2, -0.1], atol=0.01)


def test_they_come_back_from_a_file_to_the_bit(tmp_path: Path) -> None:
    problem = problem_of()
    save_problem(problem, tmp_path / "problem.yaml")
    loaded = load_problem(tmp_path / "problem.yaml")
    assert loaded == problem
    np.testing.assert_array_equal(loaded.goal_hitches, problem.goal_hitches)


def test_they_belong_to_a_problem() -> None:
    problem, other = problem_of(), problem_of([[0.2, np.nan, np.nan], [np.nan] * 3])
    assert problem != other
    assert problem != problem_of(None)
    assert problem_of(None).digest == problem_of(np.full((2, 3), np.nan)).digest
    np.testing.assert_array_equal(problem.select([1, 0]).goal_hitches[1], problem.goal_hitches[0])
    assert problem.replace(margin=0.01).replace(margin=problem.margin) == problem


@pytest.mark.parametrize(
    ("hitches", "heading", "message"),
    [
        (
            [[0.1, 0.2, np.nan], [np.nan] * 3],
            0.0,
            "robot_0 gives 0.2 rad for trailer 2, and a car_with_1_trailer pulls 1",
        ),
        ([[np.nan] * 3, [0.1, np.nan, np.nan]], 0.0, "robot_1 gives 0.1 rad for trailer 1, and a unicycle pulls 0"),
        ([[0.8, np.nan, np.nan], [np.nan] * 3], 0.0, "gives 0.8 rad for trailer 1; it must be at most its largest"),
        ([[0.1, np.nan, np.nan], [np.nan] * 3], np.nan, "gives 0.1 rad for trailer 1, and no goal_heading; give both"),
        ([0.1, 0.2], 0.0, r"goal_hitches has shape (2,); expected (2, trailers), NaN for any"),
        ([["a"], ["b"]], 0.0, "goal_hitches must be numbers, a row per robot, not [['a'], ['b']]; it does not"),
    ],
)
def test_what_does_not_fit_is_refused(hitches: Any, heading: float, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        problem_of(hitches, goal_heading=[heading, np.nan])


def test_the_functional_environment_agrees() -> None:
    """Problems whose numbers are traced have them too."""
    from d4orm_env import functional

    problem, controls = problem_of(), np.zeros((2, 2), np.float32)
    state = functional.reset(problem, jax.random.PRNGKey(0))
    for _ in range(2):
        state = functional.step(problem, state, controls)[0]
    assert state.arrived.tolist() == [True, True]


@pytest.mark.parametrize("hitches", [None, [[0.0, np.nan]], [[0.7, 0.0]]])
def test_a_goal_whose_trailers_stand_in_something_is_refused(hitches: Any) -> None:
    """Where it says how all stand: in line, the second one would be in the box."""
    team = Team(("car_with_2_trailers",), footprint=Train(Box(0.4, 0.2), [Box(0.3, 0.2)] * 2))
    back = -team.limits[0, [column for _, column in team.robot_models[0].trailers]].sum()
    world = World(boxes=[[back - 0.1, -0.2, back + 0.1, 0.2]])
    poses = {"world": world, "goal_heading": 0.0, "horizon": 3}
    Problem(team, [[0, 3, 0, 0, 0]], [[0, 0]], goal_hitches=hitches, **poses)
    with pytest.raises(ValueError, match=r"goal of robot_0 at \(0, 0\) is .* m inside an obstacle"):
        Problem(team, [[0, 3, 0, 0, 0]], [[0, 0]], goal_hitches=[[0.0, 0.0]], **poses)


@pytest.mark.parametrize(
    ("box", "heading", "hitches", "refused"),
    [
        ([1, -1, 1.2, 1], 0.0, None, True),  # a wall across behind the car
        ([1, -1, 1.2, 1], np.nan, None, False),
        ([1, -1, 1.2, 1], 1.5, None, False),
        ([1, -0.1, 1.2, 0.1], 0.0, None, False),  # bent it goes by
        ([0.75, -1, 0.85, 1], 0.0, [[np.nan, np.nan]], False),  # in reach of the second trailer only
        ([0.75, -1, 0.85, 1], 0.0, [[0.0, np.nan]], True),  # given the first, the second
    ],
)
def test_a_goal_whose_trailer_stands_in_something_at_every_hitch_angle_is_refused(
    box: list[float], heading: float, hitches: Any, refused: bool
) -> None:
    count, model = (2, "car_with_2_trailers") if hitches else (1, "car_with_1_trailer")
    team = Team((model,), footprint=Train(Box(0.5, 0.25), [Box(0.3, 0.25)] * count))
    world = World(boxes=[box], lower=[-2, -2], upper=[3, 3])
    poses = {"goal_heading": heading, "goal_hitches": hitches, "horizon": 3, "margin": 0.0}
    start = [[-0.3, -1.5, 0] + [0] * count]
    if refused:
        message = r"goal of robot_0 at \(1.7, 0\) has trailer \d 0.\d+ m or more inside .* at every hitch angle"
        with pytest.raises(ValueError, match=message):
            Problem(team, start, [[1.7, 0]], world, **poses)
    else:
        Problem(team, start, [[1.7, 0]], world, **poses)
