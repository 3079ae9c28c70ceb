"""verify() finds every planted fault, passes clean plans, and gives the numbers computed by hand."""

from __future__ import annotations

import ast
import importlib
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from engine_support import PYTHON_OPS
from hypothesis import given, settings
from hypothesis import strategies as st

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.transition import TimeStep
from d4orm_env.verify import VerificationReport, Violation, verify

verify_module = importlib.import_module("d4orm_env.verify")
CHORD = 3e-5  # what curves and chords may differ by, for a pair


def make(models, start, goal, *, world=None, limits=None, **settings):
    """A problem with states padded to the team's size."""
    team = Team(tuple(models), **(limits or {}))
    padded = np.zeros((team.num_robots, team.state_size))
    for robot, state in enumerate(start):
        padded[robot, : len(state)] = state
    return Problem(team, padded, goal, world=world, **({"goal_speed": math.inf} | settings))


def hold(problem, *controls):
    """Each robot's control, held over the whole horizon."""
    return np.tile(np.array(controls, float), (problem.horizon, 1, 1))


def kinds(report):
    return [violation.kind for violation in report.violations]


def there_and_back(world, *, axis=1, dimension=2):
    """One robot that in a single step of 1 s rises 0.25 m along an axis and comes back to where it started."""
    start, push = np.zeros(2 * dimension), np.zeros(dimension)
    start[dimension + axis], push[axis] = 1.0, -2.0
    model = f"holonomic{dimension}d"
    goal = [np.zeros(dimension)]
    problem = make([model], [start], goal, world=world, limits={"max_acceleration": 2.0}, dt=1.0, horizon=1)
    return verify(problem, hold(problem, push))


# Numbers computed by hand.


def test_straight_crossing_has_the_closest_approach_computed_by_hand():
    # The offset is (-1 + t, 1.5 - t): shortest at t = 1.25 s, between two steps, sqrt(1/8) m long.
    problem = make(["velocity2d"] * 2, [(-1, 0), (0, -1.5)], [(1, 0), (0, 0.5)], horizon=30)
    report = verify(problem, hold(problem, (1, 0), (0, 1)))
    assert report.ok
    assert report.violations == []
    assert report.min_separation == pytest.approx(math.sqrt(1 / 8) - 0.3, abs=1e-7)
    assert report.min_clearance == math.inf
    np.testing.assert_allclose(report.arrival_times, [2.0, 2.0])


def test_one_robot_in_an_open_world_is_infinitely_far_from_everything():
    problem = make(["velocity2d"], [(0, 0)], [(1, 0)], horizon=10)
    report = verify(problem, hold(problem, (1, 0)))
    assert report.ok
    assert report.min_separation == math.inf
    assert report.min_clearance == math.inf


def test_speed_limit_acts_at_the_end_of_each_step():
    # Half a metre in the first second, then 0.1 + 0.005 m a step: 1.425 m after nine more.
    problem = make(["holonomic2d"], [(0, 0, 0, 0)], [(1.5, 0)])
    assert verify(problem, hold(problem, (1, 0))).arrival_times == pytest.approx([1.9])
    # Coasting from the first second on it makes 0.1 m a step, and takes ten.
    coasting = hold(problem, (1, 0))
    coasting[10:] = 0
    assert verify(problem, coasting).arrival_times == pytest.approx([2.0])


def test_differential_drive_limits_its_speed_backwards_too():
    problem = make(["differential_drive"], [(0, 0, 0, 0)], [(-1.5, 0)])
    assert verify(problem, hold(problem, (0, -1))).arrival_times == pytest.approx([1.9])


def test_differential_drive_may_be_slower_backwards():
    # 0.125 m in the first half second, then 0.05 + 0.005 m a step: 1.445 m after twenty-four more.
    slow = Team(("differential_drive",), own_limits={"max_reverse_speed": 0.5})
    problem = make(["differential_drive"], [(0, 0, 0, 0)], [(-1.5, 0)], horizon=40).replace(team=slow)
    assert verify(problem, hold(problem, (0, -1))).arrival_times == pytest.approx([2.9])


def test_differential_drive_follows_its_circle():
    # A turn of pi/2 rad/s at 1 m/s is a circle of radius 2/pi around (0, 2/pi); x is largest at 1 s, inside a step.
    radius = 2 / math.pi
    circles = [[0, radius, 0.2]]
    start, goal = [(0, 0, 0, 1)], [(0, 2 * radius)]
    problem = make(["differential_drive"], start, goal, world=World(circles=circles), dt=0.4, horizon=5)
    report = verify(problem, hold(problem, (math.pi / 2, 0)))
    assert report.ok
    assert report.arrival_times == pytest.approx([2.0])
    assert report.min_clearance == pytest.approx(radius - 0.35, abs=CHORD)
    bounded = problem.replace(world=World(lower=(-5, -5), upper=(radius + 0.25, 5)))
    assert verify(bounded, hold(problem, (math.pi / 2, 0))).min_clearance == pytest.approx(0.1, abs=CHORD)


