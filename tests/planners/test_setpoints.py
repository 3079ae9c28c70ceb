"""Setpoints for robots: exact derivatives within limits, verified again, and files that others read."""

from __future__ import annotations

import csv
import sqlite3
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.polynomial.polynomial import polyder, polyval
from scipy.interpolate import PPoly, make_interp_spline

from d4orm_env import Problem, Team, World, make_problem, rollout, verify
from d4orm_env.engine.choice import get_engine
from d4orm_env.footprints import Box, Train
from d4orm_env.verify.curves import verify_curves
from d4orm_planners import Plan, make_planner
from d4orm_planners.base.candidate import evaluate_controls
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.tracking.export import FORMATS, MOST_PIECES
from d4orm_planners.tracking.smoothing import MotionLimits, smooth_motion
from d4orm_planners.tracking.splines import fit_spline

CASES: dict[str, dict[str, Any]] = {
    "plane": {"scenario": "circle", "num_robots": 5},
    "slow goals": {"scenario": "circle", "num_robots": 5, "goal_speed": 0.1},
    "space": {"scenario": "random", "num_robots": 5, "model": "holonomic3d", "height": 4.0},
    "wheels": {"scenario": "circle", "num_robots": 4, "model": "differential_drive"},
    "unicycles": {"scenario": "circle", "num_robots": 4, "model": "unicycle"},
    "first order": {"scenario": "circle", "num_robots": 4, "model": "velocity2d"},
    "walls": {"scenario": "warehouse", "num_robots": 4, "goal_speed": 0.1},
}


def planned(name: str) -> Plan:
    plan = make_planner(engine="cpu").solve(make_problem(**CASES[name], seed=1), seed=0, max_iterations=20)
    assert plan.solved
    return plan


@pytest.fixture(scope="module")
def plans() -> dict[str, Plan]:
    return {name: planned(name) for name in CASES}


@pytest.mark.parametrize("name", CASES)
def test_setpoints_are_derivatives_within_the_limits(plans: dict[str, Plan], name: str) -> None:
    plan = plans[name]
    problem, s = plan.problem, plan.sample(rate=500.0)
    np.testing.assert_allclose(np.diff(s.time), 0.002, rtol=1e-9)
    shape = (len(s.time), problem.num_robots, problem.dimension)
    assert s.position.shape == s.velocity.shape == s.acceleration.shape == s.jerk.shape == shape
    assert s.heading.shape == shape[:2]
    for lower, upper in ((s.position, s.velocity), (s.velocity, s.acceleration), (s.acceleration, s.jerk)):
        slope = (lower[2:] - lower[:-2]) / 0.004
        np.testing.assert_allclose(slope, upper[1:-1], atol=5e-3 * np.abs(upper).max())
    np.testing.assert_allclose(s.position[0], problem.start[:, : problem.dimension], atol=1e-9)
    assert np.linalg.norm(s.position[-1] - problem.goal, axis=1).max() <= problem.goal_radius
    for still in (s.velocity[-1], s.acceleration[0], s.acceleration[-1]):
        np.testing.assert_allclose(still, 0, atol=1e-9)
    assert (np.linalg.norm(s.velocity, axis=2) <= problem.team.max_speed * (1 + 1e-6)).all()
    first_order = problem.team.robot_models[0].first_order
    if not first_order and problem.team.robot_models[0].heading_index is None:
        assert (np.linalg.norm(s.acceleration, axis=2) <= problem.team.max_acceleration * (1 + 1e-6)).all()
    turning = np.abs(np.diff(s.heading, axis=0)).max() * 500
    assert turning <= problem.team.max_turn_rate.max() * (1 + 1e-3)


@pytest.mark.parametrize("name", ["plane", "slow goals", "space", "walls"])
def test_mean_accelerations_lead_from_sample_to_sample_and_are_a_plan_without_a_clip(
    plans: dict[str, Plan], name: str
) -> None:
    problem, dt = plans[name].problem, plans[name].problem.dt
    s = plans[name].sample(rate=1 / dt)
    controls = np.diff(s.velocity, axis=0) / dt
    close = problem.team.max_acceleration[0] * dt**2 / 12
    velocity = s.velocity[0] + np.concatenate([0 * controls[:1], np.cumsum(dt * controls, axis=0)])
    position = s.position[0] + np.cumsum(dt * velocity[:-1] + dt**2 / 2 * controls, axis=0)
    np.testing.assert_allclose(position, s.position[1:], atol=1.01 * close)
    problem = problem.replace(horizon=len(controls))
    report, executed = verify(problem, controls), rollout(problem, controls)
    assert report.ok
    under_way = ~executed.arrived[1:]
    speeds = executed.states[1:, :, problem.dimension : 2 * problem.dimension]
    np.testing.assert_allclose(speeds[under_way], s.velocity[1:][under_way], atol=1e-5)
    np.testing.assert_allclose(executed.positions[1:][under_way], position[under_way], atol=1e-4)


