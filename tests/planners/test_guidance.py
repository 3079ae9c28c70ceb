"""Path finding on a roadmap: moves that never meet, who goes first, drives that keep clear, and what users get."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numba
import numpy as np
import pytest
from env_support import slow
from hypothesis import given, settings
from hypothesis import strategies as st
from planner_support import walled_in_problem

from d4orm_env import Problem, Team, World, make_problem, verify
from d4orm_env.dynamics.models import MODELS
from d4orm_env.engine.threads import Threads
from d4orm_env.footprints import Box, Disc
from d4orm_planners import make_planner
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.mapf.lacam import TeamMoves, TeamOnRoadmap, find_moves
from d4orm_planners.mapf.lns import search_neighbourhoods
from d4orm_planners.mapf.occupancy import Occupancy
from d4orm_planners.mapf.one_by_one import plan_one_by_one
from d4orm_planners.mapf.planner import ONE_BY_ONE, RoadmapPaths, needs_detour
from d4orm_planners.mapf.precedence import join_routes, make_routes, stops_of
from d4orm_planners.mapf.replanning import find_path
from d4orm_planners.mapf.reservations import Trip, make_reservations, steps_to_turn
from d4orm_planners.mapf.roadmap import Roadmap, lay_roadmap
from d4orm_planners.mapf.roadmap_team import Replanning, TeamRollout, drive_moves
from d4orm_planners.tracking.path_drives import Corners
from d4orm_planners.tracking.pursuit import gear_towards
from d4orm_planners.tracking.timed_path import drive_by_clock


def walled(
    start: Any, goal: Any, boxes: Any = (), bounds: Any = ((-4, -4), (4, 4)), radius: float = 0.15, **arguments: Any
) -> Problem:
    """Holonomic robots that stand still at first, in a room with boxes."""
    states = np.hstack([np.asarray(start, float), np.zeros((len(start), 2))])
    world = World(dimension=2, boxes=boxes, lower=bounds[0], upper=bounds[1])
    team = Team(("holonomic2d",) * len(start), radius=radius)
    return Problem(team, states, goal, world, **{"horizon": 400, **arguments})


def corridor_with_bay(right: float = 2.0) -> Problem:
    """Two robots that exchange places in a corridor for one, with a bay in the middle."""
    boxes = [[-4, 0.3, -0.3, 1.0], [0.3, 0.3, 4, 1.0], [-4, -1.0, 4, -0.3]]
    bounds = ((-3, -1), (3, 1))
    return walled([[-2, 0], [right, 0]], [[2, 0], [-2, 0]], boxes, bounds)


def found(problem: Problem, fineness: float = 1.0, seed: int = 0) -> tuple[Roadmap, TeamMoves]:
    roadmap = lay_roadmap(problem, fineness)
    moves = find_moves(problem, roadmap, seed, lambda: False, 3000)
    assert moves is not None
    return roadmap, moves


def test_a_robot_that_starts_near_an_arrived_one_has_a_path_away_from_it() -> None:
    """It may leave its own start, however near that is to another robot's goal, if it comes no nearer."""
    problem = walled([[2, 0], [0, 0]], [[0.37, 0], [-2, 0]], margin=0.05)
    team = TeamOnRoadmap(problem, lay_roadmap(problem))
    team.fill(1, np.array([True, False]))
    assert np.isfinite(team.bodies.costs[1, team.roadmap.starts[1]])


def assert_moves_keep_clear(problem: Problem, roadmap: Roadmap, moves: TeamMoves) -> None:
    """One after another, each past all others where they stand at that moment."""
    at, radius = roadmap.starts.copy(), np.asarray(problem.team.radius, float)
    for robot, edge in moves.moves:
        assert roadmap.first[at[robot]] <= edge < roadmap.first[at[robot] + 1], "moves go from where a robot is"
        tail, head = roadmap.nodes[at[robot]], roadmap.nodes[roadmap.heads[edge]]
        others = np.arange(problem.num_robots) != robot
        step, positions = head - tail, roadmap.nodes[at[others]]
        share = np.clip((positions - tail) @ step / (step @ step), 0, 1)
        gaps = np.linalg.norm(positions - tail - share[:, None] * step, axis=1)
        assert (gaps > radius[others] + radius[robot] + problem.margin - 1e-6).all()
        at[robot] = roadmap.heads[edge]
    np.testing.assert_array_equal(at == roadmap.goals, moves.arrived)


