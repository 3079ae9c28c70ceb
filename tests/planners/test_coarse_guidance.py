"""The coarse guidance of D4orm-C2F: how it is made, when it is good enough, and where on it the robots are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from planner_support import hop_problem

from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import COMMON
from d4orm_env.envs.joint_state import JointState
from d4orm_env.footprints import Box
from d4orm_env.scenarios import make_problem
from d4orm_planners.base.candidate import failed_robots
from d4orm_planners.base.policy_threads import Background
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.d4orm_c2f.coarse_plan import (
    LEAST,
    STUCK_AFTER,
    STUCK_WITHIN,
    CoarsePlan,
    CoarseWaypoints,
    StagnationMonitor,
    after_waiting,
    as_discs,
    coarse_problem,
    interpolate,
    keep_time,
    nearest_indices,
    rest_of,
    subgoal_indices,
    visible_subgoals,
)
from d4orm_planners.d4orm_c2f.coarse_plan_tracker import NEARER, CoarsePlanTracker
from d4orm_planners.d4orm_c2f.settings import D4ormC2FConfig
from d4orm_planners.d4orm_d.planner import D4ormD, D4ormDConfig
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.tracking.steering import present_velocities
from d4orm_planners.tracking.tracker import follow_reference


@pytest.mark.parametrize(
    ("horizon", "factor", "steps"),
    [(100, 1, 100), (100, 2, 50), (100, 3, 34), (100, 4, 25), (3, 10, 1), (1, 2, 1)],
)
def test_coarse_steps_are_longer_and_cover_the_horizon(horizon: int, factor: int, steps: int) -> None:
    problem = hop_problem(horizon=horizon, dt=0.1)
    coarse = coarse_problem(problem, factor)
    assert (coarse.horizon, coarse.dt) == (steps, pytest.approx(0.1 * factor))
    assert coarse.horizon * coarse.dt >= problem.horizon * problem.dt - 1e-9
    np.testing.assert_array_equal(coarse.start, problem.start)
    np.testing.assert_array_equal(coarse.goal, problem.goal)


def test_waypoints_divide_every_coarse_step_evenly() -> None:
    path = np.array([[[0.0, 0.0]], [[4.0, 2.0]], [[4.0, 6.0]]])
    expected = [[0, 0], [1, 0.5], [2, 1], [3, 1.5], [4, 2], [4, 3], [4, 4], [4, 5], [4, 6]]
    np.testing.assert_allclose(interpolate(path, 4)[:, 0], expected)
    np.testing.assert_array_equal(interpolate(path, 1), path)


def test_waypoints_keep_those_of_the_path_exactly() -> None:
    path = np.random.default_rng(0).normal(size=(6, 3, 2)).astype(np.float32)
    waypoints = interpolate(path, 3)
    assert waypoints.shape == (16, 3, 2)
    assert waypoints.dtype == np.float32
    np.testing.assert_array_equal(waypoints[::3], path)


def trajectory(arrived: Any, violated: Any) -> Trajectory:
    """Of one robot over ten steps, which arrives or not, and violates the margin at these steps."""
    nothing = np.zeros((11, 1, 2), np.float32)
    reached = np.zeros((11, 1), bool)
    reached[-1] = arrived
    violations = np.zeros((11, 1), bool)
    violations[violated] = True
    return Trajectory(nothing, nothing, nothing[1:], nothing[1:, :, 0], reached, np.zeros((11, 1), bool), violations)


@pytest.mark.parametrize(
    ("arrived", "violated", "interval", "passes"),
    [
        (True, [], 1, True),
        (False, [], 1, False),
        (True, [7], 1, False),
        (True, [7], 2, True),
        (True, [7, 8], 2, False),
        (True, [5], 5, False),
        (True, [4, 6, 9], 5, True),
        # Where the robots start is not up to the plan.
        (True, [0], 1, True),
        # Nothing is looked at.
        (True, [3], 11, True),
    ],
)
def test_coarse_plans_are_checked_at_intervals(arrived: bool, violated: list[int], interval: int, passes: bool) -> None:
    assert failed_robots(trajectory(arrived, violated), interval).any() != passes


@pytest.mark.parametrize(("interval", "meets"), [(1, True), (2, True), (3, False), (7, False)])
def test_who_meets_whom_is_looked_for_at_intervals_too(interval: int, meets: bool) -> None:
    """Two robots that are near each other at steps 2 and 4 to 5 of ten; the third keeps away."""
    problem = hop_problem(3, horizon=10)
    apart = np.array([[0, 0], [0, 5], [0, 10]], np.float32)
    positions = np.repeat(apart[None], 11, axis=0)
    positions[[2, 4, 5], 1] = positions[[2, 4, 5], 0] + [0.1, 0]
    search = SolveRun(D4ormD(D4ormDConfig(engine="cpu")), problem, 0, check_interval=interval)
    states = np.concatenate([positions, np.zeros_like(positions)], axis=2)
    home = np.ones((11, 3), bool)
    here = search.current.trajectory
    team = WorkingPlan(search, replace(here, states=states, positions=positions, arrived=home))
    faults, first = team.faults(np.arange(3))
    np.testing.assert_array_equal(faults, [meets, meets, 0])
    assert team.conflicts() == ((frozenset({1}), frozenset({0}), frozenset()) if meets else (frozenset(),) * 3)
    if meets:
        np.testing.assert_array_equal(first[:2], 2)
    else:
        team.move([0], here.controls[:, :1], np.roll(states, 1, axis=0)[:, [1]], [True])
        np.testing.assert_array_equal(team.faults(np.arange(2))[0], [1, 1])


def test_nearest_waypoints_are_looked_for_ahead_only() -> None:
    # There and back on the same line: x = 0 1 2 3 2 1 0.
    line = np.array([0.0, 1, 2, 3, 2, 1, 0])
    path = np.stack([np.stack([line, 0 * line], axis=1)] * 3, axis=1)
    positions = np.array([[0.9, 0.2], [0.9, 0.2], [2.1, 0]])
    np.testing.assert_array_equal(nearest_indices(path, positions, [0, 3, 0], 6), [1, 5, 2])
    # A window of one waypoint reaches no further; beyond the end there is nothing.
    np.testing.assert_array_equal(nearest_indices(path, positions, [0, 3, 6], 1), [1, 4, 6])


def test_time_passes_where_a_path_waits() -> None:
    # The first waits for three steps, the second not, the third stays for good.
    lines = np.array([[0.1, 0.1, 0.1, 0.1, 1, 2], [0, 1, 2, 3, 4, 5], [0, 1, 1, 1, 1, 1]])
    path = np.stack([lines.T, np.full((6, 3), 0.3)], axis=2).astype(np.float32)
    path[2, 0] += np.float32(2.0**-27)  # what interpolating may round
    np.testing.assert_array_equal(after_waiting(path, np.array([0, 1, 1]), np.array([0, 1, 1]), 1), [1, 1, 1])
    np.testing.assert_array_equal(after_waiting(path, np.array([1, 2, 2]), np.array([1, 1, 1]), 5), [3, 2, 2])
    # It has just come there.
    np.testing.assert_array_equal(after_waiting(path, np.array([2, 2, 2]), np.array([1, 1, 1]), 1), [2, 2, 2])


def test_a_robot_held_up_keeps_to_its_own_path() -> None:
    indices = np.array([10, 12, 2, 30])
    # The mean is 13 or so; the third robot is 11 behind it, more than the 5 that are allowed.
    np.testing.assert_array_equal(subgoal_indices(indices, 13, 15, 5, 100), [28, 28, 22, 28])
    np.testing.assert_array_equal(subgoal_indices(indices, 13, 15, 5, 25), [25, 25, 22, 25])
    np.testing.assert_array_equal(subgoal_indices(indices, 13, 15, 100, 100), [28, 28, 28, 28])


@pytest.mark.parametrize(("index", "step"), [(0, 0), (1, 1), (2, 1), (3, 2), (30, 14), (99, 14)])
def test_the_rest_begins_at_the_next_coarse_step(index: int, step: int) -> None:
    problem = hop_problem(num_robots=2, horizon=30)
    coarse = coarse_problem(problem, 2)
    controls = np.random.default_rng(1).uniform(-0.5, 0.5, (15, 2, 2)).astype(np.float32)
    plan = get_sampling_engine("cpu").rollout(coarse, controls)
    guidance = CoarsePlan(
        problem=coarse,
        controls=plan.controls,
        states=plan.states,
        path=interpolate(plan.positions, 2),
        ordered=False,
    )
    left, rest = rest_of(guidance, index, 2)
    assert left.horizon == len(rest) == 15 - step
    np.testing.assert_array_equal(left.start, plan.states[step])
    np.testing.assert_array_equal(rest, plan.controls[step:])
    # Executed from there, it is the rest of the plan.
    again = get_sampling_engine("cpu").rollout(left, rest)
    np.testing.assert_allclose(again.states, plan.states[step:], atol=1e-5)


def right_angle(num_robots: int = 2) -> Any:
    """``(41, K, 2)`` paths: every robot 1 m along x, and then 1 m along y."""
    along = np.linspace(0, 1, 21)[:, None]
    path = np.concatenate([along * [1, 0], [1, 0] + along[1:] * [0, 1]])
    return np.stack([path + np.array([0, robot]) for robot in range(num_robots)], axis=1).astype(np.float32)


@pytest.mark.parametrize("walls", [True, False])
def test_a_subgoal_behind_a_corner_is_exchanged_for_one_in_sight(walls: bool) -> None:
    problem = hop_problem(1, world=World(boxes=[[0.3, 0.3, 0.6, 2.0]]))
    begin = np.zeros(1, int)
    nearer = visible_subgoals(
        problem, np.zeros((1, 2), np.float32), right_angle(1), begin, begin + 40, np.array([False]), walls
    )
    # A body of 0.15 m passes the corner at (0.6, 0.3) to no more than (1, 0.3) or so.
    assert 20 <= nearer[0] <= 26 if walls else nearer[0] == 40


def test_who_stands_in_the_way_of_a_subgoal_hides_it() -> None:
    problem = hop_problem(2)
    path, positions = right_angle(2), np.array([[0, 0], [0.65, 0.35]], np.float32)
    indices, targets = np.zeros(2, int), np.full(2, 40)
    for standing in (False, True):
        nearer = visible_subgoals(problem, positions, path, indices, targets, np.array([False, standing]), walls=False)
        assert (nearer[0] == 40) != standing
        assert nearer[0] > LEAST
        assert nearer[1] == 40


def joint(problem: Any, states: Any, steps: int = 0) -> JointState:
    nobody = np.zeros(problem.num_robots, bool)
    return JointState(np.asarray(states, np.float32), problem.goal, np.zeros((problem.num_robots, 2)), nobody, steps)


def test_who_does_not_get_on_is_stuck() -> None:
    problem = hop_problem(3)
    monitor, indices = StagnationMonitor(joint(problem, problem.start)), np.zeros(3, int)
    for step in range(1, STUCK_AFTER + 2):
        indices[2] = step
        # The second one has to wait where it is, and the third one moves.
        idle, careful = monitor.observe(step, indices, np.array([False, True, False]))
        np.testing.assert_array_equal(idle, [step, 0, step % STUCK_WITHIN])
        np.testing.assert_array_equal(careful, [step > STUCK_AFTER, False, False])
    indices[0] += 10
    idle, careful = monitor.observe(STUCK_AFTER + 2, indices, np.zeros(3, bool))
    assert idle[0] == 0
    assert careful[0]


def tracker_along(path: np.ndarray, problem: Problem, **config: Any) -> CoarsePlanTracker:
    """Leads robots along a path, from its first waypoints on."""
    cheap = {"engine": "cpu", "coarse_samples": 16, "coarse_steps": 4, "coarse_repair_steps": 4}
    tracker = CoarsePlanTracker(
        problem, D4ormC2FConfig(**cheap, **config), 0, Background(), Background(), lifelong=False, last_step=200
    )
    tracker.begin(joint(problem, problem.start), np.zeros(problem.num_robots, bool))
    tracker.guidance = CoarseWaypoints(path=path, ordered=False)
    return tracker


@pytest.mark.parametrize(("radii", "waits"), [(0.9, True), (1.1, False), (1.9, False)])
def test_who_waits_within_a_radius_of_its_waypoint_keeps_its_path(radii: float, waits: bool) -> None:
    problem = hop_problem(1)
    tracker, states = tracker_along(right_angle(1), problem, patience=1000), problem.start.copy()
    states[0, 1] = -radii * problem.team.largest_radius
    replans = [
        tracker.replan_if_needed(joint(problem, states, step), np.zeros(1, bool)) for step in range(1, STUCK_AFTER + 2)
    ]
    assert replans == [False] * STUCK_AFTER + [not waits]


@pytest.mark.parametrize(("num_robots", "lost"), [(1, True), (4, False)])
def test_a_team_is_lost_once_all_together_get_no_nearer(num_robots: int, lost: bool) -> None:
    """Each gets nearer to its goal by less in a step than counts."""
    problem = hop_problem(num_robots)
    tracker, states = tracker_along(right_angle(num_robots), problem, patience=2), problem.start.copy()
    replans = []
    for step in range(1, 5):
        states[:, 0] += 0.3 * NEARER * problem.team.largest_radius
        replans.append(tracker.replan_if_needed(joint(problem, states, step), np.zeros(num_robots, bool)))
    assert replans == [False, False, False, lost]


@pytest.mark.parametrize(
    ("docked", "config", "at_the_end"), [(False, {}, True), (True, {}, False), (True, {"line_of_sight": False}, True)]
)
def test_unless_told_otherwise_robots_head_for_what_they_see(docked: bool, config: Any, at_the_end: bool) -> None:
    """The end of the path of the first one is straight behind the second one."""
    problem, states = hop_problem(2), np.zeros((2, 4), np.float32)
    tracker = tracker_along(right_angle(2), problem, subgoal_offset=40, max_lag=None, **config)
    states[1, :2] = [0.65, 0.35]
    targets = tracker.subgoals(joint(problem, states), np.array([False, docked]))
    assert (targets[0] == 40) == at_the_end
    assert targets[0] > LEAST


def test_a_path_is_followed() -> None:
    problem, engine, path = hop_problem(1, horizon=100), get_sampling_engine("cpu"), right_angle(1)
    present = problem.with_state(problem.start, path[-1])
    controls = keep_time(problem, joint(present, problem.start), path, np.zeros(1, int), 100)
    positions = engine.rollout(present, controls).positions[:, 0]
    off = np.linalg.norm(positions[:, None] - path[:, 0], axis=2).min(axis=1)
    assert off.max() < 0.25
    assert np.linalg.norm(positions[-1] - path[-1, 0]) < 0.1


@pytest.mark.parametrize("model", COMMON)
def test_robots_are_driven_at_a_velocity_and_brought_to_rest_in_as_few_steps_as_can_be(model: str) -> None:
    problem = make_problem("circle", num_robots=2, model=model)
    engine, steps, half = get_sampling_engine("cpu"), 20, np.float32(problem.team.max_speed[0] / 2)
    along = (problem.goal - problem.start[:, : problem.dimension]) / 5
    rows = [np.tile(half * share * along, (steps, 1, 1)).astype(np.float32) for share in (1, 0)]
    nobody, states = np.zeros(2, bool), problem.start
    for wanted in rows:
        controls = follow_reference(problem, states, np.zeros_like(wanted), wanted, 0.0)
        driven = engine.move(problem.arrays, states, nobody, controls)
        velocity = present_velocities(problem, driven[-1], controls[-1])
        np.testing.assert_allclose(velocity, wanted[0], atol=1e-3)
        states = driven[-1]
    if not problem.team.robot_models[0].first_order:
        braking = int(np.ceil(half / (problem.team.max_acceleration[0] * problem.dt)))
        np.testing.assert_allclose(driven[braking:] - driven[braking], 0, atol=1e-6)


@pytest.mark.parametrize(("model", "headed"), [("unicycle", True), ("unicycle", False), ("car_first_order", False)])
def test_discs_stand_for_footprints_and_for_those_that_can_turn_later(model: str, headed: bool) -> None:
    heading = 1.0 if headed else np.nan
    problem = make_problem("circle", num_robots=3, model=model, footprint=Box(0.4, 0.2), goal_heading=heading)
    discs = as_discs(problem)
    assert discs is not None
    assert not discs.team.shapes
    assert np.isnan(discs.goal_heading).all()
    np.testing.assert_array_equal(discs.team.radius, problem.team.radius)


@pytest.mark.parametrize("arguments", [{"model": "unicycle"}, {"model": "car_first_order", "goal_heading": 1.0}])
def test_discs_stand_for_no_others(arguments: dict[str, Any]) -> None:
    assert as_discs(make_problem("circle", num_robots=3, **arguments)) is None