def test_clearance_in_space_to_a_sphere_and_an_endless_cylinder():
    start, goal = [(0, 0, 0, 0, 0, 1)], [(0, 0, 1)]
    for obstacles in ({"spheres": [[0.6, 0.8, 0.55, 0.5]]}, {"cylinders": [[0.6, 0.8, 0.5]]}):
        problem = make(["holonomic3d"], start, goal, world=World(dimension=3, **obstacles), horizon=10)
        report = verify(problem, hold(problem, (0, 0, 0)))
        assert report.ok
        assert report.min_clearance == pytest.approx(0.35, abs=1e-6)


@pytest.mark.parametrize("dt", [0.25, 1.0, 2.0])
def test_passing_the_corner_of_a_box(dt):
    # On the line x + y = 2.4 the corner (1, 1) is 0.4 / sqrt(2) away, at no round fraction of the way.
    world = World(boxes=[[0, 0, 1, 1]])
    problem = make(
        ["velocity2d"], [(0, 2.4)], [(1.9, 0.5)], world=world, limits={"max_speed": 2}, dt=dt, horizon=int(2 / dt)
    )
    report = verify(problem, hold(problem, (0.95, -0.95)))
    assert report.ok
    assert report.min_clearance == pytest.approx(0.4 / math.sqrt(2) - 0.15, abs=3e-7)


def test_distance_inside_a_box_is_negative():
    world = World(boxes=[[-0.5, -0.4, 0.5, 0.4]])
    problem = make(["velocity2d"], [(-2, 0.1)], [(2, 0.1)], world=world, limits={"max_speed": 8}, dt=1.0, horizon=1)
    report = verify(problem, hold(problem, (4, 0)))
    assert kinds(report) == ["obstacle contact"]
    assert report.min_clearance == pytest.approx(-0.3 - 0.15, abs=1e-6)


def test_a_docked_robot_stands_where_it_docked():
    # Robot 0 docks 0.05 m short of its goal and is no longer driven; robot 1 passes 0.5 m above that place.
    problem = make(["holonomic2d"] * 2, [(0, 0, 1, 0), (-1, 0.5, 1, 0)], [(1.05, 0), (3, 0.5)], horizon=50)
    controls = np.zeros((50, 2, 2))
    controls[10:, 0] = (0, 70)
    report = verify(problem, controls)
    assert report.ok
    np.testing.assert_allclose(report.arrival_times, [1.0, 4.0])
    assert report.min_separation == pytest.approx(0.2, abs=1e-6)


def test_only_the_time_until_all_have_docked_is_judged(monkeypatch):
    """Nobody waits for the horizon, but for who coasts to the goal: the second robot drifts there after its push."""
    problem = make(["holonomic2d"] * 2, [(0, 0), (0, 5)], [(0.1, 0), (1.5, 5)], goal_radius=0.1, dt=0.1, horizon=400)
    controls, judged, watched = np.zeros((400, 2, 2)), [], []
    controls[:2, :, 0] = 1.0
    motion, watch = verify_module.TeamMotion, verify_module.make_watches
    monkeypatch.setattr(verify_module, "TeamMotion", lambda *args: judged.append(len(args[1])) or motion(*args))
    monkeypatch.setattr(verify_module, "make_watches", lambda *args: watched.append(args[1]) or watch(*args))
    both = verify(problem, controls)
    assert both.ok
    assert judged == [3, 400]
    assert len(watched) == 1  # who has docked decides, before contacts are looked for
    first = problem.select([0])
    alone = verify(first, controls[:, :1])
    assert judged[2:] == [3]
    assert alone.arrival_times[0] == both.arrival_times[0]
    assert str(alone) == str(verify(first.replace(horizon=3), controls[:3, :1]))


def test_mixed_team_moves_as_its_robots_do_alone():
    models = ["differential_drive", "velocity2d", "holonomic2d"]
    start = [(0, 0, 0, 1), (0, 2), (0, 4, 0.5, 0)]
    goal = [(4 / math.pi, 4 / math.pi), (1.5, 2.4), (2, 4.1)]
    controls = np.array([[math.pi / 4, 0], [0.8, 0.2], [0.6, 0.05]])
    world = World(circles=[[1, 3, 0.3]])
    team = make(models, start, goal, world=world)
    report = verify(team, hold(team, *controls))
    alone = []
    for robot in range(3):
        single = team.select([robot])
        alone.append(verify(single, hold(single, controls[robot])))
    assert np.isfinite(report.arrival_times).all()
    np.testing.assert_array_equal(report.arrival_times, [one.arrival_times[0] for one in alone])
    assert report.min_clearance == pytest.approx(min(one.min_clearance for one in alone), abs=1e-9)


