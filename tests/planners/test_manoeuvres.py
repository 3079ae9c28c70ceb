"""Manoeuvres: parking, an alcove to make way in, a robot at its goal that makes way and returns."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from env_support import slow
from numba import njit

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import MODELS
from d4orm_env.footprints import Box, Train
from d4orm_planners import make_planner
from d4orm_planners.base.plan import Plan
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.manoeuvres.coming_to_rest import can_brake, come_to_rest
from d4orm_planners.manoeuvres.curves import NO_CURVES, curves_of
from d4orm_planners.manoeuvres.kinds import MAX_STEPS, Kind
from d4orm_planners.manoeuvres.lattice import buffer_size
from d4orm_planners.manoeuvres.primitives import MOVES, POSE_SIZE, primitives_of
from d4orm_planners.manoeuvres.robots import can_plan, scene_of
from d4orm_planners.manoeuvres.rounds import improve_manoeuvres
from d4orm_planners.manoeuvres.team import TeamMotions
from d4orm_planners.manoeuvres.traffic import NEVER, safe_since, traffic_of

CORRIDOR = [[0.0, 1.0, 6.0, 1.5], [0.0, -0.5, 2.5, 0.3], [3.8, -0.5, 6.0, 0.3]]
"""A corridor along x, with an alcove below it in the middle."""


def problem_of(start: Any, goal: Any, boxes: Any, **arguments: Any) -> Problem:
    """Unicycles of half a metre by a quarter; goals ``(x, y, heading)``."""
    goals = np.array(goal, float)
    team = Team(("unicycle",) * len(goals), max_speed=0.5, max_turn_rate=1.0, footprint=Box(0.5, 0.25))
    usual = {"margin": 0.0, "goal_radius": 0.02, "goal_heading_tolerance": 0.03, "arrival": "stay", "horizon": 500}
    world = World(boxes=boxes, lower=(0.0, -0.5), upper=(6.0, 1.5))
    return Problem(team, start, goals[:, :2], world, goal_heading=goals[:, 2], **usual | arguments)


def solved(problem: Problem) -> Plan:
    """The plan, which must be a solution that the judge agrees to, found at once and without denoising."""
    plan = make_planner(engine="cpu").solve(problem, seed=0)
    assert plan.verified
    assert (plan.iterations, plan.denoising_steps) == (1, 0)
    return plan


@pytest.mark.parametrize("arrival", ["stay", "dock"])
def test_a_robot_parks_between_two_obstacles(arrival: str) -> None:
    boxes = [[1.6, 0.0, 2.3, 0.3], [3.0, 0.0, 3.7, 0.3]]
    plan = solved(problem_of([[1.0, 0.6, 0.0]], [[2.65, 0.15, 0.0]], boxes, arrival=arrival))
    assert plan.metrics["makespan"] < 15


@pytest.mark.parametrize("model", ["unicycle", "car_first_order"])
def test_a_place_that_only_the_finest_cells_lead_into(model: str) -> None:
    world = World(boxes=[[0.6, 0.0, 2.0, 0.3], [2.95, 0.0, 4.95, 0.3]], lower=[0, 0], upper=[5, 2.2])
    team = Team((model,), footprint=Box(0.5, 0.25))
    solved(
        Problem(
            team, [[0.8, 1.2, 0.0]], [[2.475, 0.16]], world, horizon=800, margin=0.01, goal_radius=0.05,
            goal_heading=0.0, goal_heading_tolerance=0.15, arrival="stay",
        )
    )  # fmt: skip


@pytest.mark.parametrize("model", ["car_first_order", slow("car")])
def test_a_place_that_leads_on_from_beside_the_goal_only(model: str) -> None:
    """So near to the kerb no turn is small enough; a little farther from it the robot has arrived as well."""
    world = World(boxes=[[0.0, 0.0, 1.55, 0.4], [2.45, 0.0, 5.0, 0.4]], lower=[0, 0], upper=[5, 2])
    team = Team((model,), footprint=Box(0.6, 0.3))
    start = [[1.7, 0.9, 0.4, *[0.0] * (team.state_size - 3)]]
    solved(
        Problem(
            team, start, [[2.0, 0.2]], world, horizon=800, margin=0.02, goal_radius=0.04, goal_heading=0.0,
            goal_heading_tolerance=0.05,
        )
    )  # fmt: skip


def test_searches_in_the_same_nodes_have_numbers_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, int]] = []

    def search(self: TeamMotions, number: int, traffic: Any, nodes: Any, search: int, *_: Any) -> None:
        seen.append((id(nodes.marks), search))

    monkeypatch.setattr(TeamMotions, "_search", search)
    problem = problem_of([[1.0, 0.6, 0.0]], [[2.65, 0.15, 0.0]], [])
    assert TeamMotions.prepared(problem, lambda: False) is None
    assert len(seen) == len(set(seen)) > 2


def test_robots_that_meet_in_a_corridor_use_its_alcove() -> None:
    start, goal = [[0.7, 0.65, 0.0], [5.3, 0.65, np.pi]], [[5.3, 0.65, 0.0], [0.7, 0.65, np.pi]]
    plan = solved(problem_of(start, goal, CORRIDOR))
    # Lower than anywhere else in the corridor.
    assert plan.trajectory.positions[..., 1].min() < 0.3 + 0.125


def test_one_sets_out_late_where_two_would_meet_before_the_bay() -> None:
    walls = [[-0.2, -0.3, 6.2, 0.0], [-0.2, 0.6, 2.6, 1.3], [3.4, 0.6, 6.2, 1.3], [2.6, 1.3, 3.4, 1.6]]
    world = World(boxes=walls, lower=(-0.2, -0.3), upper=(6.2, 1.6))
    team = Team(("unicycle2",) * 2, footprint=Box(0.5, 0.25), max_turn_rate=1.5, own_limits={"max_reverse_speed": 0.5})
    ends, headings = np.array([[0.4, 0.3], [5.6, 0.3]]), np.array([0.0, np.pi])
    start = np.column_stack([ends, headings, np.zeros((2, 2))])
    solved(Problem(team, start, ends[::-1], world, margin=0.02, goal_heading=headings, horizon=600))


def test_a_robot_at_its_goal_makes_way_and_returns() -> None:
    start, goal = [[0.7, 0.65, 0.0], [3.1, 0.65, 0.0]], [[5.3, 0.65, 0.0], [3.1, 0.65, 0.0]]
    plan = solved(problem_of(start, goal, CORRIDOR))
    assert np.abs(plan.trajectory.positions[:, 1] - goal[1][:2]).max() > 0.25


def test_a_car_backs_into_its_place() -> None:
    team = Team(("car",), footprint=Box(0.5, 0.25, 0.15))
    world = World(boxes=[[0.2, 0.4, 1.6, 0.9], [0.2, -0.9, 1.6, -0.4]], lower=(-0.1, -2.0), upper=(4.0, 2.0))
    plan = solved(Problem(team, [[2.5, 0.0, 0.5, 0.0, 0.0]], [[0.7, 0.0]], world, goal_heading=0.0, horizon=200))
    assert plan.trajectory.states[:, 0, 3].min() < 0


def kind_of(model: str) -> Kind:
    """A robot with a model's usual limits, at rest."""
    own = [limit.default for limit in MODELS[model].own_limits]
    extra = MODELS[model].state_size - (2 if MODELS[model].heading_index is None else 3)
    return Kind(model, (1.0, 1.0, 1.5, *own), 0.1, 0.1, (0.0,) * extra)


