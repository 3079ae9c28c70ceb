"""Goals with headings: who arrives, who does not, and what the judge says of it."""

from __future__ import annotations

import re

import numpy as np
import pytest
from engine_support import ENGINE_NAMES

from d4orm_env import Problem, Team, load_problem, navigation_v0, rollout, save_problem, verify
from d4orm_env.engine.choice import get_engine


def at_goal(heading: float, **settings: object) -> Problem:
    """A drive that stands at its goal."""
    return Problem(Team(("differential_drive",)), [[1, 1, heading, 0]], [[1, 1]], horizon=2, **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize(
    ("heading", "wanted", "arrives"),
    [(0.0, 0.05, True), (0.0, 0.15, False), (3.1, -3.1, True), (0.5, 0.5 - 2 * np.pi, True), (0.0, np.nan, True)],
)
def test_a_robot_arrives_at_its_goal_heading_only(engine: str, heading: float, wanted: float, arrives: bool) -> None:
    problem, still = at_goal(heading, goal_heading=wanted), np.zeros((2, 1, 2), np.float32)
    assert bool(get_engine(engine).rollout(problem, still).arrived[-1, 0]) == arrives
    report = verify(problem, still)
    assert report.ok == arrives
    if not arrives:
        assert "0.15 rad from its goal heading (tolerance 0.1 rad)" in report.violations[0].detail


def test_the_tolerance_is_each_robots_own() -> None:
    team = Team(("unicycle",) * 2)
    problem = Problem(
        team,
        [[0, 0, 0.2], [3, 0, 0.2]],
        [[0, 0], [3, 0]],
        goal_heading=0.0,
        goal_heading_tolerance=[0.1, 0.3],
        horizon=1,
    )
    assert rollout(problem, np.zeros((1, 2, 2), np.float32)).arrived[-1].tolist() == [False, True]
    assert problem.select([1]).goal_heading_tolerance == np.float32(0.3)


def test_files_keep_goal_headings(tmp_path: object) -> None:
    problem = Problem(Team(("unicycle",) * 2), [[0, 0, 0], [3, 0, 0]], [[0, 2], [3, 2]], goal_heading=[1.25, np.nan])
    save_problem(problem, f"{tmp_path}/problem.yaml")
    read = load_problem(f"{tmp_path}/problem.yaml")
    assert read == problem
    np.testing.assert_array_equal(read.goal_heading, problem.goal_heading)
    assert read != problem.replace(goal_heading=[1.5, np.nan])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"goal_heading": [0.0, 0.0]}, "goal_heading of robot_1 is 0, and a velocity2d has no heading; give NaN"),
        ({"goal_heading": "north"}, "goal_heading must be a number or one per robot, not 'north'"),
        ({"goal_heading": [0.0]}, "goal_heading has shape (1,); expected one number, or (2,), NaN for any"),
        ({"goal_heading": [90.0, np.nan]}, "90 rad; it must be at most 2 pi in magnitude, so give radians"),
        ({"goal_heading": [0.0, np.nan], "goal_heading_tolerance": 4.0}, "must be from 0.001 to pi"),
    ],
)
def test_what_is_wrong_is_told(settings: dict[str, object], message: str) -> None:
    team = Team(("unicycle", "velocity2d"))
    with pytest.raises(ValueError, match=re.escape(message)):
        Problem(team, [[0, 0, 0], [3, 0, 0]], [[0, 2], [3, 2]], **settings)  # type: ignore[arg-type]


def test_lifelong_goals_have_none() -> None:
    with pytest.raises(ValueError, match="lifelong mode draws goals without headings"):
        navigation_v0.parallel_env(problem=at_goal(0.0, goal_heading=1.0), lifelong=True)