# Planted faults.


@pytest.mark.parametrize(("offset", "gap"), [(0.1, -0.1), (0.2, 0.1)])
def test_grazing_pass_between_two_steps(offset, gap):
    # At 10 m/s the robots swap sides within one step: 2 m apart before and after, twice the offset in between.
    start, goal = [(-1, offset), (1, -offset)], [(1, offset), (-1, -offset)]
    problem = make(["velocity2d"] * 2, start, goal, limits={"max_speed": 10}, dt=0.2, horizon=1)
    report = verify(problem, hold(problem, (10, 0), (-10, 0)))
    assert report.min_separation == pytest.approx(gap, abs=1e-6)
    assert report.ok == (gap > 0)
    if gap < 0:
        (violation,) = report.violations
        assert violation.kind == "robot contact"
        assert violation.robots == (0, 1)
        assert violation.time == pytest.approx(0.1, abs=0.02)
        assert "-0.1 m at 0.100 s" in violation.detail


@pytest.mark.parametrize(
    ("kind", "robots", "circles", "boxes"),
    [
        ("robot contact", [(0, 0.2)], [], []),
        ("obstacle contact", [], [[0, 0.25, 0.2]], []),
        ("obstacle contact", [], [], [[-0.1, 0.05, 0.1, 1]]),
    ],
)
def test_a_hit_between_steps_is_found_though_others_are_nearer_at_every_step(kind, robots, circles, boxes):
    # Robots 1 and 2 stand 0.5 m from each other, from a circle and from a box. Robot 0 shoots 6 m in one step.
    world = World(circles=[[6.65, 0, 0.2], *circles], boxes=[[4.15, -1, 4.35, 1], *boxes])
    standing = [(5, 0), (5.8, 0), *robots]
    start, goal = [(-3, 0), *standing], [(3, 0), *standing]
    problem = make(["velocity2d"] * len(start), start, goal, world=world, limits={"max_speed": 6}, dt=1.0, horizon=1)
    report = verify(problem, hold(problem, (6, 0), *[(0, 0)] * len(standing)))
    assert kinds(report) == [kind]
    smallest = report.min_separation if robots else report.min_clearance
    assert smallest == pytest.approx(-0.1, abs=1e-6)


@pytest.mark.parametrize(
    "obstacle", [{"circles": [[0, 0.55, 0.2]]}, {"boxes": [[-0.1, 0.35, 0.1, 0.7]]}, {"boxes": [[0.0, 0.35, 9, 0.7]]}]
)
def test_planar_obstacle_hit_between_steps(obstacle):
    report = there_and_back(World(**obstacle))
    assert kinds(report) == ["obstacle contact"]
    assert next(iter(obstacle)) + "[0]" in str(report.violations[0])
    assert report.violations[0].time == pytest.approx(0.5, abs=0.25)
    assert report.min_clearance == pytest.approx(-0.05, abs=CHORD)


@pytest.mark.parametrize(
    ("obstacle", "axis"),
    [
        ({"spheres": [[0, 0, 0.55, 0.2]]}, 2),
        ({"cylinders": [[0, 0.55, 0.2]]}, 1),
        ({"boxes": [[-0.1, -0.1, 0.35, 0.1, 0.1, 0.7]]}, 2),
    ],
)
def test_spatial_obstacle_hit_between_steps(obstacle, axis):
    report = there_and_back(World(dimension=3, **obstacle), axis=axis, dimension=3)
    assert kinds(report) == ["obstacle contact"]
    assert next(iter(obstacle)) + "[0]" in str(report.violations[0])
    assert report.min_clearance == pytest.approx(-0.05, abs=CHORD)


def test_obstacles_just_out_of_reach_are_not_hit():
    world = World(circles=[[0, 0.65, 0.2]], boxes=[[-0.1, -0.5, 0.1, -0.2]], lower=(-1, -1), upper=(1, 0.45))
    report = there_and_back(world)
    assert report.ok
    assert report.min_clearance == pytest.approx(0.05, abs=CHORD)


def test_bounds_left_between_steps():
    report = there_and_back(World(lower=(-1, -1), upper=(1, 0.3)))
    assert kinds(report) == ["bounds contact"]
    assert "upper bound of y" in str(report.violations[0])
    assert report.min_clearance == pytest.approx(-0.1, abs=CHORD)