@pytest.mark.parametrize("model", MOVES)
def test_primitives_lead_back_where_they_began(model: str) -> None:
    """Those backwards in time undo those ahead: every position is passed in both, and the steps are as many."""
    ahead, back, modes = primitives_of(kind_of(model))
    assert len(ahead.begin) == len(back.begin) == len(modes) + 1
    assert ahead.rests[0]
    ends = np.linalg.norm(ahead.poses[ahead.first[1:] - 1, :2], axis=1)
    for end in np.linalg.norm(back.poses[back.first[1:] - 1, :2], axis=1):
        assert np.abs(ends - end).min() < 1e-9


def test_a_robot_that_turns_does_not_wait() -> None:
    moves, _, modes = primitives_of(kind_of("unicycle2"))
    assert moves.rests.tolist() == [mode == (0.0, 0.0) for mode in modes]
    assert any(speed == 0 != rate for speed, rate in modes)


def test_second_order_unicycles_turn_on_without_stopping() -> None:
    own = {"max_turn_acceleration": 0.25}
    team = Team(("unicycle2",), None, 0.5, 0.25, 0.5, own, Box(0.5, 0.25))
    world = World(boxes=[[1.9, 1.9, 2.1, 2.1]], lower=(0, 0), upper=(5, 5))
    plan = solved(Problem(team, [[1, 1, 0, 0, 0]], [[3, 1.5]], world, goal_heading=2.5, horizon=600))
    assert plan.metrics["makespan"] < 16


