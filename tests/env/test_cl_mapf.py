"""Problems of cars as CL-CBS and CSDO write them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d4orm_env import load_problem, rollout, verify
from d4orm_env.footprints import Box
from d4orm_env.scenarios import load_cl_mapf
from d4orm_planners import make_planner

EXAMPLE = Path(__file__).parents[2] / "examples" / "scenarios" / "cl_mapf_cars.yaml"


@pytest.fixture
def instance(tmp_path: Path) -> Path:
    path = tmp_path / "cars.yaml"
    path.write_text(EXAMPLE.read_text())
    return path


def test_an_instance_means_what_it_says() -> None:
    problem = load_cl_mapf(EXAMPLE)
    assert load_problem(EXAMPLE) == problem
    assert problem.name == "cl_mapf_cars"
    assert problem.team.models == ("car_first_order",) * 4
    assert set(problem.team.footprint) == {Box(3.0, 2.0, offset=0.5)}
    np.testing.assert_allclose(problem.start[1], [25, 14, 3.14], rtol=1e-6)
    np.testing.assert_allclose(problem.goal[3], [6, 20], rtol=1e-6)
    np.testing.assert_allclose(problem.goal_heading, [0, 1.57, -1.57, 3.14], rtol=1e-6)
    np.testing.assert_allclose(problem.world.circles, [[10, 15, 0.8], [20, 15, 0.8]], rtol=1e-6)
    np.testing.assert_allclose(problem.world.bounds, [[-0.01, -0.01], [30.01, 30.01]], rtol=1e-6)
    assert (problem.arrival, problem.margin, problem.dt) == ("stay", 0.0, 0.25)


def test_headings_may_turn_clockwise_as_those_of_cl_cbs() -> None:
    usual, mirrored = load_cl_mapf(EXAMPLE), load_cl_mapf(EXAMPLE, clockwise=True)
    np.testing.assert_array_equal(mirrored.start[:, 2], -usual.start[:, 2])
    np.testing.assert_array_equal(mirrored.goal_heading, -usual.goal_heading)
    np.testing.assert_array_equal(mirrored.goal, usual.goal)


def test_cars_turn_in_circles_of_the_given_radius() -> None:
    problem = load_cl_mapf(EXAMPLE, vehicle={"r": 4.0})
    controls = np.tile(np.array([1.0, 3.0], np.float32), (problem.horizon, 4, 1))  # wheels as far as they turn
    turned = rollout(problem, controls).states[4, 0, 2] - problem.start[0, 2]
    assert turned == pytest.approx(4 * problem.dt / 4.0, rel=1e-5)


def test_cars_meet_their_goal_poses() -> None:
    problem = load_cl_mapf(EXAMPLE)
    plan = make_planner().solve(problem, seed=0, time_limit=60)
    assert plan.solved
    assert verify(problem, plan.controls).ok
    missed = plan.trajectory.states[-1, :, 2] - problem.goal_heading
    assert np.abs((missed + np.pi) % (2 * np.pi) - np.pi).max() <= 0.05


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("start:", "begin:", "is no problem of CL-CBS or CSDO (it lacks 'start'); it has agents: start, goal; map"),
        ("map:", "maps:", "is no problem of CL-CBS or CSDO (it lacks 'map'); it has agents: start, goal; map"),
        ("obstacles:", "obstacle:", "map has the key 'obstacle'; did you mean 'obstacles'?"),
        ("dimensions: [30, 30]", "dimensions: [30]", "dimensions of map is [30]; it must have numbers, 2 of them"),
        ("goal: [25, 10, 0]", "goal: [25, 10]", "goal of robot_0 is [25, 10]; it must have numbers, 3 of them"),
        ("goal: [25, 10, 0]", "goal: [25, 10, ~]", "goal of robot_0 is [25, 10, None]; all must be numbers of at most"),
        (
            "start: [5, 10, 0]",
            "start: [.inf, 10, 0]",
            "start of robot_0 is [inf, 10, 0]; all must be numbers of at most",
        ),
        ("[10, 15]", "[10, left]", "obstacle 0 is [10, 'left']; it must be a list of numbers"),
        ("[10, 15]", "[10, 15, 1, 1]", "obstacle 0 is [10.0, 15.0, 1.0, 1.0]; it must have numbers, 2 or 3 of them"),
        ("start: [5, 10, 0]", "start: [0, 10, 0]", "start of robot_0 at (0, 10) is 0.99 m inside an obstacle"),
    ],
)
def test_what_is_wrong_is_told(instance: Path, old: str, new: str, message: str) -> None:
    instance.write_text(instance.read_text().replace(old, new))
    with pytest.raises(ValueError, match=rf"^{re.escape(str(instance))}: .*{re.escape(message)}"):
        load_problem(instance)


@pytest.mark.parametrize(
    ("vehicle", "message"),
    [
        (
            {"carwidth": 2.0},
            "vehicle's entry 'carwidth' is unknown; choose one of r, carWidth, LF, LB, obs",
        ),
        ({"LF": -2.0}, "LF of vehicle is -2; it must be positive"),
        ({"r": "wide"}, "r of vehicle must be a number, not 'wide'"),
        ([3.0], r"vehicle must be a mapping such as {'r': 3.0}, not \[3.0\]"),
    ],
)
def test_entries_of_a_vehicle_are_checked(vehicle: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_cl_mapf(EXAMPLE, vehicle=vehicle)
    with pytest.raises(ValueError, match="clockwise is 'no'; it must be True or False"):
        load_cl_mapf(EXAMPLE, clockwise="no")  # type: ignore[arg-type]