def test_leaving_through_a_corner_names_both_sides():
    world = World(lower=(-1, -1), upper=(1, 1))
    problem = make(["velocity2d"], [(0, 0)], [(-0.5, -0.5)], world=world, limits={"max_speed": 2}, horizon=20)
    report = verify(problem, hold(problem, (1, 1)))
    assert kinds(report) == ["bounds contact", "bounds contact", "not arrived"]
    assert {violation.detail.split(",")[0] for violation in report.violations[:2]} == {
        "touches the upper bound of x",
        "touches the upper bound of y",
    }


@pytest.mark.parametrize(
    ("model", "within", "over", "quantity", "value"),
    [
        ("holonomic2d", (0.6, 0.8), (0.8, 0.9), "acceleration", "1.204159"),
        ("holonomic3d", (0.48, 0.6, 0.64), (0.6, 0.6, 0.6), "acceleration", "1.03923"),
        ("velocity2d", (0.6, 0.8), (0.8, 0.9), "speed", "1.204159"),
        ("differential_drive", (math.pi / 2, 1), (1.7, 1), "turn rate", "1.7"),
        ("differential_drive", (-math.pi / 2, -1), (1, -1.1), "acceleration", "1.1"),
    ],
)
def test_control_over_its_limit(model, within, over, quantity, value):
    dimension = len(within)
    start, goal = [np.zeros(dimension), np.full(dimension, 3)], [np.full(dimension, -9), np.full(dimension, 9)]
    problem = make([model] * 2, start, goal, horizon=6)
    controls = np.float32(hold(problem, within, within))
    assert kinds(verify(problem, controls)) == ["not arrived"] * 2
    controls[4, 1] = over
    violation = verify(problem, controls).violations[0]
    assert (violation.kind, violation.robots) == ("control limit", (1,))
    assert violation.time == pytest.approx(0.4)
    assert quantity in violation.detail
    assert f"is {value}" in violation.detail
    assert "step 4" in violation.detail
    assert "limit 1" in violation.detail


def test_controls_are_clipped_before_they_are_executed():
    problem = make(["velocity2d", "holonomic2d"], [(0, 0), (0, 1)], [(2, 0), (1.5, 1)])
    report = verify(problem, hold(problem, (3, 0), (1e200, 0)))
    assert kinds(report) == ["control limit"] * 2
    np.testing.assert_allclose(report.arrival_times, [2.0, 1.9])


def test_differential_drive_may_use_both_limits_at_once_and_is_clipped_by_component():
    problem = make(["differential_drive"], [(0, 0, 0, 0)], [(1.5, 0)])
    report = verify(problem, hold(problem, (0, 50)))
    assert kinds(report) == ["control limit"]
    assert report.arrival_times == pytest.approx([1.9])


def test_arrival_one_step_after_the_horizon_is_late():
    problem = make(["velocity2d"] * 2, [(0, 0), (0, 1)], [(2, 0), (1, 1)], horizon=20)
    assert verify(problem, hold(problem, (1, 0), (1, 0))).ok
    shorter = problem.replace(horizon=19)
    report = verify(shorter, hold(shorter, (1, 0), (1, 0)))
    assert kinds(report) == ["not arrived"]
    assert report.violations[0].robots == (0,)
    assert report.violations[0].time == pytest.approx(1.9)
    assert "0.1 m from its goal" in report.violations[0].detail
    np.testing.assert_allclose(report.arrival_times, [np.inf, 1.0])


def test_reaching_the_goal_too_fast_is_not_arriving():
    problem = make(["holonomic2d"], [(0, 0, 1, 0)], [(1, 0)], horizon=10)
    report = verify(problem, hold(problem, (0, 0)))
    assert report.ok
    assert report.arrival_speeds == pytest.approx([1.0])
    assert not report.dynamics_ok, "nobody stops from 1 m/s within a step of 0.1 s at 1 m/s^2"
    careful = problem.replace(goal_speed=0.5)
    report = verify(careful, hold(careful, (0, 0)))
    assert kinds(report) == ["not arrived"]
    assert "at 1 m/s (goal speed 0.5 m/s)" in report.violations[0].detail
    assert report.arrival_times[0] == math.inf