def test_robots_with_a_limited_jerk_are_planned_with_others() -> None:
    world = World(boxes=[[1.9, 1.9, 2.1, 2.1]], lower=(0, 0), upper=(4, 4))
    team = Team(("holonomic2d_jerk", "unicycle"), footprint=Box(0.5, 0.25))
    start = np.array([[1, 1, 0], [3, 3, 0]])
    solved(Problem(team, np.pad(start, ((0, 0), (0, 3))), start[::-1, :2], world, goal_heading=[np.nan, 1.0]))


def test_moves_longer_than_a_search_has_room_for_are_left_out() -> None:
    """A robot that reverses by a hair's breadth in a step would take millions of them."""
    usual = kind_of("unicycle1")
    crawling = replace(usual, limits=(*usual.limits[:3], 1e-5, *usual.limits[4:]))
    ahead, back, _ = primitives_of(crawling)
    assert np.diff(ahead.first).max() <= MAX_STEPS
    assert 0 < len(ahead.mode) < len(primitives_of(usual)[0].mode)
    assert len(back.mode) > 0


def test_a_car_whose_trailer_can_hardly_swing_drives_straight_only() -> None:
    """No circle is wide enough for its hitch angle, and there is none to end in either."""
    usual, column = kind_of("car_with_1_trailer"), MODELS["car_with_1_trailer"].state_limits[0][1]
    stiff = replace(usual, limits=(*usual.limits[:column], 0.01, *usual.limits[column + 1 :]))
    assert primitives_of(stiff)[2] == ((0.0,),)
    assert curves_of(stiff.base, bent=False) is NO_CURVES


@pytest.mark.parametrize(("gap", "safe"), [(0.045, 2), (-0.005, NEVER)])
def test_a_pose_is_safe_once_another_robot_has_passed_it_in_its_last_step(gap: float, safe: int) -> None:
    """From then on it is as far away as it stays, or else in the way for ever."""
    problem = problem_of([[1.0, 0.5, 0.0], [4.0, 0.5, 0.0]], [[2.0, 0.5, 0.0], [5.0, 0.5, 0.0]], CORRIDOR[:1])
    scene = scene_of(problem)
    poses = np.zeros((2, 2, POSE_SIZE), np.float32)
    poses[1, :, 0], poses[1, :, 1] = (2.0 + 0.5 - 0.005, 2.0 + 0.5 + gap), 0.5
    last, gone = np.array([-1, 1]), np.full(2, NEVER)
    traffic = traffic_of(poses, last, gone, scene.area.low, scene.area.high, scene.interaction_range)
    buffer = np.zeros(buffer_size(problem.team.all_footprint_arrays), np.float32)

    @njit
    def since(body: Any, traffic: Any, pose: Any, buffer: Any) -> int:
        return safe_since(body, traffic, pose, buffer)

    assert since(scene.body(0), traffic, np.array([2.0, 0.5, 0.0, 0.0, 0.0, 0.0]), buffer) == safe


def test_a_robot_whose_motion_fails_has_another_one_even_after_a_solution() -> None:
    """The judge may refuse what the search took for free, in the first plan as well as in a better one."""
    problem = problem_of([[1.0, 0.65, 0.0], [4.0, 0.65, 0.0]], [[2.0, 0.65, 0.0], [5.0, 0.65, 0.0]], CORRIDOR)
    motions = TeamMotions.prepared(problem, lambda: False)
    assert motions is not None
    motions.plan_all()
    dropped: list[int] = []

    def leave_out(robots: list[int]) -> None:
        dropped.extend(robots)
        TeamMotions.leave_out(motions, robots)

    motions.leave_out = leave_out  # type: ignore[assignment, method-assign]
    run: Any = SimpleNamespace(
        best=SimpleNamespace(solved=True),
        current=SimpleNamespace(unsolved=np.array([False, True])),
        iteration_seed=lambda stream: 0,
        should_stop=lambda: False,
    )
    improve_manoeuvres(run, motions)
    assert dropped == [1]
    assert motions.missing == 0


@pytest.mark.parametrize("count", [1, 2, slow(3)])
def test_swings_end_at_the_hitch_angles_of_a_circle(count: int) -> None:
    """There, held to its steering angle, the model goes on in the circle with trailers as they are."""
    kind = kind_of(f"car_with_{count}_trailer" + "s" * (count > 1))
    curves = curves_of(kind, bent=False)
    for circle in range(len(curves.curvature)):
        middle, end = curves.begin[2 * circle + 1 : 2 * circle + 3]
        last = (0.0, 0.0, 0.0, *curves.poses[middle - 1, 3 : 3 + count])
        control = np.array([[curves.stride[circle] / kind.dt, curves.steering[circle]]], np.float32)
        np.testing.assert_allclose(kind.states(last, control)[-1][3:], last[3:], atol=1e-5)
        np.testing.assert_allclose(curves.poses[end - 1, 3:], 0.0, atol=1e-5)