@pytest.mark.parametrize("name", CASES)
def test_the_report_is_what_samples_show(plans: dict[str, Plan], name: str) -> None:
    plan = plans[name]
    s, radius = plan.sample(rate=400.0), plan.problem.team.radius
    gaps = np.linalg.norm(s.position[:, :, None] - s.position[:, None], axis=-1) - radius[:, None] - radius
    least = gaps[:, ~np.eye(len(radius), dtype=bool)].min()
    assert s.report.ok
    assert s.report.min_separation <= least + 1e-4
    assert least - s.report.min_separation < 0.005  # between two samples robots drive as far
    clearance = (plan.problem.world.clearance(s.position) - radius).min()
    assert s.report.min_clearance <= clearance + 1e-4


def test_less_acceleration_and_less_jerk_take_more_time(plans: dict[str, Plan]) -> None:
    plan = plans["slow goals"]
    usual, weak, gentle = plan.sample(), plan.sample(max_acceleration=0.5), plan.sample(rate=2000, max_jerk=2.0)
    assert usual.stretch < min(weak.stretch, gentle.stretch)
    assert usual.time[-1] < min(weak.time[-1], gentle.time[-1])
    assert np.linalg.norm(gentle.jerk, axis=2).max() <= 2.0 * (1 + 1e-6)
    each = plan.sample(max_acceleration=[1.0, 1.0, 1.0, 1.0, 0.5])
    assert np.linalg.norm(each.acceleration[:, 4], axis=1).max() <= 0.5 * (1 + 1e-6)


def test_a_plan_from_rest_at_full_acceleration_is_hardly_slowed_down(plans: dict[str, Plan]) -> None:
    """Without the steps in which the team gathers way it took 1.15 times as long, with a jerk of 33 m/s^3."""
    plan = plans["slow goals"]
    assert np.linalg.norm(plan.trajectory.states[1, :, 2:4], axis=1).max() == pytest.approx(0.1, rel=1e-3)
    s = plan.sample()
    assert s.stretch < 1.08
    assert np.linalg.norm(s.jerk, axis=2).max() < 15