@pytest.mark.parametrize(
    ("model", "start", "fast", "slow"),
    [
        ("velocity2d", (0, 0), (1, 0), (0.25, 0)),
        ("differential_drive", (0, 0, math.pi, -1), (0, 0), (0, 1)),
        ("holonomic2d", (0, 0, 1, 0), (0, 0), (-1, 0)),
    ],
)
def test_slowing_down_within_the_goal_radius_is_arriving(model, start, fast, slow):
    problem = make([model], [start], [(0.35, 0)], dt=0.1, horizon=10, goal_radius=0.2, goal_speed=0.95)
    controls = hold(problem, fast)
    assert kinds(verify(problem, controls)) == ["not arrived"]
    controls[2:] = slow
    assert verify(problem, controls).arrival_times == pytest.approx([0.3])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_control_that_is_not_finite(value):
    problem = make(["velocity2d"] * 2, [(0, 0), (0, 1)], [(1, 0), (1, 1)], horizon=20)
    controls = hold(problem, (1, 0), (1, 0))
    controls[7, 1, 0] = value
    report = verify(problem, controls)
    assert kinds(report) == ["non-finite"]
    assert report.violations[0].robots == (1,)
    assert "step 7" in report.violations[0].detail
    assert not report.ok
    assert math.isnan(report.min_separation)
    assert math.isnan(report.min_clearance)


@pytest.mark.parametrize("controls", [np.zeros((5, 2, 2)), np.zeros((5, 1, 3)), np.zeros((4, 1, 2)), np.zeros(10), []])
def test_wrong_shape_is_an_error(controls):
    problem = make(["velocity2d"], [(0, 0)], [(1, 0)], horizon=5)
    with pytest.raises(ValueError, match=r"controls have shape .* expected \(H, K, m\) = \(5, 1, 2\)"):
        verify(problem, controls)


def test_controls_that_are_not_numbers_are_an_error():
    problem = make(["velocity2d"], [(0, 0)], [(1, 0)], horizon=1)
    with pytest.raises(ValueError, match="array of numbers"):
        verify(problem, [[["left", "right"]]])


def test_controls_too_large_for_a_float_are_an_error():
    problem = make(["velocity2d"], [(0, 0)], [(1, 0)], horizon=1)
    with pytest.raises(ValueError, match="controls hold a whole number too large for float64"):
        verify(problem, [[[10**400, 0]]])


@pytest.mark.parametrize("dt", [0.1, 1.0])  # at 0.1 s, the last that is followed is 8000 m/s^2
def test_motion_too_violent_to_follow_is_reported_at_once(dt):
    limits = {"max_speed": 1e4, "max_acceleration": 1e6}
    problem = make(["holonomic2d"] * 2, [(0, 0), (0, 1)], [(1, 0), (1, 1)], limits=limits, dt=dt, horizon=5)
    controls = np.zeros((5, 2, 2))
    controls[3, 1] = (1e6, 0)
    report = verify(problem, controls)
    assert kinds(report) == ["not judged"]
    assert (report.violations[0].robots, report.violations[0].time) == ((1,), pytest.approx(3 * dt))
    assert "accelerates with 1e+06 m/s^2 at step 3" in report.violations[0].detail
    assert math.isnan(report.min_separation)


# Docking that rounding decides.


@pytest.mark.parametrize("offset", [-7e-6, 0.0, 7e-6])
def test_a_plan_must_be_fine_whether_a_robot_docks_at_the_edge_or_not(offset):
    # Robot 0 passes its goal at the goal radius, give or take what rounding does. Robot 1 stands on its way.
    problem = make(["velocity2d"] * 2, [(0, 0), (1.6, 0)], [(1, 0.075 + offset), (1.6, 0)], horizon=20)
    report = verify(problem, hold(problem, (1, 0), (0, 0)))
    assert kinds(report) == ["robot contact", "not arrived"]
    assert "rounding decides whether robot_0 docks at 1.000 s" in report.violations[0].detail
    assert "unless it docks at 1.000 s" in report.violations[1].detail
    assert report.arrival_times[0] == math.inf
    # Had it stopped there, docking or not, all would be well, but for its arrival.
    controls = hold(problem, (1, 0), (0, 0))
    controls[10:] = 0
    assert kinds(verify(problem, controls)) == ["not arrived"]
    # Driving further in it arrives in every reading.
    controls[10] = (0, 0.5)
    assert verify(problem, controls).ok


def test_a_robot_that_docks_at_the_edge_may_be_in_the_way_there():
    # Robot 0 docks at x = 0.925, or at 1.025 a step later. Later robot 1 comes by at x = 0.635.
    problem = make(["velocity2d"] * 2, [(-0.075, 0), (0.635, 1.5)], [(1, 0), (0.635, -1)], horizon=25)
    report = verify(problem, hold(problem, (1, 0), (0, -1)))
    assert kinds(report) == ["robot contact"]
    assert report.arrival_times == pytest.approx([1.0, 2.5])
    further = problem.replace(start=[(-0.105, 0), (0.635, 1.5)])
    assert verify(further, hold(problem, (1, 0), (0, -1))).ok