def trailers(start: Any, goal: Any, boxes: Any = (), **arguments: Any) -> Problem:
    """Cars with a trailer that reverse slowly; starts ``(x, y, heading, hitch)``, goals ``(x, y, heading)``."""
    goals, footprint = np.array(goal, float), Train(Box(0.5, 0.25), [Box(0.3, 0.25)])
    own = {"max_reverse_speed": 0.1, "wheelbase": 0.25, "max_steering": 1.0}
    team = Team(("car_with_1_trailer",) * len(goals), max_speed=0.5, own_limits=own, footprint=footprint)
    usual = {"margin": 0.0, "goal_radius": 0.01, "goal_heading_tolerance": 0.01, "arrival": "stay", "horizon": 400}
    world = World(boxes=boxes, lower=(0.0, 0.0), upper=(5.0, 5.0))
    return Problem(team, start, goals[:, :2], world, goal_heading=goals[:, 2], **usual | arguments)


@pytest.mark.slow
def test_cars_with_trailers_swap() -> None:
    start = [[1.0, 2.5, 0.0, 0.2], [4.0, 2.5, np.pi, 0.0]]
    plan = solved(trailers(start, [[4.0, 2.5, 0.0], [1.0, 2.5, np.pi]]))
    np.testing.assert_allclose(plan.trajectory.states[-1, :, 3], 0.0, atol=0.01)


def test_a_trailer_that_would_not_fit_in_line_stays_in_a_bend() -> None:
    # At the goal the trailer in line would be in the box, by 0.01 m.
    plan = solved(trailers([[0.8, 3.6, -0.8, 0.0]], [[2.5, 2.5, 0.0]], [[1.6, 2.0, 2.05, 2.385]]))
    assert abs(plan.trajectory.states[-1, 0, 3]) > 0.05


def test_a_first_order_car_parks_beside_a_wall_and_between_two_others() -> None:
    """It cannot turn on the spot: it backs in, along a curve that ends exactly at its goal."""
    own = {"max_steering": np.arctan(0.5)}
    team = Team(("car_first_order",), own_limits=own, footprint=Box(0.5, 0.25, offset=0.12))
    world = World(boxes=[[0.8, 0.0, 1.6, 0.3], [3.0, 0.0, 3.8, 0.3]], lower=(0.0, 0.0), upper=(5.0, 3.0))
    problem = Problem(
        team, [[0.8, 1.0, 0.0]], [[2.25, 0.16]], world, horizon=600, margin=0.0, goal_radius=0.01, goal_heading=0.0,
        goal_heading_tolerance=0.01,
    )  # fmt: skip
    plan = solved(problem)
    assert (plan.controls[..., 0] < 0).any()


def test_a_car_that_stops_to_steer_parks_in_a_gap_hardly_longer_than_itself() -> None:
    """With moves at full speed as well its search runs out of nodes."""
    world = World(boxes=[[-3, -1, -0.5, -0.4], [0.5, -1, 3, -0.4], [-3, -1.2, 3, -1]], lower=(-3, -1.2), upper=(3, 1.5))
    team = Team(("car",), footprint=Box(0.6, 0.3))
    solved(Problem(team, [[-2, 0, 0, 0, 0]], [[0, -0.7]], world, horizon=300, goal_heading=0.0))


@pytest.mark.parametrize("model", ["unicycle", "car_first_order", slow("car")])
@pytest.mark.parametrize("kerb", [True, False])
def test_a_robot_parks_in_a_gap_of_its_length_and_a_third(model: str, kerb: bool) -> None:
    """The usual search runs out of nodes in front of it."""
    low = 0.0 if kerb else 0.8
    world = World(boxes=[[1.0, low, 1.61, low + 0.4], [2.39, low, 3.0, low + 0.4]], lower=[0, 0], upper=[4, 2.5])
    team = Team((model,), footprint=Box(0.6, 0.3))
    start = [[0.7, 1.7, 0.3, *[0.0] * (team.state_size - 3)]]
    solved(
        Problem(
            team, start, [[2.0, low + 0.2]], world, horizon=1500, margin=0.02, goal_radius=0.04, goal_heading=0.0,
            goal_heading_tolerance=0.1,
        )
    )  # fmt: skip