# The roadmap.


def test_edges_of_the_roadmap_keep_clear_of_walls_on_all_their_length() -> None:
    problem = make_problem("rooms", num_robots=6, seed=2)
    roadmap = lay_roadmap(problem, 1.6)
    tails = np.repeat(np.arange(len(roadmap.nodes)), np.diff(roadmap.first))
    for share in np.linspace(0, 1, 21):
        positions = roadmap.nodes[tails] * (1 - share) + roadmap.nodes[roadmap.heads] * share
        # Starts and goals may be nearer than other places.
        own = np.minimum(
            *(problem.world.clearance(roadmap.nodes[ends][:, :2]) for ends in (tails, roadmap.heads.astype(int)))
        )
        room = problem.world.clearance(positions[:, :2])
        assert (room > np.minimum(0.2, own) - 0.2 / 100).all()


def test_starts_and_goals_are_nodes_of_their_own() -> None:
    problem = make_problem("maze", num_robots=5, seed=0)
    roadmap = lay_roadmap(problem)
    np.testing.assert_array_equal(roadmap.nodes[roadmap.starts, :2], problem.start[:, :2].astype(float))
    np.testing.assert_array_equal(roadmap.nodes[roadmap.goals, :2], problem.goal.astype(float))


def test_what_is_near_an_edge_is_what_brute_force_finds() -> None:
    roadmap = lay_roadmap(make_problem("forest", num_robots=4, seed=1))
    tails = np.repeat(np.arange(len(roadmap.nodes)), np.diff(roadmap.first))
    reach = 2 * 0.15 + 0.05 + 0.06 + 0.075
    for edge in range(0, len(tails), 37):
        tail, step = roadmap.nodes[tails[edge]], roadmap.nodes[roadmap.heads[edge]] - roadmap.nodes[tails[edge]]
        share = np.clip((roadmap.nodes - tail) @ step / (step @ step), 0, 1)
        gaps = np.linalg.norm(roadmap.nodes - tail - share[:, None] * step, axis=1)
        own = slice(roadmap.near_first[edge], roadmap.near_first[edge + 1])
        np.testing.assert_array_equal(roadmap.near[own], np.flatnonzero(gaps < reach))
        np.testing.assert_allclose(roadmap.gaps[own], gaps[roadmap.near[own]], atol=1e-12)


# Path finding.


def test_two_robots_exchange_positions_in_a_corridor_by_its_bay() -> None:
    problem = corridor_with_bay()
    roadmap, moves = found(problem)
    assert moves.arrived.all()
    assert_moves_keep_clear(problem, roadmap, moves)
    at, aside = roadmap.starts.copy(), False
    for robot, edge in moves.moves:
        at[robot] = roadmap.heads[edge]
        aside |= bool(roadmap.nodes[at[robot], 1] > 0.4)
    assert aside, "one of them has been in the bay"


def test_without_the_bay_they_cannot_and_the_search_ends() -> None:
    boxes = [[-4, 0.3, 4, 1.0], [-4, -1.0, 4, -0.3]]
    problem = walled([[-2, 0], [2, 0]], [[2, 0], [-2, 0]], boxes, ((-3, -1), (3, 1)))
    _, moves = found(problem)
    assert not moves.arrived.all()


def test_a_ring_of_robots_moves_on() -> None:
    corners = np.array([[-0.3, -0.3], [0.3, -0.3], [0.3, 0.3], [-0.3, 0.3]])
    problem = walled(corners, np.roll(corners, -1, axis=0))
    roadmap, moves = found(problem)
    assert moves.arrived.all()
    assert_moves_keep_clear(problem, roadmap, moves)