def test_speed_at_the_goal_speed_is_decided_by_rounding_too():
    problem = make(["holonomic2d"], [(0, 0, 0.5, 0)], [(0.5, 0)], horizon=20, goal_speed=0.5 - 2**-13 - 5e-6)
    coasting = hold(problem, (0, 0))
    report = verify(problem, coasting)
    assert kinds(report) == ["not arrived"]
    assert "which rounding decides" in report.violations[0].detail
    coasting[10] = (-1, 0)
    assert verify(problem, coasting).ok


@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive", "car"])
def test_a_robot_arrives_at_what_it_brakes_away_in_a_step(model):
    start = {"holonomic2d": (0, 0, 1, 0), "differential_drive": (0, 0, 0, 1), "car": (0, 0, 0, 1, 0)}[model]
    problem = make([model], [start], [(0.525, 0)], horizon=20, goal_radius=0.1, goal_speed=None)
    assert problem.goal_speed == pytest.approx([0.1])
    brakes = {"holonomic2d": (-1, 0), "differential_drive": (0, -1), "car": (-1, 0)}[model]
    controls = hold(problem, (0, 0))
    controls[:9] = brakes  # from 1 m/s down to exactly 0.1 m/s in 0.495 m: nothing is left to rounding
    report = verify(problem, controls)
    assert report.ok, report.violations
    assert report.arrival_speeds == pytest.approx([0.1])
    assert report.dynamics_ok


@pytest.mark.parametrize(("speed", "stops"), [(0.0201, True), (0.021, False), (0.1, False)])
def test_who_must_end_an_acceleration_brakes_less_away_in_a_step(speed, stops):
    problem = make(["holonomic2d_jerk"], [(0, 0, speed, 0, -0.4, 0)], [(0.03, 0)], horizon=5)
    ended = verify(problem.replace(start=[[0, 0, speed + 0.02, 0, -0.4, 0]]), hold(problem, (4, 0)))
    assert ended.ok
    assert ended.arrival_speeds == pytest.approx([speed], abs=1e-4)
    assert ended.dynamics_ok == stops


def test_a_robot_at_rest_is_slow_enough_for_any_goal_speed():
    problem = make(["velocity2d"], [(0, 0)], [(0.5, 0)], horizon=10, goal_speed=0.0)
    controls = hold(problem, (1, 0))
    controls[5:] = 0
    assert verify(problem, controls).arrival_times == pytest.approx([0.6])


def test_hovering_at_the_edge_of_the_goal_is_not_arriving():
    problem = make(["velocity2d"], [(0, 0)], [(0.075, 0)], horizon=30)
    controls = hold(problem, (0, 0))
    controls[20] = (0.3, 0)
    report = verify(problem, controls)
    assert kinds(report) == ["not arrived"]
    assert "drive further in" in report.violations[0].detail


# The report.


def test_the_report_is_ok_exactly_when_nothing_is_wrong():
    fault = Violation("robot contact", (0, 3), 1.25, "touches robot_3")
    assert VerificationReport(1.0, 1.0, np.zeros(4), np.zeros(4), True, []).ok
    assert not VerificationReport(1.0, 1.0, np.zeros(4), np.zeros(4), True, [fault]).ok
    assert str(fault) == "robot contact at 1.250 s, robot_0 and robot_3: touches robot_3"


def test_one_violation_for_each_pair_in_order_of_time():
    # Robot 2 drives through robot 1, then robot 0, both of which stand at their goals.
    problem = make(["velocity2d"] * 3, [(0, 0), (1, 0), (3, 0)], [(0, 0), (1, 0), (-2, 0)], horizon=60)
    report = verify(problem, hold(problem, (0, 0), (0, 0), (-1, 0)))
    assert [(violation.kind, violation.robots) for violation in report.violations] == [
        ("robot contact", (1, 2)),
        ("robot contact", (0, 2)),
    ]
    first, second = (violation.time for violation in report.violations)
    assert first == pytest.approx(1.7, abs=0.011)
    assert second == pytest.approx(2.7, abs=0.011)
    assert report.min_separation == pytest.approx(-0.3, abs=1e-6)


def test_verify_runs_no_code_of_the_project_but_its_own_and_portable_functions():
    for path in Path(sys.modules["d4orm_env.verify"].__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text())
        guarded = {
            id(child)
            for node in ast.walk(tree)
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
            for child in ast.walk(node)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom) and id(node) not in guarded:
                names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [name.name for name in node.names]
                for name in names:
                    own = name.startswith("d4orm_env.verify.") or ast.unparse(node).endswith("core import portable")
                    assert own or name.split(".")[0] in sys.stdlib_module_names | {"numpy"}, (path.name, name)


