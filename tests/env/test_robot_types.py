"""Robots by name, and scenarios above the floor."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d4orm_env import Problem, Team, load_problem, make_problem, make_team, navigation_v0, save_problem
from d4orm_env.core.problem_checks import check_physics
from d4orm_env.core.robot_types import ROBOTS
from d4orm_env.disturbances import Lag
from d4orm_env.footprints import Disc, Ellipsoid
from d4orm_planners import Controller, make_planner


@pytest.mark.parametrize("name", ROBOTS)
def test_a_team_of_robots_by_name(name: str) -> None:
    team, robot = make_team(name, 3), ROBOTS[name]
    assert team.models == (robot.model,) * 3
    for limit in ("max_speed", "max_acceleration", "max_turn_rate", "lag", "margin"):
        np.testing.assert_allclose(getattr(team, limit), getattr(robot, limit), rtol=1e-6)
    for size in (team.inner_radius, team.wall_radius, team.girth):
        np.testing.assert_allclose(size, robot.radius, rtol=1e-5)
    np.testing.assert_allclose(team.radius, max(robot.radius, robot.downwash))


@pytest.mark.parametrize(
    ("name", "radius"),
    [
        ("crazyflie", 0.07),
        ("crazyflie_brushless", 0.08),
        ("turtlebot3_burger", np.hypot(0.07 + 0.032, 0.07)),
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
    np.testing.assert_allclose(problem.team.wall_radius, ROBOTS[name].radius, rtol=1e-6)
    np.testing.assert_allclose(problem.goal_speed, ROBOTS[name].max_acceleration * problem.dt, rtol=1e-6)


def test_what_a_team_knows_its_problems_and_files_know(tmp_path: Path) -> None:
    team = make_team("turtlebot3_burger", 2)
    problem = Problem(team, [[0, 0, 0, 0], [1, 0, 0, 0]], [[1, 1], [0, 1]])
    assert problem.margin == ROBOTS["turtlebot3_burger"].margin
    assert Problem(team, problem.start, problem.goal, margin=0.0).margin == 0
    save_problem(problem, tmp_path / "team.yaml")
    assert load_problem(tmp_path / "team.yaml") == problem
    assert load_problem(tmp_path / "team.yaml").team == team
    assert problem != problem.replace(team=team.replace(lag=0.0))
    np.testing.assert_allclose(team.replace(lag=[0.0, 0.3]).select([1]).lag, 0.3)
    (tmp_path / "short.yaml").write_text("{version: 1, scenario: circle, robot: turtlebot3_burger, num_robots: 2}")
    np.testing.assert_allclose(load_problem(tmp_path / "short.yaml").team.lag, team.lag)


@pytest.mark.parametrize(("mode", "tracker"), [("nominal", False), ("measured", False), ("measured", True)])
def test_controllers_take_the_lag_of_the_team(mode: Any, tracker: bool) -> None:
    problem = make_problem("circle", robot="turtlebot3_burger", num_robots=2)
    for given, lag in ((None, 0.15), (0.3, 0.3), (0.0, 0.0)):
        controller = Controller("go-to-goal", mode=mode, tracker=tracker, lag=given)
        controller.begin(problem, problem.start)
        np.testing.assert_allclose(controller.lag, lag)
        assert controller.step(problem.start, 0.0).control.shape == problem.arrays.start[:, :2].shape


@pytest.mark.parametrize(("disturbances", "lag"), [((), 0.0), ((Lag(0.1), Lag(0.2)), 0.3)])
def test_controllers_in_an_environment_take_its_lag(disturbances: Any, lag: float) -> None:
    controller = Controller("go-to-goal")
    env = navigation_v0.parallel_env("circle", 2, robot="turtlebot3_burger", disturbances=disturbances)
    env.reset(seed=0)
    controller.reset(env)
    np.testing.assert_allclose(controller.lag, lag)


def test_drones_leave_room_for_their_downwash() -> None:
    team = make_team("crazyflie", 2)
    assert team == make_team("crazyflie", 2, downwash=True)
    assert team == make_problem("circle", 2, robot="crazyflie", height=1.0).team
    drone = ROBOTS["crazyflie"]
    assert team.footprint == (Ellipsoid(drone.radius, drone.radius, drone.downwash, drone.radius),) * 2
    start, goal = np.zeros((2, 6)), np.zeros((2, 3))
    start[1, 2], goal[:, 0], goal[1, 2] = 0.49, 1.0, 0.49
    with pytest.raises(ValueError, match=r"robot_1 at .* overlap by"):
        Problem(team, start, goal)
    balls = make_team("crazyflie", 2, downwash=False)
    assert not balls.shapes
    Problem(balls, start, goal)
    with pytest.raises(ValueError, match="downwash is True, and this robot has none"):
        make_team("jackal", 2, downwash=True)
    with pytest.raises(ValueError, match="downwash is of robots by name; give robot"):
        make_problem("circle", 2, downwash=True)
    with pytest.raises(ValueError, match="downwash is 1; it must be True or False"):
        make_problem("circle", 2, robot="crazyflie", downwash=1)


def test_another_radius_is_that_of_the_body() -> None:
    team = make_problem("circle", 2, robot="crazyflie", radius=[0.1, 0.3], height=1.0).team
    assert team.footprint == (Ellipsoid(0.1, 0.1, 0.25, 0.1), Ellipsoid(0.3, 0.3, 0.3, 0.3))
    assert (
        make_problem("circle", 2, robot="crazyflie", footprint=Disc(0.2), height=1.0).team.radius.tolist()
        == [np.float32(0.2)] * 2
    )


@pytest.mark.parametrize("name", ["circle", "sphere", "random", "four_obstacles", "swap", "forest"])
def test_spatial_scenarios_have_room_for_twenty_drones(name: str) -> None:
    problem = make_problem(name, 20, robot="crazyflie", height=None if name == "sphere" else 1.0)
    assert not check_physics(problem)


def test_lags_that_make_no_sense_are_named() -> None:
    with pytest.raises(ValueError, match="lag of robot_1 is -1; it must be from 0 to 1e"):
        Team(("holonomic2d",) * 2, lag=[0.0, -1.0])
    with pytest.raises(ValueError, match=r"lag has shape \(3,\); expected one number, or \(2,\)"):
        make_problem("circle", num_robots=2, lag=[0.1] * 3)
    with pytest.raises(ValueError, match="margin is -1; it must be zero or more"):
        Team(("holonomic2d",), margin=-1)


def test_what_is_given_counts() -> None:
    problem = make_problem("circle", robot="jackal", num_robots=4, radius=0.4, margin=0.2, max_speed=1.0, lag=0.0)
    assert problem.margin == 0.2
    assert not problem.team.lag.any()
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