@pytest.mark.parametrize("arrival", ["dock", "stay"])
def test_a_goal_that_closes_a_corridor_is_taken_last(arrival: str) -> None:
    """The goal of robot 0 lies in the middle of the only corridor, through which robot 1 has to go."""
    boxes = [[-1, 0.3, 1, 4], [-1, -4, 1, -0.3]]
    problem = walled([[-1.6, 0], [-3, 1]], [[0, 0], [3, 1]], boxes, arrival=arrival)
    roadmap, moves = found(problem)
    assert moves.arrived.all()
    assert_moves_keep_clear(problem, roadmap, moves)
    if arrival == "dock":
        last = [int(np.flatnonzero(moves.moves[:, 0] == robot)[-1]) for robot in range(2)]
        through = roadmap.nodes[roadmap.heads[moves.moves[:, 1]], 0]
        passed = np.flatnonzero((moves.moves[:, 0] == 1) & (through > 0.5))[0]
        assert passed < last[0]


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 10**6), st.integers(2, 12), st.sampled_from(["rooms", "maze", "forest", "random"]))
def test_moves_keep_clear_of_everybody(seed: int, num_robots: int, scenario: str) -> None:
    problem = make_problem(scenario, num_robots=num_robots, seed=seed)
    roadmap = lay_roadmap(problem, 1.6)
    moves = find_moves(problem, roadmap, seed, lambda: False, 200)
    if moves is not None:
        assert_moves_keep_clear(problem, roadmap, moves)


def test_robots_of_any_size_keep_clear() -> None:
    problem = make_problem("rooms", num_robots=5, seed=0, radius=[0.1, 0.2, 0.15, 0.1, 0.2], room_size=3.0)
    roadmap, moves = found(problem, 1.6)
    assert moves.arrived.all()
    assert_moves_keep_clear(problem, roadmap, moves)


# Who goes first.


def test_who_goes_first_is_never_decided_in_a_ring() -> None:
    """Driven as they may be, point by point and in any order, all come to the end of their routes."""
    problem = make_problem("rooms", num_robots=12, seed=1)
    roadmap, moves = found(problem, 1.25)
    stops = stops_of(roadmap, moves.moves, problem.num_robots)
    routes = join_routes(problem, make_routes(problem, stops, range(problem.num_robots), 0.03))
    at, ends, moved = np.zeros(problem.num_robots, int), np.diff(routes.first) - 1, True
    while moved:
        moved = False
        for robot in range(problem.num_robots):
            waits = slice(routes.wait_first[robot], routes.wait_first[robot + 1])
            over = at[routes.wait_for[waits]] >= routes.wait_until[waits]
            closed = routes.wait_at[waits][~over]
            limit = min(closed.min() - 1, ends[robot]) if len(closed) else ends[robot]
            moved |= bool(limit > at[robot])
            at[robot] = max(at[robot], limit)
    np.testing.assert_array_equal(at, ends)


# Driving.


@pytest.mark.parametrize("model", [name for name in MODELS if name in ("holonomic2d", "velocity2d", "unicycle")])
def test_a_drive_along_found_moves_is_what_the_engine_makes_of_its_controls(model: str) -> None:
    problem = make_problem("maze", num_robots=6, seed=1, model=model, horizon=900)
    roadmap, moves = found(problem, 1.25)
    driven = drive_moves(problem, roadmap, moves.moves)
    trajectory = get_sampling_engine("cpu").rollout(problem, driven.until(problem.horizon))
    steps = len(driven.controls)
    # A control inside the limits is clipped once more, which may round it.
    np.testing.assert_allclose(trajectory.positions[: steps + 1], driven.positions[:, :, :2], atol=1e-4)
    np.testing.assert_array_equal(trajectory.arrived.argmax(axis=0), driven.arrivals)
    assert verify(problem, driven.until(problem.horizon)).ok


@numba.njit
def gear(along: float, across: float, speed: float, backs_up: bool) -> float:
    return float(gear_towards(np.float32(along), np.float32(across), np.float32(speed), backs_up))