def test_verify_calls_nothing_whose_last_bits_depend_on_the_processor():
    # NumPy chooses versions of these by instruction set; core/portable.py has those that are the same everywhere.
    varying = {"sin", "cos", "tan", "arctan2", "arccos", "arcsin", "hypot", "exp", "log", "power", "linalg", "einsum"}
    varying |= {"dot", "inner", "matmul", "vdot", "tensordot", "sum", "mean", "prod", "std", "var", "math"}
    for path in Path(sys.modules["d4orm_env.verify"].__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            called = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "np"
            assert not (called and node.attr in varying), (path.name, node.attr)
            assert not isinstance(node, ast.MatMult), path.name
            assert not (isinstance(node, ast.Import) and node.names[0].name in varying), path.name


def test_the_bits_of_a_verdict_are_fixed():
    problem, controls = random_case(7)
    report = verify(problem, controls)
    assert [report.min_separation.hex(), report.min_clearance.hex()] == [
        "-0x1.25fb987114e00p-4",
        "-0x1.cc7c9d426dbf0p-2",
    ]


# Properties.

PLANAR = ("holonomic2d", "velocity2d", "differential_drive")


def random_case(seed, num_robots=4, horizon=6, dt=0.3):
    """A mixed planar team in a crowd of obstacles, with random starts, limits and controls, some above the limits."""
    rng = np.random.default_rng(seed)
    models = [str(name) for name in rng.choice(PLANAR, num_robots)]
    limits = {"radius": rng.uniform(0.05, 0.2, num_robots), "max_speed": rng.uniform(0.5, 3, num_robots)}
    limits["max_acceleration"] = rng.uniform(1, 6, num_robots)
    corners = np.array([(x, y) for x in (0.3, 0.9, 1.5) for y in (0.3, 0.9, 1.5)])
    positions = corners[rng.permutation(9)[:num_robots]] + rng.uniform(-0.05, 0.05, (num_robots, 2))
    goal = corners[rng.permutation(9)[:num_robots]]
    start = []
    for model, position in zip(models, positions, strict=True):
        motion = {"holonomic2d": rng.uniform(-0.3, 0.3, 2), "differential_drive": (rng.uniform(-4, 4), 0.3)}
        start.append([*position, *motion.get(model, ())])
    world = World(circles=[[2.5, 1, 0.2]], boxes=[[-1, 2, 1.2, 2.3]], lower=(-1.5, -1.5), upper=(3.5, 3.5))
    problem = make(models, start, goal, world=world, limits=limits, dt=dt, horizon=horizon, goal_radius=0.2)
    return problem, rng.normal(size=(horizon, num_robots, 2)) * 3


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), order=st.permutations(range(4)))
def test_order_of_the_robots_does_not_matter(seed, order):
    problem, controls = random_case(seed)
    straight, shuffled = verify(problem, controls), verify(problem.select(order), controls[:, order])
    np.testing.assert_array_equal(shuffled.arrival_times, straight.arrival_times[order])
    assert shuffled.min_separation == pytest.approx(straight.min_separation, abs=1e-12)
    assert shuffled.min_clearance == pytest.approx(straight.min_clearance, abs=1e-12)
    assert sorted(kinds(shuffled)) == sorted(kinds(straight))