def test_rows_as_a_table(plans: dict[str, Plan]) -> None:
    s = plans["space"].sample(rate=10)
    table = s.to_dataframe()
    assert list(table.columns)[:6] == ["time", "robot", "x", "y", "z", "vx"]
    np.testing.assert_array_equal(table[table.robot == 2].vz, s.velocity[:, 2, 2])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rate": 0}, "rate"), ({"rate": np.nan}, "rate"), ({"rate": 1e9}, "rate"), ({"rate": 1e-9}, "rate"),
        ({"rate": "fast"}, "rate"),
        ({"max_acceleration": 0}, "max_acceleration is 0; it must be positive"),
        ({"max_acceleration": [1, 2]}, r"max_acceleration must be one number or one per robot \(5\)"),
        ({"max_jerk": "soft"}, "max_jerk must be one number"),
        ({"max_acceleration": 0.01}, r"needs .* m/s\^2 of acceleration, limit 0.01, and it would take"),
    ],
)  # fmt: skip
def test_bad_wishes_are_named(plans: dict[str, Plan], arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plans["plane"].sample(**arguments)


def test_a_plan_that_fails_is_not_for_robots() -> None:
    plan = make_planner("d4orm", engine="cpu", num_samples=16, num_steps=2).solve(
        make_problem("circle", num_robots=8), max_iterations=1
    )
    assert not plan.solved
    with pytest.raises(ValueError, match=r"the plan is not solved, and robots do not execute it: robot_\d "):
        plan.sample()


def driven(problem: Problem, controls: Any) -> Plan:
    """A plan of controls that are given."""
    search = SolveRun(make_planner("d4orm", engine="cpu"), problem, 0, None)
    search.best = evaluate_controls(get_sampling_engine("cpu"), problem, np.asarray(controls, np.float32))
    return search.plan("solved" if search.best.solved else "iteration_limit")


def round_a_corner(**changes: Any) -> Plan:
    """Right and then up, half a millimetre from a box; splines cut corners."""
    controls = np.zeros((30, 1, 2))
    controls[:10, 0, 0] = controls[10:20, 0, 1] = 1.0
    world = World(boxes=[[-1.0, 0.1505, 0.8495, 3.0]])
    settings: dict[str, Any] = {"margin": 0.0, "goal_radius": 0.01, "horizon": 30}
    return driven(Problem(Team(("velocity2d",)), [[0, 0]], [[1, 1]], world, **settings | changes), controls)


def test_what_touches_when_smoothed_is_refused() -> None:
    plan = round_a_corner()
    assert plan.solved
    with pytest.raises(ValueError, match=r"smoothed, the plan fails: obstacle contact at .* robot_0: touches"):
        plan.sample()


def test_robots_that_drive_at_the_start_are_not_slowed_down() -> None:
    controls = np.zeros((30, 1, 2))
    controls[:10, 0, 0] = -1.0
    problem = Problem(Team(("holonomic2d",)), [[0, 0, 1, 0]], [[0.5, 0]], horizon=30)
    plan = driven(problem, controls)
    assert plan.solved
    with pytest.raises(ValueError, match="its robots drive at the start, so they cannot take longer"):
        plan.sample()
    s = plan.sample(max_acceleration=9.0)
    assert s.stretch == 1
    np.testing.assert_allclose(s.velocity[0], [[1, 0]], atol=1e-9)


@pytest.mark.parametrize("smoothness", [1e-2, 1.0, 100.0])
def test_a_spline_through_rest_is_rest(smoothness: float) -> None:
    values = np.full((12, 2), 3.0)
    spline = fit_spline(values, np.zeros(2), 0.1, smoothness)
    np.testing.assert_allclose(spline(np.linspace(0, 1.1, 50)), 3.0, atol=1e-12)


def test_curves_are_judged_in_numbers() -> None:
    """Two robots of radius 0.15 pass each other 1 m apart; one ends 0.2 m from a box."""
    team = Team(("velocity2d",) * 2)
    world = World(boxes=[[1.35, -1, 2, 0.5]])
    problem = Problem(team, [[0, 0], [1, 1]], [[1, 0], [0, 1]], world)

    def lines(times: Any) -> Any:
        x = np.asarray(times)[:, None] / 2
        return np.stack([np.hstack([x, 0 * x]), np.hstack([1 - x, 0 * x + 1])], axis=1)

    def still(times: Any) -> Any:
        return np.zeros((len(times), 2))

    report = verify_curves(problem, lines, 2.0, np.zeros(2), still)
    assert report.ok
    assert report.min_separation == pytest.approx(0.7, abs=1e-6)
    assert report.min_clearance == pytest.approx(0.2, abs=1e-6)
    far = verify_curves(problem, lines, 1.0, np.zeros(2), still)
    assert [violation.kind for violation in far.violations] == ["not arrived", "not arrived"]
    through = verify_curves(problem, lambda times: lines(2 * np.asarray(times)), 2.0, np.zeros(2), still)
    assert {violation.kind for violation in through.violations} == {"obstacle contact", "not arrived"}


def test_footprints_of_curves_are_exact() -> None:
    """Boxes 1 m long pass each other 0.5 m apart, where the discs round them would touch."""
    team = Team(("unicycle", "unicycle"), footprint=Box(1.0, 0.2))
    start = [[-3, 0.35, 0], [3, -0.35, np.pi]]
    plan = make_planner().solve(Problem(team, start, [[3, 0.35], [-3, -0.35]], goal_heading=[0.0, np.pi]), seed=0)
    setpoints = plan.sample()
    assert setpoints.report.ok
    assert setpoints.report.min_separation == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_curves_tow_trailers_as_the_physics_does(count: int) -> None:
    """Two cars drive, and one backs a little: judged by its controls and by its curves the motion is the same."""
    model = f"car_with_{count}_trailer" + "s" * (count > 1)
    team = Team((model,) * 2, footprint=Train(Box(0.5, 0.25), [Box(0.3, 0.25)] * count))
    start = [[0, 0, 0, *[0.3] * count], [0, 3, 0, *[0] * count]]
    world = World(circles=[[-1.2, 1.5, 0.1]])
    problem = Problem(team, start, [[9, 9], [9, -9]], world, dt=0.01, horizon=540)
    controls = np.zeros((540, 2, 2), np.float32)
    controls[:500, 0], controls[500:, 0], controls[:, 1] = (0.5, 0.3), (-0.2, -0.1), (0.5, -0.2)
    exact, moved = verify(problem, controls), evaluate_controls(get_engine("cpu"), problem, controls).trajectory
    times = np.arange(541) * problem.dt
    position, heading = (make_interp_spline(times, part) for part in (moved.positions, moved.states[..., 2]))
    report = verify_curves(problem, position, times[-1], np.full(2, 2.0), heading)
    assert report.min_separation == pytest.approx(exact.min_separation, abs=1e-4)
    assert report.min_clearance == pytest.approx(exact.min_clearance, abs=1e-4)
    assert {violation.kind for violation in report.violations} == {"not arrived"}


def test_a_trailer_that_is_pushed_aside_is_told() -> None:
    """A trailer of 0.5 m at an angle of 0.3, backed by 1 m in a straight line, ends at 1.68: tan(phi / 2) times e^2."""
    team = Team(("car_with_1_trailer",), footprint=Train(Box(0.5, 0.25), [Box(0.3, 0.25)]))
    problem = Problem(team, [[0, 0, 0, 0.3]], [[-1, 0]])
    line = make_interp_spline([0, 2], [[[0, 0]], [[-1, 0]]], k=1)
    report = verify_curves(problem, line, 2.0, np.ones(1), lambda times: np.zeros((len(times), 1)))
    assert [violation.detail for violation in report.violations] == ["hitch 1 is at 1.68 rad at most, limit 0.785"]
    assert report.violations[0].time == pytest.approx(1.03, abs=0.01)


def test_a_turn_on_the_spot_at_the_goal_is_part_of_the_motion() -> None:
    problem = Problem(Team(("unicycle",)), [[0, 0, 0]], [[1.0, 0]], goal_heading=3.0, horizon=200)
    motion = make_planner().solve(problem, seed=0).sample(100.0)
    assert motion.heading[-1, 0] == pytest.approx(3.0, abs=float(problem.goal_heading_tolerance[0]))


@pytest.mark.parametrize(
    ("heading", "tolerance", "missed"), [(0.0, 0.05, None), (0.0, 0.04, "0.0409"), (0.2, 0.05, "0.2")]
)
def test_curves_end_at_goal_headings_and_hitch_angles(heading: float, tolerance: float, missed: str | None) -> None:
    """A trailer of 0.5 m at an angle of 0.3, drawn by 1 m in a straight line, ends at 0.0409: tan(phi / 2) over e^2."""
    team = Team(("car_with_1_trailer",), footprint=Train(Box(0.5, 0.25), [Box(0.3, 0.25)]))
    problem = Problem(
        team, [[0, 0, 0, 0.3]], [[1, 0]], goal_heading=heading, goal_heading_tolerance=tolerance, goal_hitches=[[0.0]]
    )
    line = make_interp_spline([0, 2], [[[0, 0]], [[1, 0]]], k=1)
    report = verify_curves(problem, line, 2.0, np.ones(1), lambda times: np.zeros((len(times), 1)))
    details = [violation.detail for violation in report.violations]
    expected = f"{missed} rad from its goal heading or a hitch angle (tolerance {tolerance:g} rad)"
    assert [detail.partition(" at the end, ")[2] for detail in details] == ([] if missed is None else [expected])


@pytest.mark.parametrize(
    ("model", "own", "goal", "heading", "peak"),
    [
        ("unicycle2", {"max_turn_acceleration": 0.3}, [0, 0.3], 3.14, "turn_acceleration"),
        ("unicycle1", {"max_reverse_speed": 0.2}, [-0.6, 0], 0.0, "reverse_speed"),
        ("differential_drive", {"max_reverse_speed": 0.2}, [-0.6, 0], 0.0, "reverse_speed"),
        ("unicycle1", {"max_right_turn_rate": 0.4}, [0, -0.6], -1.5, "right_turn_rate"),
    ],
)
def test_limits_of_one_way_and_of_turning_are_kept(
    model: str, own: dict[str, float], goal: list[float], heading: float, peak: str
) -> None:
    team = Team((model,), own_limits=own)
    start = np.zeros((1, team.state_size))
    plan = make_planner().solve(Problem(team, start, [goal], goal_heading=heading, horizon=300), seed=0)
    motion = smooth_motion(plan.problem, plan.trajectory, limits := MotionLimits.of(plan.problem))
    (most,), (limit,) = own.values(), getattr(limits, peak)
    assert limit == pytest.approx(most)
    assert 0.5 * most < getattr(motion.peaks, peak)[0] <= most


def test_a_jerk_limit_of_the_model_is_kept_and_named() -> None:
    settings = {"model": "holonomic2d_jerk", "own_limits": {"max_jerk": 0.5}, "max_acceleration": 0.5}
    plan = make_planner().solve(make_problem("circle", num_robots=2, horizon=300, **settings), seed=0)
    motion = smooth_motion(plan.problem, plan.trajectory, MotionLimits.of(plan.problem))
    assert motion.peaks.jerk.max() <= 0.5
    with pytest.raises(ValueError, match=r"needs .* m/s\^3 of jerk, limit 0.001, .* allow more with max_jerk"):
        plan.sample(max_jerk=0.001)


def test_what_makes_good_the_drag_is_within_the_limit() -> None:
    problem = make_problem("circle", num_robots=2, model="holonomic3d_drag", own_limits={"drag": 2.0}, horizon=300)
    setpoints = make_planner().solve(problem, seed=0).sample(100.0)
    pushed = np.linalg.norm(setpoints.acceleration + 2.0 * setpoints.velocity, axis=2).max()
    assert 0.9 * problem.team.max_acceleration[0] < pushed <= problem.team.max_acceleration[0]


# Files.


def test_tables_hold_the_setpoints(plans: dict[str, Plan], tmp_path: Path) -> None:
    plan = plans["space"]
    report = plan.export("csv", tmp_path / "new" / "out", rate=50)
    s = plan.sample(rate=50)
    assert [path.name for path in report.files] == [f"robot_{robot}.csv" for robot in range(5)]
    for robot, path in enumerate(report.files):
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        read = np.array([[float(row[name]) for name in ("time", "x", "z", "vy", "az", "heading")] for row in rows])
        p, v, a = s.position[:, robot], s.velocity[:, robot], s.acceleration[:, robot]
        expected = np.column_stack([s.time, p[:, 0], p[:, 2], v[:, 1], a[:, 2], s.heading[:, robot]])
        np.testing.assert_allclose(read, expected, atol=1e-7)


@pytest.mark.parametrize("name", ["space", "walls", "wheels"])
def test_polynomials_are_close_to_the_motion(plans: dict[str, Plan], name: str, tmp_path: Path) -> None:
    plan, height = plans[name], 0.0 if name == "space" else 0.8
    report = plan.export("crazyswarm2", tmp_path, height=height)
    s = plan.sample(rate=200)
    assert report.pieces is not None
    assert report.pieces <= MOST_PIECES
    assert report.num_bytes == 132 * report.pieces
    for robot, path in enumerate(report.files):
        with path.open() as file:
            header, *lines = list(csv.reader(file))
        assert header[:3] == ["Duration", "x^0", "x^1"]
        assert header[-1] == "yaw^7"
        table = np.array(lines, float)
        ends = np.cumsum(table[:, 0])
        assert ends[-1] == pytest.approx(report.duration, abs=1e-6)
        for i, time in enumerate(s.time[:-1:20] * report.stretch / s.stretch):
            piece = int(np.searchsorted(ends, time, side="right"))
            own = time - (ends[piece] - table[piece, 0])
            x, y, z, yaw = (polyval(own, table[piece, 1 + 8 * k : 9 + 8 * k]) for k in range(4))
            position = s.position[i * 20, robot]
            np.testing.assert_allclose([x, y], position[:2], atol=0.004)
            assert z == pytest.approx(position[2] if len(position) == 3 else height, abs=0.004)
            assert yaw == pytest.approx(s.heading[i * 20, robot], abs=0.05)
        # Pieces meet in value and velocity.
        for before, after in pairwise(table):
            end = polyval(before[0], before[1:9])
            speed = polyval(before[0], polyder(before[1:9]))
            assert end == pytest.approx(after[1], abs=1e-5)
            assert speed == pytest.approx(after[2], abs=1e-4)


@pytest.mark.parametrize(("name", "most"), [("space", MOST_PIECES), ("plane", 4), ("wheels", 6)])
def test_polynomials_keep_the_limits_however_few_there_are(
    plans: dict[str, Plan], name: str, most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("d4orm_planners.tracking.export.MOST_PIECES", most)
    plan, team, flat = plans[name], plans[name].problem.team, plans[name].problem.dimension == 2
    report = plan.export("crazyswarm2", tmp_path, height=float(flat))
    assert report.deviation > plan.sample(100).deviation
    for robot, path in enumerate(report.files):
        table = np.loadtxt(path, delimiter=",", skiprows=1)
        ends = np.concatenate([[0.0], np.cumsum(table[:, 0])])
        way = PPoly(table[:, 1:].reshape(-1, 4, 8)[:, : 2 + (not flat)].transpose(2, 0, 1)[::-1], ends)
        times = np.linspace(0, ends[-1], 2000)
        for order, limit in ((1, team.max_speed[robot]), (2, team.max_acceleration[robot])):
            # Those on wheels turn in curves, which takes no acceleration of their model.
            if order == 1 or name != "wheels":
                assert np.linalg.norm(way(times, order), axis=1).max() <= limit
    assert report.duration == pytest.approx(ends[-1], abs=1e-6)


def test_a_bag_is_read_by_its_database(plans: dict[str, Plan], tmp_path: Path) -> None:
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    plan = plans["wheels"]
    plan.export("rosbag2", tmp_path, rate=20, height=0.3)
    with sqlite3.connect(tmp_path / "motion" / "motion.db3") as database:
        topics = dict(database.execute("select name, type from topics").fetchall())
    assert topics["/robot_3/path"] == "nav_msgs/msg/Path"
    assert topics["/robot_0/trajectory"] == "trajectory_msgs/msg/MultiDOFJointTrajectory"
    assert len(topics) == 8
    store, s = get_typestore(Stores.ROS2_HUMBLE), plan.sample(rate=20)
    with Reader(tmp_path / "motion") as bag:
        for connection, _, raw in bag.messages():
            robot = int(connection.topic.split("/")[1].removeprefix("robot_"))
            message: Any = store.deserialize_cdr(raw, connection.msgtype)
            if connection.topic.endswith("path"):
                positions = [[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in message.poses]
                turned = [2 * np.arctan2(p.pose.orientation.z, p.pose.orientation.w) for p in message.poses]
                np.testing.assert_allclose(np.cos(turned), np.cos(s.heading[:, robot]), atol=1e-6)
            else:
                assert message.joint_names == [f"robot_{robot}"]
                positions = [
                    [p.transforms[0].translation.x, p.transforms[0].translation.y, 0.3] for p in message.points
                ]
                speeds = [[p.velocities[0].linear.x, p.velocities[0].linear.y] for p in message.points]
                np.testing.assert_allclose(speeds, s.velocity[:, robot], atol=1e-9)
                time = message.points[7].time_from_start
                assert time.sec + 1e-9 * time.nanosec == pytest.approx(s.time[7])
            expected = np.column_stack([s.position[:, robot], np.full(len(s.time), 0.3)])
            np.testing.assert_allclose(positions, expected, atol=1e-9)


def test_an_mcap_is_read_by_foxglove_s_reader(plans: dict[str, Plan], tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    plan = plans["space"]
    plan.export("mcap", tmp_path, rate=20)
    s, seen = plan.sample(rate=20), set()
    with (tmp_path / "motion" / "motion.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            seen.add(channel.topic)
            if channel.topic == "/robot_1/path":
                positions = [[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in message.poses]
                np.testing.assert_allclose(positions, s.position[:, 1], atol=1e-9)
    assert seen == {f"/robot_{robot}/{topic}" for robot in range(5) for topic in ("path", "trajectory")}


@pytest.mark.parametrize("format", FORMATS)
def test_files_are_written_again_and_others_stay(plans: dict[str, Plan], tmp_path: Path, format: str) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    reports = [plans["plane"].export(format, tmp_path, rate=10, height=1.0) for _ in range(2)]
    assert reports[0].files == reports[1].files
    assert all(path.exists() for path in reports[1].files)
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert not list(tmp_path.parent.glob(".export*"))


@pytest.mark.parametrize(
    ("format", "arguments", "message"),
    [
        ("cvs", {}, "format 'cvs' is unknown; choose one of csv, crazyswarm2, rosbag2, mcap"),
        ("crazyswarm2", {}, "height is 0 m; a team that moves in the plane flies above 0: give height="),
        ("csv", {"height": np.nan}, r"height is nan; it must be at most 1e\+06 m in magnitude"),
        ("csv", {"height": 1e300}, r"height is 1e\+300; it must be at most"),
        ("csv", {"height": "1"}, "height must be a number, not .1."),
    ],
)
def test_bad_exports_are_refused_and_leave_nothing(
    plans: dict[str, Plan], tmp_path: Path, format: str, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        plans["plane"].export(format, tmp_path / "out", **arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", [3, ""])
def test_the_folder_of_an_export_is_a_path(plans: dict[str, Plan], path: Any) -> None:
    with pytest.raises(ValueError, match=f"the path of the folder of an export must be text or a path, not {path!r}"):
        plans["plane"].export("csv", path)


def test_a_folder_with_files_of_more_robots_is_refused(plans: dict[str, Plan], tmp_path: Path) -> None:
    (tmp_path / "robot_99.csv").write_text("flown before")
    with pytest.raises(ValueError, match=r"has robot_99\.csv of another team, and this one has \d robots"):
        plans["plane"].export("csv", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["robot_99.csv"]


def test_heights_belong_to_teams_in_the_plane(plans: dict[str, Plan], tmp_path: Path) -> None:
    assert plans["plane"].export("csv", tmp_path / "plane").min_overhead == np.inf
    with pytest.raises(ValueError, match="height is 1 m, and this team has heights of its own; leave it out"):
        plans["space"].export("csv", tmp_path / "space", height=1.0)
    assert not (tmp_path / "space").exists()


def test_nobody_is_sent_into_the_floor(tmp_path: Path) -> None:
    start = [[0, 0, 0.5, 0, 0, 0], [1, 0, 0.5, 0, 0, 0]]
    problem = Problem(Team(("holonomic3d",) * 2), start, [[0, 0, 0.5], [1, 0, -0.2]])
    plan = make_planner(engine="cpu").solve(problem, seed=0)
    with pytest.raises(
        ValueError, match=r"robot_1 comes down to z = -0\.\d\d m, and the floor is at 0; plan with bounds"
    ):
        plan.export("crazyswarm2", tmp_path / "out")
    assert not list(tmp_path.iterdir())
    assert plan.export("csv", tmp_path / "out").heights == pytest.approx((-0.2, 0.5), abs=0.1)


def test_how_low_one_flies_over_another_is_told(tmp_path: Path) -> None:
    # robot_1 crosses 1 m above robot_0, robot_2 passes just beside it at half of that.
    start = [[0, 0, 0, 0, 0, 0], [-1, 0, 1, 0, 0, 0], [-1, 0.33, 0.5, 0, 0, 0]]
    problem = Problem(Team(("holonomic3d",) * 3), start, [[0, 0, 0], [1, 0, 1], [1, 0.33, 0.5]])
    plan = make_planner(engine="cpu").solve(problem, seed=0)
    assert plan.export("csv", tmp_path / "out").min_overhead == pytest.approx(1, abs=0.05)


def test_too_long_a_motion_for_the_memory_on_board_is_refused(
    plans: dict[str, Plan], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("d4orm_planners.tracking.export.MOST_PIECES", 2)
    with pytest.raises(ValueError, match=r"2 polynomials, which is all that 4096 bytes on board hold, are"):
        plans["walls"].export("crazyswarm2", tmp_path, height=1.0)


def test_the_command(plans: dict[str, Plan], tmp_path: Path, d4orm: Any) -> None:
    plans["slow goals"].save(tmp_path / "plan.npz")
    status, out, _ = d4orm("export", str(tmp_path / "plan.npz"), "--format", "crazyswarm2", "-o", str(tmp_path / "out"),
                           "--height", "1")  # fmt: skip
    assert status == 0
    assert "polynomials a robot" in out
    assert "least gap between robots" in out
    assert "inf m" not in out  # nothing is in the way
    assert len(list((tmp_path / "out").iterdir())) == 5
    status, _, err = d4orm("export", str(tmp_path / "plan.npz"), "-f", "cvs", "-o", str(tmp_path / "other"))
    assert (status, err.count("\n")) == (2, 1)
    assert not (tmp_path / "other").exists()


def test_a_file_is_no_folder(plans: dict[str, Plan], tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(ValueError, match="taken is a file; give a folder"):
        plans["space"].export("csv", tmp_path / "taken")
    assert (tmp_path / "taken").read_text() == "mine"