@pytest.mark.parametrize(
    ("degrees", "speed", "swings_round", "backs_up"),
    [
        (0, 0, 1, 1), (180, 0, -1, -1), (10, -1, 1, 1), (-170, 1, -1, -1),
        # Aside, a robot that drives goes on in its gear, and one that backs up does so until the point is ahead.
        (80, 0, 1, -1), (-80, 0, 1, -1), (100, 0, -1, 1), (40, 1, 1, 1), (30, -1, 1, -1),
        (115, 1, 1, 1), (65, -1, -1, -1), (125, 1, -1, 1), (55, -1, 1, -1),
    ],
)  # fmt: skip
def test_a_robot_that_turns_as_it_drives_chooses_its_gear(
    degrees: float, speed: float, swings_round: int, backs_up: int
) -> None:
    along, across = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    assert gear(along, across, speed, False) == swings_round
    assert gear(along, across, speed, True) == backs_up


@pytest.mark.parametrize("heading", np.arange(-180, 180, 45))
@pytest.mark.parametrize("path", [[(0, 0), (3, 0)], [(0, 0), (2, 0), (2, 2)], [(0, 0), (1.5, 0), (1.5, 1), (0, 1)]])
@pytest.mark.slow
def test_a_car_follows_a_route_from_every_heading(path: Any, heading: float) -> None:
    start = [[0, 0, np.radians(heading), 0, 0]]
    problem = Problem(Team(("car",)), start, [path[-1]], World(dimension=2), horizon=400)
    corners = np.hstack([np.array(path, float), np.zeros((len(path), 1))])
    times = np.arange(len(path)) * 40.0
    stops = Corners(corners, np.array([0, len(path)]), np.append(-1.0, times[:-1]), times)
    (route,) = make_routes(problem, stops, [0], 0.1)
    turning = problem.team.turning_radius[0]
    assert (route.bends > turning - 1e-6).all()
    for backs_up in (False, True):
        controls, positions, arrival = drive_by_clock(problem, 0, route, stops, 400, hurrying=True, backs_up=backs_up)
        assert arrival <= 400
        assert verify(problem.replace(horizon=arrival + 1), controls[: arrival + 1, None]).ok
        gaps = np.linalg.norm(positions[: arrival + 1, None] - route.points, axis=2).min(axis=1)
        # It leaves the route no farther than turning round takes, and is on it in the end.
        assert gaps.max() < 4 * turning
        assert gaps[arrival - 5 :].max() < 0.1


@pytest.mark.parametrize(
    ("scenario", "seed"), [("corridor", 3), ("corridor", 4), ("doorway", 4), ("maze", 5), ("rooms", 4)]
)
def test_a_car_alone_finds_its_way_among_walls(scenario: str, seed: int) -> None:
    problem = make_problem(scenario, num_robots=1, seed=seed, model="car")
    plan = make_planner("mapf").solve(problem, seed=0, max_iterations=4)
    assert plan.solved
    assert verify(problem, plan.controls).ok


@pytest.mark.parametrize("fault", ["nobody", "across", "ahead"])
def test_a_path_in_space_and_time_lets_others_pass(fault: str) -> None:
    """Another robot crosses, or drives the same way ahead and stops for a while where both have to go."""
    boxes = [[-0.3, 0.35, 0.3, 4], [-0.3, -4, 0.3, -0.35]]
    problem = walled([[-2, 0], [3, 3]], [[2, 0], [3, 2]], boxes)
    roadmap = lay_roadmap(problem, 1.25)
    replanning = Replanning(problem, roadmap)
    positions = np.full((401, 2, 3), 1e9)
    if fault != "nobody":
        # It stands in the door until step 100, and then is gone.
        positions[:100, 1] = [0.0, 0.0, 0.0]
    if fault == "ahead":
        positions[100:200, 1] = np.linspace([0, 0, 0], [3, 3, 0], 100)
        positions[200:, 1] = [3, 3, 0]
    others = Occupancy(replanning.cells, positions).around(np.array([0.0, 0.41]))
    bodies = replanning.bodies
    reservations = make_reservations(roadmap, bodies, others, 0, 400, True)
    path = find_path(roadmap, bodies, reservations, 0, Trip(0.09, 4, 400, -1))
    assert path[0].tolist() == [roadmap.starts[0], 0, 0]
    assert path[-1, 0] == roadmap.goals[0]
    assert (path[1:, 1] >= path[:-1, 2]).all()
    assert (path[-1, 2] > 100) == (fault != "nobody")
    for (tail, _, _), (head, depart, arrive) in pairwise(path):
        for step in range(depart, arrive + 1):
            share = (step - depart) / (arrive - depart)
            position = roadmap.nodes[tail] * (1 - share) + roadmap.nodes[head] * share
            assert np.linalg.norm(position - positions[step, 1]) >= 0.41 - 1e-9