@pytest.mark.parametrize("model", ["car", "differential_drive"])
def test_a_robot_that_reverses_slowly_backs_out_of_a_dead_end(model: str) -> None:
    """It is too narrow to turn in."""
    walls = [[-1.0, 0.3, 1.0, 0.6], [-1.0, -0.6, 1.0, -0.3], [-1.3, -0.6, -1.0, 0.6]]
    team = Team((model,), footprint=Box(0.8, 0.3), own_limits={"max_reverse_speed": 0.2})
    start = [[-0.5, 0.0, np.pi, *[0.0] * (team.state_size - 3)]]
    world = World(boxes=walls, lower=(-1.3, -2.0), upper=(4.0, 2.0))
    plan = solved(Problem(team, start, [[3.0, 0.0]], world, horizon=400, goal_heading=0.0))
    assert plan.trajectory.states[..., 3].min() == pytest.approx(-0.2)


@pytest.mark.parametrize("model", ["car_first_order", slow("car")])
@pytest.mark.parametrize("out", [False, True])
def test_a_car_gets_into_and_out_of_a_gap_where_only_short_moves_have_room(model: str, out: bool) -> None:
    """Costs spread from the goal in usual cells end in the gap, which is 1.4 times as long as the car."""
    world = World(boxes=[[1, -0.45, 2.08, 0], [2.92, -0.45, 4, 0]], lower=(1, -0.45), upper=(4, 1))
    poses = [[1.4, 0.55, 0.0], [2.5, -0.225, 0.0]]
    start, goal = poses[::-1] if out else poses
    state = [start + [0.0] * (MODELS[model].state_size - 3)]
    team = Team((model,), footprint=Box(0.6, 0.3))
    solved(Problem(team, state, [goal[:2]], world, goal_heading=0.0, margin=0.02, horizon=600, arrival="stay"))


def test_a_way_into_a_gap_that_takes_too_long_is_none() -> None:
    world = World(boxes=[[1, -0.45, 2.08, 0], [2.92, -0.45, 4, 0]], lower=(1, -0.45), upper=(4, 1))
    team, start = Team(("car_first_order",), footprint=Box(0.6, 0.3)), [[1.4, 0.55, 0.0]]
    problem = Problem(team, start, [[2.5, -0.225]], world, goal_heading=0.0, margin=0.02, horizon=20)
    assert TeamMotions.prepared(problem, lambda: False) is None
    assert TeamMotions.prepared(problem.replace(horizon=60), lambda: False) is not None


def test_discs_without_headings_are_planned_otherwise() -> None:
    """Others have the same plans as ever, and nothing new to compile."""
    team = Team(("unicycle", "unicycle"))
    assert not can_plan(Problem(team, [[0, 0, 0], [0, 2, 0]], [[2, 0], [2, 2]]))
    assert can_plan(Problem(team, [[0, 0, 0], [0, 2, 0]], [[2, 0], [2, 2]], goal_heading=[np.nan, 1.0]))


def test_cars_on_their_way_come_to_rest_before_they_manoeuvre() -> None:
    """Their primitives begin at rest; a drive among them turns in place and stops too."""
    team = Team(("car", "car", "unicycle"))
    start = [[0, 0, 3, 0.9, 0.4], [0, 2, 2, 0.5, -0.3], [2, 1, 2.5, 0, 0]]
    problem = Problem(team, start, [[1.5, 0], [1.5, 2], [-1, 1]], goal_heading=[1.0, -2.0, np.nan], horizon=200)
    plan = solved(problem)
    assert plan.metrics["travel_time"] < 8  # samples, which begin as it moves, take twice as long
    # Nobody can brake in time: others are left to solve it.
    late = problem.with_state([[0, 0, 0, 0.9, 0], [0.45, 0, 3.1, 0.9, 0], [2, 1, 2.5, 0, 0]], problem.goal)
    assert come_to_rest(late, get_sampling_engine("cpu")) is None


def test_teams_that_can_stay_as_they_move_do() -> None:
    start, goal = [[0, 0, 0.5, 0.4, 0], [0, 2, 0, 0, 0]], [[2, 0], [2, 2]]
    assert not can_plan(Problem(Team(("unicycle2",) * 2), start, goal, goal_heading=1.0))
    at_rest = Problem(Team(("unicycle2",) * 2), [[0, 0, 0.5, 0, 0], start[1]], goal, goal_heading=1.0)
    assert can_plan(at_rest)
    assert come_to_rest(at_rest, get_sampling_engine("cpu"))[1] is at_rest
    # A speed that no control changes at once.
    jerky = [[0, 0, 0.5, 0, 0, 0], [0, 2, 0, 0, 0, 0]]
    assert not can_brake(Problem(Team(("holonomic2d_jerk",) * 2), jerky, goal))
