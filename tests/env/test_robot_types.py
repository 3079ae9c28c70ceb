"""Robots by name, and scenarios above the floor."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from d4orm_env import make_problem, make_team
from d4orm_env.core.robot_types import ROBOTS
from d4orm_planners import make_planner


@pytest.mark.parametrize("name", ROBOTS)
def test_a_team_of_robots_by_name(name: str) -> None:
    team, robot = make_team(name, 3), ROBOTS[name]
    assert team.models == (robot.model,) * 3
    for limit in ("radius", "max_speed", "max_acceleration", "max_turn_rate"):
        np.testing.assert_allclose(getattr(team, limit), getattr(robot, limit), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "radius"),
    [
        ("crazyflie", 0.07),
        ("crazyflie_brushless", 0.08),
        ("turtlebot3_burger", 0.105),
        ("robomaster", np.hypot(0.32, 0.24) / 2),
        ("jackal", np.hypot(0.508, 0.43) / 2),
    ],
)
def test_robots_are_as_large_as_their_makers_say(name: str, radius: float) -> None:
    assert ROBOTS[name].radius == pytest.approx(radius, abs=5e-4)


@pytest.mark.parametrize("name", ROBOTS)
def test_sources_name_attributes(name: str) -> None:
    robot = ROBOTS[name]
    known = {field.name for field in fields(robot)}
    assert set(robot.sources) <= known
    assert {"radius", "max_speed", "max_acceleration", "margin", "lag"} <= set(robot.sources)


@pytest.mark.parametrize("name", ROBOTS)
def test_scenarios_take_robots_by_name(name: str) -> None:
    problem = make_problem("circle", robot=name, num_robots=4)
    assert set(problem.team.models) == {ROBOTS[name].model}
    assert problem.margin == ROBOTS[name].margin
    np.testing.assert_allclose(problem.team.radius, ROBOTS[name].radius, rtol=1e-6)
    np.testing.assert_allclose(problem.goal_speed, ROBOTS[name].max_acceleration * problem.dt, rtol=1e-6)


def test_what_is_given_counts() -> None:
    problem = make_problem("circle", robot="jackal", num_robots=4, radius=0.4, margin=0.2, max_speed=1.0)
    assert problem.margin == 0.2
    np.testing.assert_allclose(problem.team.radius, 0.4)
    np.testing.assert_allclose(problem.team.max_speed, 1.0)


def test_a_robot_that_nobody_knows_is_refused() -> None:
    with pytest.raises(ValueError, match="robot 'roomba' is unknown; choose one of crazyflie, "):
        make_team("roomba", 2)
    with pytest.raises(ValueError, match="robot 3 is unknown"):
        make_problem("circle", robot=3)
    with pytest.raises(ValueError, match="num_robots is 0"):
        make_team("jackal", 0)


@pytest.mark.parametrize("scenario", ["circle", "sphere", "random", "swap", "four_obstacles", "forest"])
def test_spatial_scenarios_stand_above_the_floor(scenario: str) -> None:
    settings = {"num_robots": 4, "model": "holonomic3d", "num_obstacles": 1}
    low, high = make_problem(scenario, **settings), make_problem(scenario, height=2.0, **settings)
    positions = np.concatenate([high.start[:, :3], high.goal])
    assert positions[:, 2].min() == pytest.approx(2.0)
    lift = high.goal[0] - low.goal[0]
    np.testing.assert_allclose(lift[:2], 0, atol=1e-6)
    np.testing.assert_allclose(high.start[:, :3] - low.start[:, :3], np.broadcast_to(lift, (4, 3)), atol=1e-6)
    assert high.world.bounds[0, 2] == max(low.world.bounds[0, 2] + lift[2], 0), "the floor"
    if np.isfinite(low.world.bounds).all():
        np.testing.assert_allclose(high.world.bounds[1], low.world.bounds[1] + lift, atol=1e-6)


@pytest.mark.parametrize("scenario", ["circle", "swap", "forest"])
def test_robots_that_stand_above_the_floor_are_planned_to_stay_there(scenario: str) -> None:
    problem = make_problem(scenario, num_robots=6, robot="crazyflie", height=0.3)
    plan = make_planner().solve(problem, seed=0)
    assert plan.verified
    assert (plan.trajectory.positions[..., 2] > problem.team.radius).all()


def test_too_low_a_height_is_refused() -> None:
    with pytest.raises(ValueError, match=r"robot_0 at \(2.5, 0, 0.1\) is 0.1 m inside .* floor.*use a larger height"):
        make_problem("circle", num_robots=4, robot="crazyflie", height=0.1)
    assert make_problem("circle", num_robots=4, robot="crazyflie", height=1.0, bounds=0.5).world.bounds[0, 2] == 0.5


def test_robots_of_the_plane_have_no_height() -> None:
    with pytest.raises(ValueError, match="height is 1 and the robots move in the plane"):
        make_problem("circle", height=1.0)
    with pytest.raises(ValueError, match="height is -1"):
        make_problem("sphere", height=-1.0)