def test_a_robot_that_turns_first_comes_to_its_goal_as_soon_as_it_may_stay_there() -> None:
    """Another robot passes near the goal from step 50 to 99: the turn before is over by then."""
    problem = walled([[0, 0], [3, 3]], [[0.5, 0], [3, 2]])
    roadmap = lay_roadmap(problem)
    replanning = Replanning(problem, roadmap)
    positions = np.full((401, 2, 3), 1e9)
    positions[50:100, 1] = [0.905, 0.0, 0.0]
    others = Occupancy(replanning.cells, positions).around(np.array([0.0, 0.41]))
    reservations = make_reservations(roadmap, replanning.bodies, others, 0, 400, True)
    trip = Trip(0.09, 4, 400, -1, 10.0, (-0.6, 0.8))
    path = find_path(roadmap, replanning.bodies, reservations, 0, trip)
    assert path[:, [0, 2]].tolist() == [[roadmap.starts[0], 0], [roadmap.goals[0], 100]]


def test_turns_on_the_spot_take_steps() -> None:
    """Ten steps a radian, less what is turned while driving; four to brake where the robot does not set out."""
    nodes = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [3.0, 0.5, 0.0]])
    trip = Trip(0.1, 4, 400, -1, 10.0, (0.0, 1.0))
    moves = {"aside": (0, 1, 2), "back": (0, 1, 0), "slightly aside": (0, 1, 3), "from its start": (-1, 0, 1)}
    steps = {move: steps_to_turn.py_func(nodes, trip, *map(np.int64, nodes_of)) for move, nodes_of in moves.items()}
    assert steps == {"aside": 16, "back": 29, "slightly aside": 0, "from its start": 12}
    assert steps_to_turn.py_func(nodes, trip._replace(turn=0.0), np.int64(0), np.int64(1), np.int64(2)) == 0


@pytest.mark.slow
def test_a_crowd_of_robots_that_turn_on_the_spot_is_planned() -> None:
    """Not without counting their turns: they come too late everywhere, and meet each other."""
    problem = make_problem("warehouse", num_robots=24, seed=2, model="differential_drive", shelves=(1, 3))
    plan = make_planner("mapf").solve(problem, seed=0, max_iterations=1)
    assert plan.solved
    assert verify(problem, plan.controls).ok


@pytest.mark.slow
@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive"])
def test_a_crowd_of_boxes_is_planned_one_by_one(model: str) -> None:
    """Not where robots take the places of others that find none: in a crowd as many always wait for theirs."""
    problem = make_problem("warehouse", num_robots=100, seed=1, footprint=Box(0.36, 0.24), model=model)
    replanning = Replanning(problem, lay_roadmap(problem, ONE_BY_ONE[0]))
    assert plan_one_by_one(replanning, np.random.default_rng(1), lambda: False, 200) is not None


