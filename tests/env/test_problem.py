"""Problems, teams and worlds: what they refuse and how they say it, equality, and that nobody changes them."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.engine.choice import rollout
from d4orm_env.footprints import Box
from d4orm_env.scenarios import load_problem, save_problem

NAN, INF = float("nan"), float("inf")


def two_robots(**changes: Any) -> Problem:
    """Two robots 2 m apart that swap places, a circle between them and walls around."""
    arguments: dict[str, Any] = {
        "team": Team(("holonomic2d", "velocity2d"), radius=[0.2, 0.3], max_speed=[1.0, 2.0]),
        "start": [[-1, 0, 0.5, 0], [1, 0, 0, 0]],
        "goal": [[1, 0], [-1, 0]],
        "world": World(2, circles=[[0, 1, 0.25]], boxes=[[-3, 2, 3, 3]], lower=[-4, -4], upper=[4, 4]),
    }
    return Problem(**arguments | changes)


def spatial(**changes: Any) -> Problem:
    world = World(3, spheres=[[0, 0, 1, 0.5]], cylinders=[[0, 3, 0.5]], boxes=[[5, 5, 5, 6, 6, 6]])
    arguments: dict[str, Any] = {
        "team": Team(("holonomic3d",)),
        "start": [[-1, 0, 0, 0, 0, 0]],
        "goal": [[1, 0, 0]],
        "world": world,
    }
    return Problem(**arguments | changes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"models": ()}, "a team needs at least one robot; models is empty"),
        ({"models": "holonomic2d"}, "models must be a sequence of model names, not 'holonomic2d'"),
        ({"models": 3}, "models must be a sequence of model names, not 3"),
        ({"models": ("holonomic2d", "boat")}, "model 'boat' is unknown; choose one of holonomic2d, holonomic3d"),
        ({"models": ("holonomic2d", "holonomic3d")}, r"\['holonomic2d', 'holonomic3d'\] mix 2D and 3D robots"),
        ({"radius": 0}, "radius of robot_0 is 0; it must be positive"),
        ({"radius": [0.1, -0.5]}, "radius of robot_1 is -0.5; it must be positive"),
        ({"radius": [0.1, NAN]}, r"radius\[1\] is nan; every value must be finite"),
        ({"radius": [0.1, 0.1, 0.1]}, r"radius has shape \(3,\); expected one number, or \(2,\)"),
        ({"radius": "wide"}, "radius must be a number or one per robot"),
        ({"max_speed": [1, 0]}, "max_speed of robot_1 is 0; it must be positive"),
        ({"max_speed": INF}, r"max_speed\[0\] is inf; every value must be finite"),
        ({"max_acceleration": -1}, "max_acceleration of robot_0 is -1; it must be positive"),
        ({"max_turn_rate": [1, -2]}, "max_turn_rate of robot_1 is -2; it must be positive"),
        ({"max_turn_rate": 1e39}, r"max_turn_rate\[0\] is inf; every value must be finite"),
        ({"max_acceleration": 1e30}, r"max_acceleration of robot_0 is 1e\+30; it must be from 1e-07 to 1e\+06"),
        ({"max_speed": [1, 1e-30]}, r"max_speed of robot_1 is 1e-30; it must be from 1e-07 to 1e\+06"),
        ({"radius": 10**400}, "radius must be a number or one per robot, .* whole number too large for a float"),
    ],
)
def test_bad_teams_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Team(**{"models": ("holonomic2d", "velocity2d")} | arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dimension": 4}, "dimension of the world is 4; it must be 2 or 3"),
        ({"dimension": 2.0}, "dimension of the world is 2.0; it must be 2 or 3"),
        ({"circles": [[0, 0]]}, r"circles has shape \(1, 2\); expected \(any, 3\)"),
        ({"circles": [0, 0, 1]}, r"circles has shape \(3,\); expected \(any, 3\)"),
        ({"circles": [[0, 0, 1], [0, 0, 0]]}, r"radius of circles\[1\] is 0; it must be positive"),
        ({"circles": [[0, NAN, 1]]}, r"circles\[0, 1\] is nan; every value must be finite"),
        ({"circles": [["left", 0, 1]]}, "circles must be an array of numbers"),
        ({"circles": [[1e30, 0, 1]]}, r"circles\[0, 0\] is 1e\+30; magnitudes must be at most 1e\+06"),
        ({"lower": [0, 0], "upper": [1, 1e7]}, r"bounds upper\[1\] is 1e\+07; magnitudes must be at most"),
        ({"circles": [[0, 0, 1], [0]]}, "circles must be an array of numbers"),
        ({"spheres": [[0, 0, 0, 1]]}, "spheres need a world of dimension 3, and this one has 2"),
        ({"cylinders": [[0, 0, 1]]}, "cylinders need a world of dimension 3, and this one has 2"),
        ({"dimension": 3, "circles": [[0, 0, 1]]}, "circles need a world of dimension 2, and this one has 3"),
        ({"dimension": 3, "spheres": [[0, 0, 0, -1]]}, r"radius of spheres\[0\] is -1; it must be positive"),
        ({"dimension": 3, "cylinders": [[0, 0, -1]]}, r"radius of cylinders\[0\] is -1; it must be positive"),
        ({"boxes": [[0, 0, 1, 1], [0, 1, 1, 1]]}, r"boxes\[1\] is .*; its lower corner must lie below its upper"),
        ({"dimension": 3, "boxes": [[0, 0, 1, 1]]}, r"boxes has shape \(1, 4\); expected \(any, 6\)"),
        ({"lower": [0, 0]}, "bounds need both lower and upper; give both, or neither for an open world"),
        ({"upper": [0, 0]}, "bounds need both lower and upper"),
        ({"lower": [0, 0], "upper": [1, 0]}, r"bounds lower \[0.0, 0.0\] must lie below upper \[1.0, 0.0\]"),
        ({"lower": [0, 0, 0], "upper": [1, 1, 1]}, r"bounds lower has shape \(3,\); expected \(2,\)"),
        ({"lower": [0, 0], "upper": [1, INF]}, r"bounds upper\[1\] is inf; every value must be finite"),
    ],
)
def test_bad_worlds_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        World(**arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start": [[0, 0, 0, 0]]}, r"start has shape \(1, 4\); expected \(2, 4\)"),
        ({"start": [[-1, 0], [1, 0]]}, r"start has shape \(2, 2\); expected \(2, 4\)"),
        ({"start": [[-1, NAN, 0, 0], [1, 0, 0, 0]]}, r"start\[0, 1\] is nan; every value must be finite"),
        ({"start": None}, "start must be an array of numbers|start has shape"),
        ({"goal": [[1, 0, 0], [-1, 0, 0]]}, r"goal has shape \(2, 3\); expected \(2, 2\)"),
        ({"goal": [[1, 0], [INF, 0]]}, r"goal\[1, 0\] is inf; every value must be finite"),
        (
            {"start": [[-1, 0, 0, 0], [1, 0, 0.5, 0]]},
            r"start of robot_1 is \[1.0, 0.0, 0.5, 0.0\]; a velocity2d has 2 components, so set the padding .* to zero",
        ),
        (
            {"start": [[-1, 0, 0.8, -0.8], [1, 0, 0, 0]]},
            "start speed of robot_0 is 1.13137 m/s, above its limit of 1 m/s",
        ),
        ({"dt": 0}, "dt is 0; it must be positive and finite"),
        ({"dt": -0.1}, "dt is -0.1; it must be positive and finite"),
        ({"dt": NAN}, "dt is nan; it must be positive and finite"),
        ({"dt": "soon"}, "dt must be a number, not 'soon'"),
        ({"dt": 1e4}, r"dt is 10000; it must be at most 1000"),
        ({"dt": 1e-50}, r"dt is 1e-50; it must be at least 1e-06"),
        ({"dt": 10**400}, r"dt is inf; it must be positive and finite"),
        ({"horizon": 100_000_000}, "horizon is 100000000; it must be at most 1000000"),
        ({"horizon": 10**5000}, "horizon is about 1e5000; it must be at most 1000000"),
        ({"margin": 1e7}, r"margin is 1e\+07; it must be at most 1e\+06"),
        ({"goal_radius": 1e-9}, "goal_radius is 1e-09; it must be at least 1e-07"),
        (
            {"goal_radius": 1e-5, "goal": [[1, 0], [-1, 0]]},
            r"robot_0 starts or ends at a coordinate of 1 m, where float32 resolves 1.2e-07 m, more than 1/100 of the "
            r"goal radius of 1e-05 m; move the problem nearer to the origin, or use a larger goal_radius",
        ),
        (
            {"world": None, "goal": [[1, 0], [1e4, 0]]},
            r"robot_1 .* coordinate of 10000 m, where float32 resolves 0.00098 m",
        ),
        ({"world": None, "goal": [[1, 0], [1e7, 0]]}, r"goal\[1, 0\] is 1e\+07; magnitudes must be at most 1e\+06"),
        (
            {"dt": 1e-6},
            "robot_0 .* moves at most 1e-06 m in a step of 1e-06 s; move .* or use a larger dt or max_speed",
        ),
        ({"goal": [[1, 0], [10**400, 0]]}, "goal must be an array of numbers, .* whole number too large for a float"),
        ({"horizon": 0}, "horizon is 0; it must be at least 1"),
        ({"horizon": 10.0}, "horizon must be a whole number, not 10.0"),
        ({"horizon": True}, "horizon must be a whole number, not True"),
        ({"margin": -0.01}, "margin is -0.01; it must be zero or more and finite"),
        ({"margin": INF}, "margin is inf; it must be zero or more and finite"),
        ({"goal_radius": 0}, "goal_radius is 0; it must be positive and finite"),
        ({"goal_speed": -1}, r"goal_speed of robot_0 is -1; it must be from 0 to 1e\+06, or inf for no limit"),
        ({"goal_speed": [0.1, 2e6]}, r"goal_speed of robot_1 is 2e\+06; it must be from 0 to 1e\+06"),
        ({"goal_speed": True}, "goal_speed must be a number or one per robot, not True"),
        ({"goal": [[1, 0], [True, 0]]}, r"goal must be .*, not \[\[1, 0\], \[True, 0\]\]; .* text and True are none"),
        ({"goal_speed": np.nan}, "goal_speed of robot_0 is nan"),
        ({"goal_speed": [0.1] * 3}, r"goal_speed has shape \(3,\); expected one number, or \(2,\)"),
        ({"goal_speed": "slow"}, "goal_speed must be a number or one per robot, not 'slow'"),
        ({"world": World(3)}, "the world has dimension 3 and the team 2; match them"),
        (
            {"start": [[-1, 0, 0, 0], [-0.6, 0.25, 0, 0]]},  # 0.4717 m apart, radii 0.2 and 0.3
            r"starts of robot_0 at \(-1, 0\) and robot_1 at \(-0.6, 0.25\) overlap by 0.0283 m; "
            r"move them more than 0.5 m apart",
        ),
        (
            {"goal": [[1, 0], [1, 0.3]]},
            r"goals of robot_0 at \(1, 0\) and robot_1 at \(1, 0.3\) overlap by 0.2 m; move them more than 0.5 m apart",
        ),
        (
            {"start": [[-1, 0, 0, 0], [0, 0.55, 0, 0]]},  # 0.45 from the circle's centre, radii 0.25 and 0.3
            r"start of robot_1 at \(0, 0.55\) is 0.1 m inside an obstacle or outside the bounds "
            r"\(robot radius 0.3 m\); move it, or change the world",
        ),
        ({"goal": [[1, 0], [-2, 1.75]]}, r"goal of robot_1 at \(-2, 1.75\) is 0.05 m inside an obstacle"),
        ({"goal": [[-3.85, 0], [-1, 0]]}, r"goal of robot_0 at \(-3.85, 0\) is 0.05 m inside .*outside the bounds"),
        ({"start": [[9, 0, 0, 0], [1, 0, 0, 0]]}, r"start of robot_0 at \(9, 0\) is 5.2 m inside .*outside the bounds"),
    ],
)
def test_bad_problems_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        two_robots(**changes)


@pytest.mark.parametrize(
    ("changes", "position"),
    [
        ({"start": [[0.1, 0, 0.5, 0, 0, 0]]}, "start of robot_0"),  # in the sphere
        ({"goal": [[0.1, 3, 70]]}, "goal of robot_0"),  # in the cylinder, however high
        ({"goal": [[5.5, 5.5, 6.1]]}, "goal of robot_0"),  # in the box
    ],
)
def test_positions_in_spatial_obstacles_are_refused(changes: dict[str, Any], position: str) -> None:
    with pytest.raises(ValueError, match=f"{position} .* inside an obstacle"):
        spatial(**changes)


def test_touching_counts_as_contact_and_just_beside_does_not() -> None:
    team = Team(("velocity2d",) * 2, radius=0.25)
    with pytest.raises(ValueError, match="overlap by 0 m"):
        Problem(team, [[0, 0], [0.5, 0]], [[0, 5], [5, 0]])
    beside = np.nextafter(np.float32(0.5), np.float32(1))
    assert Problem(team, [[0, 0], [beside, 0]], [[0, 5], [5, 0]]).num_robots == 2


def drive(**changes: Any) -> Problem:
    """One differential drive at 1 m/s."""
    limits = {"max_turn_rate": changes.pop("max_turn_rate", np.pi / 2)}
    return Problem(Team(("differential_drive",), **limits), [[0, 0, changes.pop("heading", 0), 0]], [[1, 0]], **changes)


def test_turns_that_one_step_of_rk4_does_not_follow_are_refused() -> None:
    # Half a turn in a step: Simpson's rule makes of 2/pi m sideways 2/3 m. A bound of its error is 0.034 m.
    with pytest.raises(
        ValueError, match=r"robot_0 may turn by 3.14 rad in a step of 1 s, .* be 0.034 m off .* smaller"
    ):
        drive(dt=1.0, max_turn_rate=np.pi)
    with pytest.raises(ValueError, match=r"robot_0 may turn by 6.28 rad in a step of 1 s"):
        drive(dt=1.0, max_turn_rate=6.28)
    assert drive(dt=1.0, max_turn_rate=2.3).dt == 1.0
    assert drive(dt=0.8).dt == 0.8
    # Other models do not turn.
    assert Problem(Team(("velocity2d",), max_turn_rate=9), [[0, 0]], [[1, 0]], dt=1.0).dt == 1.0


@pytest.mark.parametrize("factor", [0.5, 1.0])
def test_rk4_is_no_farther_off_than_the_bound_says(factor: float) -> None:
    turn_rate = factor * (0.01 * 2880) ** 0.25  # at 1 m/s and 1 s, the bound is 0.01 m for the whole of it
    problem = drive(dt=1.0, max_turn_rate=turn_rate * 0.999, horizon=1)
    problem = problem.replace(start=[[0, 0, 0, 1]])
    end = rollout(problem, np.array([[[turn_rate * 0.999, 0]]]), engine="cpu").positions[1, 0]
    angle = turn_rate * 0.999
    truth = np.array([np.sin(angle), 1 - np.cos(angle)]) / angle
    error = float(np.linalg.norm(end - truth))
    assert 0.7 * 0.01 * factor**4 < error <= 0.01 * factor**4


def test_headings_of_many_turns_are_refused() -> None:
    with pytest.raises(ValueError, match=r"start heading of robot_0 is 51 rad; it must be at most 50\.2655"):
        drive(heading=51)


def test_what_is_under_way_is_not_checked() -> None:
    problem = drive()
    coarse = problem.with_state(problem.start, problem.goal, dt=2.0, horizon=5)
    assert (coarse.dt, coarse.horizon) == (2.0, 5)


def test_within_the_margin_is_said_but_not_refused(tmp_path: Path) -> None:
    with pytest.warns(
        UserWarning,
        match=r"the start of robot_1 is 0.864 m from an obstacle or the bounds, and the margin is 5 m; move it",
    ):
        problem = two_robots(margin=5.0)
    save_problem(problem, tmp_path / "near.yaml")
    with pytest.warns(UserWarning, match=r"problem 'custom': the goal of robot_1 is 0.864 m from an obstacle"):
        assert load_problem(tmp_path / "near.yaml") == problem
    near = [[0, 0], [0.54, 0]]
    with pytest.warns(UserWarning, match=r"the goal of robot_1 is 0.04 m from robot_0, and the margin is 0.05 m"):
        two_robots(goal=near)
    with pytest.warns(UserWarning, match=r"the goal of robot_0 is 0.0\d+ m from an obstacle or the bounds"):
        two_robots(goal=[[0, 0], [1, 0]], world=World(circles=[[0, 0.42, 0.2]]))


def test_what_keeps_the_margin_warns_of_nothing(recwarn: pytest.WarningsRecorder) -> None:
    two_robots(goal=[[0, 0], [0.56, 0]])
    assert not recwarn.list


def test_a_start_speed_at_the_limit_is_allowed() -> None:
    assert two_robots(start=[[-1, 0, 0.6, -0.8], [1, 0, 0, 0]]).start[0, 3] == np.float32(-0.8)


@pytest.mark.parametrize(
    ("world", "point", "distance"),
    [
        (World(2), (3, 4), np.inf),
        (World(2, circles=[[0, 0, 1]]), (3, 4), 4.0),
        (World(2, circles=[[0, 0, 1], [3, 5, 0.5]]), (3, 4), 0.5),
        (World(2, circles=[[0, 0, 1]]), (0.25, 0), -0.75),
        (World(2, boxes=[[0, 0, 2, 1]]), (5, 5), 5.0),
        (World(2, boxes=[[0, 0, 2, 1]]), (1, 3), 2.0),
        (World(2, boxes=[[0, 0, 2, 1]]), (1.75, 0.5), -0.25),
        (World(2, lower=[-1, -2], upper=[3, 4]), (0.5, 3.5), 0.5),
        (World(2, lower=[-1, -2], upper=[3, 4]), (5, 0), -2.0),
        (World(3, spheres=[[0, 0, 0, 1]]), (2, 3, 6), 6.0),
        (World(3, cylinders=[[0, 0, 1]]), (3, 4, 99), 4.0),
        (World(3, boxes=[[0, 0, 0, 1, 1, 1]]), (3, 4, 7), 7.0),
        (World(3, lower=[-1] * 3, upper=[1] * 3), (0, 0, -0.75), 0.25),
    ],
)
def test_clearance(world: World, point: Any, distance: float) -> None:
    assert world.clearance(point) == pytest.approx(distance, abs=1e-12)
    assert world.clearance([[point, point]]).shape == (1, 2)


@pytest.mark.parametrize(
    ("world", "lowest", "highest"),
    [
        (World(2, circles=[[1, 2, 3]], boxes=[[5, 0, 6, 1]]), [-2, -1], [6, 5]),
        (World(3, spheres=[[1, 2, 3, 1]]), [0, 1, 2], [2, 3, 4]),
        (World(3, cylinders=[[4, -1, 0.5]]), [3.5, -1.5, 0], [4.5, -0.5, 0]),
        (World(3, cylinders=[[4, -1, 0.5]], lower=[-9, -8, -7], upper=[9, 8, 7]), [-9, -8, -7], [9, 8, 7]),
    ],
)
def test_a_world_reaches_as_far_as_its_obstacles_and_bounds(
    world: World, lowest: list[float], highest: list[float]
) -> None:
    points = np.concatenate(world.extremes())
    assert points.min(axis=0).tolist() == lowest
    assert points.max(axis=0).tolist() == highest


def test_key_figures_say_how_large_the_world_is() -> None:
    assert two_robots(world=World(boxes=[[-3, 2, 3, 3]], lower=[-4, -3], upper=[4, 5.5])).key_figures == [
        ("robots", "1 holonomic2d, 1 velocity2d"),
        ("world", "8 x 8.5 m, 1 obstacle"),
        ("time", "100 steps of 0.1 s"),
        ("margin", "0.05 m"),
        ("arrival", "dock"),
    ]
    assert dict(two_robots(world=None).key_figures)["world"] == "open, 0 obstacles"


def test_sizes_and_padding() -> None:
    problem = two_robots(dt=0.5, horizon=7)
    assert (problem.num_robots, problem.dimension, problem.state_size, problem.control_size) == (2, 2, 4, 2)
    assert problem.duration == 3.5
    assert problem.world.num_obstacles == 2
    assert (spatial().state_size, spatial().control_size, spatial().world.num_obstacles) == (6, 3, 3)
    assert problem.start.dtype == problem.goal.dtype == np.float32


def test_limits_of_a_mixed_team() -> None:
    team = Team(("velocity2d", "differential_drive", "holonomic2d"), 0.1, [1, 2, 3], [4, 5, 6], [7, 8, 9])
    assert team.limits[:, :3].tolist() == [[1, 4, 7], [2, 5, 8], [3, 6, 9]]
    assert team.control_limits.tolist() == [[1, 1], [8, 5], [6, 6]]
    assert team.radius.tolist() == [np.float32(0.1)] * 3


def test_lengths_are_measured_by_the_largest_radius() -> None:
    assert Team(("velocity2d",) * 2).largest_radius == 0.15
    assert Team(("velocity2d",) * 3, radius=[0.2, 0.6, 0.3]).largest_radius == pytest.approx(0.6, rel=1e-7)


def test_control_limits_are_zero_on_padding(monkeypatch: pytest.MonkeyPatch) -> None:
    # All planar models have two controls today; a model with one shows what padding means.
    from d4orm_env.dynamics import models as dynamics

    cart = dataclasses.replace(dynamics.MODELS["velocity2d"], name="cart", control_names=("v",), control_limits=(0,))
    for table in (dynamics.MODELS._registered, dynamics.MODELS._admitted):
        monkeypatch.setitem(table, "cart", cart)
    team = Team(("cart", "holonomic2d"), max_speed=2, max_acceleration=3)
    assert team.control_limits.tolist() == [[2, 0], [3, 3]]


def test_the_arrays_that_engines_read() -> None:
    arrays = two_robots(dt=0.6, margin=0.125, goal_radius=0.5, goal_speed=0.25).arrays
    assert arrays.model_codes.tolist() == [0, 2]
    np.testing.assert_allclose(arrays.time_step, [0.6, 0.3, 0.2, 0.1], rtol=1e-6)
    assert arrays.inverse_initial_distance.tolist() == [0.5, 0.5]
    assert arrays.boxes[0].tolist() == [0, 1, 0, 1, 0.25]
    assert arrays.docks
    assert arrays.bounds.tolist() == [[-4, -4], [4, 4]]
    assert (arrays.margin, arrays.squared_goal_radius) == (0.125, 0.25)
    np.testing.assert_allclose(arrays.squared_goal_speed, 0.0625, rtol=3e-3)  # with an allowance for rounding
    assert (arrays.squared_goal_speed > 0.0625).all()
    open_world = two_robots(world=None).arrays
    assert open_world.bounds.tolist() == [[-np.inf] * 2, [np.inf] * 2]
    assert spatial().arrays.boxes[0].tolist() == [0, 0, 1, 0, 0, 1, 0.5]
    assert not two_robots(arrival="stay").arrays.docks


def test_robots_arrive_at_what_they_brake_away_in_a_step() -> None:
    models = ("holonomic2d", "velocity2d", "differential_drive", "car", "holonomic2d_jerk")
    team = Team(models, max_acceleration=[1, 1, 2, 0.5, 1])
    start = np.zeros((5, team.state_size))
    start[:, 0] = np.arange(5)
    problem = Problem(team, start, start[:, :2] + [0, 2], dt=0.2)
    # The last one's jerk is 4 m/s^3: it comes to rest as its acceleration does.
    np.testing.assert_allclose(problem.goal_speed, [0.2, np.inf, 0.4, 0.1, 0.08], rtol=1e-6)
    assert problem.select([2, 0]).goal_speed.tolist() == problem.goal_speed[[2, 0]].tolist()
    assert problem.replace(goal_speed=np.inf).goal_speed.tolist() == [np.inf] * 5
    assert problem.replace(goal_speed=[0, 1, 2, np.inf, 3]).goal_speed.tolist() == [0, 1, 2, np.inf, 3]


CHANGES: list[dict[str, Any]] = [
    {"dt": 0.2},
    {"horizon": 99},
    {"margin": 0.06},
    {"goal_radius": 0.08},
    {"goal_speed": 1.0},
    {"goal_speed": 0.0},
    {"start": [[-1, 0, 0.4, 0], [1, 0, 0, 0]]},
    {"goal": [[1, 0.1], [-1, 0]]},
    {"world": World(2, circles=[[0, 1, 0.25]], boxes=[[-3, 2, 3, 3]])},
    {"world": World(2, circles=[[0, 1, 0.25]], lower=[-4, -4], upper=[4, 4])},
    {"world": two_robots().world.replace(origin=[5, 0])},
    {"world": two_robots().world.replace(origin=[0, 5])},
    {"team": Team(("holonomic2d", "holonomic2d"), radius=[0.2, 0.3], max_speed=[1.0, 2.0])},
    {"team": Team(("holonomic2d", "velocity2d"), radius=[0.2, 0.3], max_speed=[1.0, 2.5])},
    {"team": Team(("holonomic2d", "velocity2d"), radius=[0.2, 0.3], max_speed=[1.0, 2.0], max_turn_rate=1)},
]


def test_every_number_counts_for_equality_and_the_name_does_not() -> None:
    problem = two_robots()
    assert problem == two_robots(name="another name")
    assert hash(problem) == hash(two_robots(name="another name"))
    variants = [two_robots(**change) for change in CHANGES]
    digests = {problem.digest, *(variant.digest for variant in variants)}
    assert len(digests) == len(CHANGES) + 1
    assert all(variant != problem for variant in variants)
    assert problem != "a problem"


def test_the_digest_is_the_same_in_every_process_and_version() -> None:
    # Stored results refer to problems by it, so it may only change with the meaning of a problem.
    assert two_robots(goal_speed=INF).digest == "f7d426ccffe074df2122424b3033fd6e85953102e5b9a89ff6cbd5ce3d8e2d4c"
    assert (
        spatial().replace(goal_speed=INF).digest == "939ec92781f3fc6f1ce7178fbc71a614d0a55e9403a986f9c1b5b35ed136cef0"
    )


def test_minus_zero_is_zero() -> None:
    assert two_robots(start=[[-1, -0.0, 0.5, 0], [1, 0, 0, -0.0]]) == two_robots()


def test_replace_checks_again_and_keeps_the_rest() -> None:
    problem = two_robots(dt=0.3, name="pair")
    changed = problem.replace(horizon=5)
    assert (changed.horizon, changed.dt, changed.name) == (5, 0.3, "pair")
    assert problem.horizon == 100
    with pytest.raises(ValueError, match="horizon is 0"):
        problem.replace(horizon=0)


def test_worlds_and_teams_are_replaced_alike() -> None:
    problem = two_robots()
    world, team = problem.world.replace(circles=[[0, 2, 0.5]]), problem.team.replace(radius=0.1)
    assert world.circles.tolist() == [[0, 2, 0.5]]
    assert (world.boxes.tolist(), world.upper.tolist()) == (problem.world.boxes.tolist(), [4, 4])
    np.testing.assert_array_equal(team.radius, np.float32([0.1, 0.1]))
    np.testing.assert_array_equal(team.limits, problem.team.limits)
    with pytest.raises(ValueError, match=r"radius of circles\[0\] is -1; it must be positive"):
        problem.world.replace(circles=[[0, 2, -1]])
    with pytest.raises(TypeError, match="circle"):
        problem.world.replace(circle=[])


def test_select_takes_robots_in_the_order_given() -> None:
    problem = two_robots(margin=0.02)
    swapped = problem.select([1, 0])
    assert swapped.team.models == ("velocity2d", "holonomic2d")
    assert swapped.team.radius.tolist() == [np.float32(0.3), np.float32(0.2)]
    assert swapped.goal.tolist() == [[-1, 0], [1, 0]]
    assert swapped.start.tolist() == [[1, 0, 0, 0], [-1, 0, 0.5, 0]]
    assert swapped.margin == 0.02
    assert swapped.select([1, 0]) == problem
    # Alone, a first-order robot needs no padding.
    assert problem.select([1]).start.tolist() == [[1, 0]]
    for wrong, message in (([], "models is empty"), ([2], "robot is 2; it must be at most 1"), ([1.5], "not 1.5")):
        with pytest.raises(ValueError, match=message):
            problem.select(wrong)  # type: ignore[arg-type]


def all_arrays(problem: Problem) -> list[np.ndarray]:
    owners = (problem, problem.team, problem.world)
    values = [getattr(owner, field.name) for owner in owners for field in dataclasses.fields(owner)]
    return [value for value in values if isinstance(value, np.ndarray)]


@pytest.mark.parametrize(
    "duplicate", [lambda problem: problem, copy.copy, copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))]
)
def test_copies_are_equal_and_as_read_only_as_the_original(duplicate: Any) -> None:
    problem = two_robots()
    assert problem.arrays is problem.arrays
    twin = duplicate(problem)
    assert len(all_arrays(twin)) == 18
    for array in all_arrays(twin):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    for array in twin.arrays:
        if isinstance(array, np.ndarray) and array.ndim:
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
    assert twin == problem
    assert twin.name == problem.name
    assert (twin.team, twin.world) == (problem.team, problem.world)
    assert {twin.team, twin.world} == {problem.team, problem.world}


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Team(["car"]), Team(["car"], own_limits={"wheelbase": 0.4})),
        (Team(["holonomic2d"]), Team(["holonomic2d"] * 2)),
        (Team(["holonomic2d"]), Team(["holonomic2d"], footprint=Box(0.5, 0.25))),
        (World(), World(3)),
        (World(), World(lower=(-1, -1), upper=(1, 1))),
        (World(circles=[(0, 0, 1)]), World(circles=[(0, 0, 2)])),
        (World(polygons=[[(0, 0), (1, 0), (0, 1)]]), World(polygons=[[(0, 0), (1, 0), (0, 2)]])),
        (World(), World(origin=(5, 0))),
    ],
)
def test_teams_and_worlds_are_equal_by_value(one: Team | World, other: Team | World) -> None:
    assert one == one.replace()
    assert hash(one) == hash(one.replace())
    assert one != other
    assert one != 3


def test_nothing_can_be_reassigned() -> None:
    problem = two_robots()
    for owner, name in ((problem, "dt"), (problem.team, "radius"), (problem.world, "circles")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(owner, name, 1)


def test_the_callers_arrays_are_not_frozen_or_shared() -> None:
    goal = np.array([[1.0, 0.0], [-1.0, 0.0]], np.float32)
    problem = two_robots(goal=goal)
    goal[0, 0] = 2
    assert problem.goal[0, 0] == 1


def test_models_are_kept_as_they_were_given() -> None:
    models = ["holonomic2d", "velocity2d"]
    team = Team(models)
    models.reverse()
    assert team.models == ("holonomic2d", "velocity2d")