def sampled_positions(problem, controls, pieces):
    """``(H * pieces + 1, K, 2)`` positions and arrival times, by the models of the core in float64, at a fine pace."""
    h = problem.dt / pieces
    pace = TimeStep(h, h / 2, h / 3, h / 6)
    tracks, arrivals = [], []
    for robot, model in enumerate(problem.team.robot_models):
        limits = [float(limit) for limit in problem.team.limits[robot]]
        x = tuple(float(value) for value in problem.start[robot, : model.state_size])
        goal, track, arrival = problem.goal[robot].astype(float), [x[:2]], math.inf
        for step in range(problem.horizon):
            u = model.functions.limit_control(tuple(controls[step, robot].tolist()), limits, PYTHON_OPS)
            for _ in range(pieces):
                if arrival == math.inf:
                    x = model.functions.integrate(x, u, limits, pace, PYTHON_OPS)
                track.append(x[:2])
            x = model.functions.limit_state(x, limits, PYTHON_OPS)
            if arrival == math.inf and math.dist(x[:2], goal) <= problem.goal_radius:
                arrival = (step + 1) * problem.dt
        tracks.append(track)
        arrivals.append(arrival)
    return np.swapaxes(np.array(tracks), 0, 1), np.array(arrivals)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_fine_sampling_finds_nothing_nearer_than_reported(seed):
    problem, controls = random_case(seed, num_robots=3)
    report = verify(problem, controls)
    pieces = 60
    positions, arrivals = sampled_positions(problem, controls, pieces)
    radius = problem.team.radius.astype(float)
    i, j = np.triu_indices(3, 1)
    gaps = np.linalg.norm(positions[:, i] - positions[:, j], axis=2) - radius[i] - radius[j]
    clearance = problem.world.clearance(positions) - radius
    # A sample can be late by half a piece, at a speed of 3 m/s and what a step adds to it.
    late = problem.dt / pieces * (3 + 6 * problem.dt)
    np.testing.assert_allclose(report.arrival_times, arrivals)
    assert report.min_separation - CHORD <= gaps.min() <= report.min_separation + late
    assert report.min_clearance - CHORD <= clearance.min() <= report.min_clearance + late
    for kind, smallest in (("robot contact", gaps.min()), ("not arrived", 0.0 if np.isinf(arrivals).any() else 1.0)):
        if abs(smallest) > late or smallest == 0.0:
            assert (kind in kinds(report)) == (smallest <= 0)


def test_long_steps_are_cut_finely_enough():
    # In a step of 4 s a differential drive turns a full circle of radius 2/pi around a post that just fits.
    radius = 2 / math.pi
    world = World(circles=[[0, radius, radius - 0.16]])
    problem = make(["differential_drive"], [(0, 0, 0, 1)], [(0, 0)], world=world, horizon=1)
    # RK4 would not follow such a step; verify does, and with_state() does not ask.
    problem = problem.with_state(problem.start, problem.goal, dt=4.0)
    report = verify(problem, hold(problem, (math.pi / 2, 0)))
    assert report.ok
    assert report.min_clearance == pytest.approx(0.01, abs=CHORD)
    narrow = World(circles=[[0, radius, radius - 0.16]], lower=(-9, -9), upper=(radius + 0.14, 9))
    tight = problem.with_state(problem.start, problem.goal, world=narrow)
    report = verify(tight, hold(tight, (math.pi / 2, 0)))
    assert kinds(report) == ["bounds contact"]
    assert report.violations[0].time == pytest.approx(1.0, abs=0.15)


def test_a_large_team_is_judged_pair_by_pair():
    # 64 robots in 32 lanes, head-on in each: only the lanes in the list are too narrow.
    narrow = [3, 17]
    lanes = np.arange(32) * 1.0
    offset = np.where(np.isin(np.arange(32), narrow), 0.29, 0.35)
    start = [*zip(np.full(32, -1.0), lanes), *zip(np.full(32, 1.0), lanes + offset)]
    goal = [*zip(np.full(32, 1.0), lanes), *zip(np.full(32, -1.0), lanes + offset)]
    problem = make(["velocity2d"] * 64, start, goal, horizon=25)
    report = verify(problem, hold(problem, *[(1, 0)] * 32, *[(-1, 0)] * 32))
    assert {violation.robots for violation in report.violations} == {(lane, lane + 32) for lane in narrow}
    assert kinds(report) == ["robot contact"] * 2
    assert report.min_separation == pytest.approx(-0.01, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_looking_at_many_steps_at_once_misses_nothing(seed, monkeypatch):
    random = np.random.default_rng(seed)
    positions = random.uniform(-4, 4, (120, 2))
    world = World(
        circles=np.column_stack([positions[:60], np.full(60, 0.1)]),
        boxes=np.hstack([positions[60:] - 0.1, positions[60:] + 0.1]),
    )
    start = [(x, y, 0, 0) for x, y in random.uniform(6, 30, (6, 2)) * random.choice([-1, 1], (6, 2))]
    problem = make(["holonomic2d"] * 6, start, [(40, k) for k in range(6)], world=world, horizon=300)
    controls = np.tile(-0.05 * np.array(start)[:, :2], (300, 1, 1)) * random.uniform(0.2, 1.0, (1, 6, 1))
    at_once = verify(problem, controls)
    monkeypatch.setattr(sys.modules["d4orm_env.verify.contact"], "BLOCKS", (1,))
    one_by_one = verify(problem, controls)
    assert at_once.violations
    assert at_once.min_clearance == pytest.approx(one_by_one.min_clearance, abs=1e-8)
    assert at_once.min_separation == pytest.approx(one_by_one.min_separation, abs=1e-8)
    assert [(v.kind, v.robots, v.detail) for v in at_once.violations] == [
        (v.kind, v.robots, v.detail) for v in one_by_one.violations
    ]