@pytest.mark.parametrize("model", ["holonomic2d", "velocity2d", "differential_drive"])
def test_two_robots_change_places_by_a_bay_that_one_must_reach_first(model: str) -> None:
    """The other sets out late: on time it is at the bay as soon."""
    corridor = World(boxes=[[-4, 0.5, -0.6, 2], [0.6, 0.5, 4, 2], [-4, -2, 4, -0.5]], lower=[-4, -2], upper=[4, 1.6])
    team, goal = Team((model,) * 2, radius=0.28), [[2.5, 0], [-2.5, 0]]
    start = np.zeros((2, team.state_size))
    start[:, 0] = -2.5, 2.5
    problem = Problem(team, start, goal, world=corridor, horizon=400)
    for seed in range(3):
        plan = make_planner("mapf").solve(problem, seed=seed, max_iterations=2)
        assert plan.solved
        assert verify(problem, plan.controls).ok


def test_robots_that_pass_each_others_starts_leave_each_other_time_to_set_out() -> None:
    """Two in one aisle, each of which must turn before it is out of the other's way."""
    problem = make_problem("warehouse", num_robots=15, seed=2, model="differential_drive").select([0, 14])
    replanning = Replanning(problem, lay_roadmap(problem, ONE_BY_ONE[0]))
    driven = plan_one_by_one(replanning, np.random.default_rng(0), lambda: False, 50)
    assert driven is not None
    assert verify(problem, driven.until(problem.horizon)).ok


def test_what_is_replanned_is_better_for_all_together_or_left() -> None:
    problem = make_problem("rooms", num_robots=8, seed=0)
    roadmap, moves = found(problem, 1.25)
    driven, random = drive_moves(problem, roadmap, moves.moves), np.random.default_rng(0)
    paths, kept = RoadmapPaths(Replanning(problem, roadmap), driven, 4, lambda: False), 0
    for _ in range(20):
        before, cost = paths.solution, paths.cost
        search_neighbourhoods(paths, random, 1, paths.should_stop)
        assert paths.cost < cost if paths.solution is not before else paths.cost == cost
        kept += paths.solution is not before
    assert kept > 0
    assert verify(problem, paths.solution.until(problem.horizon)).ok


def test_paths_one_by_one_displace_those_in_the_way() -> None:
    problem = corridor_with_bay(right=1.0)
    replanning = Replanning(problem, lay_roadmap(problem))
    driven = plan_one_by_one(replanning, np.random.default_rng(0), lambda: False, 200)
    assert isinstance(driven, TeamRollout)
    assert driven.cost(problem.horizon)[0] == 0
    assert verify(problem, driven.until(problem.horizon)).ok


@pytest.mark.parametrize("name", ["mapf", "hybrid"])
def test_a_window_hardly_wider_than_robots_is_passed(name: str) -> None:
    """Of 0.5 m, by 0.46 m: no lattice has a line through it that keeps as far off the frame as usual."""
    frame = [[-3, -3, 3, -0.25], [-3, 0.25, 3, 3], [-3, -0.25, -0.25, 0.25], [0.25, -0.25, 3, 0.25]]
    boxes = [[-0.1, y, z, 0.1, up, top] for y, z, up, top in frame]
    team, world = Team(("holonomic3d",) * 2, radius=0.18), World(3, boxes=boxes, lower=[-3] * 3, upper=[3] * 3)
    start, goal = [[-2, -0.4, -0.5, 0, 0, 0], [2, 0.6, 0.3, 0, 0, 0]], [[2, 0.4, -0.5], [-2, -0.5, 0.4]]
    problem = Problem(team, start, goal, world=world, horizon=200)
    plan = make_planner(name).solve(problem, seed=0, max_iterations=3)
    assert plan.solved
    assert verify(problem, plan.controls).ok


def test_paths_are_the_same_on_any_number_of_threads() -> None:
    problem, driven = corridor_with_bay(right=1.0), []
    for threads in (1, 2):
        replanning = Replanning(problem, lay_roadmap(problem))
        replanning.threads = Threads(threads)
        team = plan_one_by_one(replanning, np.random.default_rng(0), lambda: False, 200)
        assert team is not None
        driven.append(team.controls)
    np.testing.assert_array_equal(*driven)


@pytest.mark.parametrize(("room", "planned"), [(2.0, True), (0.5, False), (-np.inf, False)])
def test_robots_may_pass_walls_closer_than_usual_if_that_is_all_they_find(
    room: float, planned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = corridor_with_bay(right=1.0)
    replanning = Replanning(problem, lay_roadmap(problem))
    monkeypatch.setattr(replanning, "room_at_walls", lambda *_: room * problem.rounding)
    driven = plan_one_by_one(replanning, np.random.default_rng(0), lambda: False, 200)
    assert (driven is not None) == planned


def test_a_robot_without_a_path_even_alone_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = corridor_with_bay(right=1.0)
    replanning = Replanning(problem, lay_roadmap(problem))
    usual, failures = replanning.replan_one, iter([False] * 3)
    monkeypatch.setattr(replanning, "replan_one", lambda *given: next(failures, True) and usual(*given))
    driven = plan_one_by_one(replanning, np.random.default_rng(0), lambda: False, 200)
    assert driven is not None
    assert verify(problem, driven.until(problem.horizon)).ok


def test_boxes_without_goal_headings_find_paths_as_discs() -> None:
    problem = make_problem("warehouse", num_robots=6, seed=0, footprint=Box(0.36, 0.24))
    discs = problem.replace(team=problem.team.replace(footprint=Disc(float(problem.team.radius[0]))))
    plan, as_discs = (make_planner(max_iterations=1).solve(case) for case in (problem, discs))
    assert plan.solved
    np.testing.assert_array_equal(plan.controls, as_discs.controls)


# What users get.


@pytest.mark.parametrize(
    ("scenario", "num_robots", "arguments"),
    [
        ("rooms", 12, {}), ("maze", 8, {}), slow("warehouse", 12, {}), ("corridor", 8, {}), ("doorway", 8, {}),
        ("rooms", 8, {"model": "unicycle"}), slow("rooms", 8, {"model": "velocity2d"}),
        slow("forest", 10, {"model": "differential_drive"}), ("forest", 10, {"model": "holonomic3d"}),
        slow("rooms", 4, {"model": "car"}), slow("warehouse", 6, {"model": "car"}),
        ("maze", 4, {"model": "holonomic2d_jerk", "horizon": 600}),
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["mapf", "hybrid"])
def test_teams_among_walls_are_guided(name: str, scenario: str, num_robots: int, arguments: dict[str, Any]) -> None:
    problem = make_problem(scenario, num_robots=num_robots, seed=3, **arguments)
    settings = {} if name == "mapf" else {"start": "mapf"}
    plan = make_planner(name, **settings).solve(problem, seed=1, max_iterations=30)
    assert plan.solved
    assert verify(problem, plan.controls).ok


def test_improving_never_makes_it_worse_and_mostly_better() -> None:
    problem = make_problem("rooms", num_robots=12, seed=0)
    plan = make_planner("mapf", improve=True).solve(problem, max_iterations=6)
    rewards = [record.best_reward for record in plan.history]
    assert rewards == sorted(rewards)
    assert rewards[-1] > rewards[0]


def test_a_goal_without_a_way_is_named_at_once() -> None:
    plan = make_planner("mapf").solve(walled_in_problem(), max_iterations=2)
    assert not plan.solved
    assert plan.history[0].note.startswith("robot_0 has no path from start to goal")


@pytest.mark.parametrize(("scenario", "mapf"), [("circle", False), ("four_obstacles", False), ("maze", True)])
def test_paths_are_found_where_obstacles_lead_far_round(scenario: str, mapf: bool) -> None:
    assert needs_detour(make_problem(scenario, num_robots=8, seed=0)) == mapf


@pytest.mark.parametrize("seed", [0, 1])
def test_who_is_alone_drives_about_as_fast_as_it_can(seed: int) -> None:
    """Along its shortest path at full speed, and as long again as it takes to get to that."""
    problem = make_problem("rooms", num_robots=4, seed=seed, goal_speed=np.inf).select([0])
    plan = make_planner("mapf").solve(problem, seed=0)
    speed, acceleration = problem.team.limits[0, :2]
    assert plan.solved
    assert plan.metrics["travel_time"] < 1.3 * (problem.shortest_paths.length[0] / speed + 0.5 * speed / acceleration)
