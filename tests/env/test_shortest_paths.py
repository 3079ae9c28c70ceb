"""Shortest free paths against visibility graphs in the plane and analytic paths in space."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
from env_support import slow
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from d4orm_env import Problem, Team, World, make_problem, navigation_v0, rollout
from d4orm_env.core.trajectory import mean_stretch, stretch
from d4orm_env.footprints import Box
from d4orm_env.paths.shortest_paths import shortest_paths
from d4orm_planners import make_planner

RADIUS, MARGIN = 0.15, 0.05
REACH = RADIUS + MARGIN


def visible_lengths(world: World, reach: float, source: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Lengths of the shortest paths of a disc of this reach from ``source`` to ``positions`` ``(Q, 2)``.

    Inflated corners are polygons inside of the true arcs, so that lengths are never too large, and hardly too small.
    """
    solid = [shapely.box(*box) for box in world.boxes.tolist()] + [shapely.Polygon(p) for p in world.polygons]
    parts = [shapely.Point(x, y).buffer(r + reach, quad_segs=24) for x, y, r in world.circles.tolist()]
    blocked = shapely.union_all([*parts, shapely.union_all(solid).buffer(reach, quad_segs=6)])
    corners = [source[None], positions]
    for part in shapely.get_parts(blocked):
        oriented = shapely.orient_polygons(part)  # counterclockwise outside, clockwise round holes
        for outline in (oriented.exterior, *oriented.interiors):
            points = np.asarray(outline.coords)[:-1]
            before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
            # Paths turn only where an obstacle bulges out.
            corners.append(points[before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] > 0])
    nodes = np.concatenate(corners)
    low, high = world.bounds.astype(np.float64)
    inside = ((nodes >= low + reach - 1e-9) & (nodes <= high - reach + 1e-9)).all(axis=1)
    inside[: 1 + len(positions)] = True
    nodes = nodes[inside]
    solid_within = blocked.buffer(-1e-6)
    shapely.prepare(solid_within)
    one, other = np.triu_indices(len(nodes), 1)
    free = ~shapely.intersects(solid_within, shapely.linestrings(np.stack([nodes[one], nodes[other]], axis=1)))
    one, other = one[free], other[free]
    gaps = np.linalg.norm(nodes[one] - nodes[other], axis=1)
    graph = csr_array((gaps, (one, other)), shape=(len(nodes), len(nodes)))
    return dijkstra(graph, directed=False, indices=0)[1 : 1 + len(positions)]


def problem_in(world: World, start: object, goal: object, radius: float = RADIUS) -> Problem:
    positions = np.atleast_2d(np.asarray(start, np.float64))
    model = "velocity2d" if world.dimension == 2 else "holonomic3d"
    team = Team((model,) * len(positions), radius=radius)
    states = np.zeros((len(positions), team.state_size))
    states[:, : world.dimension] = positions
    return Problem(team, states, np.atleast_2d(goal), world, margin=MARGIN)


def cells_world(random: np.random.Generator, share: float) -> World:
    """A map of 9 x 9 cells of 0.6 m, free in two opposite corners."""
    blocked = random.random((9, 9)) < share
    blocked[0, 0] = blocked[-1, -1] = False
    corners = np.argwhere(blocked) * 0.6
    return World(boxes=np.hstack([corners, corners + 0.6]), lower=[0, 0], upper=[5.4, 5.4])


def scattered_world(random: np.random.Generator) -> World:
    """Circles and stars, none of them near two opposite corners."""
    circles = np.column_stack([random.uniform(0.5, 5, (14, 2)), random.uniform(0.05, 0.5, 14)])
    away = [np.linalg.norm(circles[:, :2] - corner, axis=1) for corner in (0.3, 5.1)]
    turns = np.arange(5) * 2 * np.pi / 5
    stars = [
        centre + np.stack([np.cos(turns), np.sin(turns)], axis=1) * random.uniform(0.1, 0.6, (5, 1))
        for centre in random.uniform(1.3, 4.1, (4, 2))
    ]
    return World(circles=circles[np.minimum(*away) > circles[:, 2] + 0.5], polygons=stars)


@pytest.mark.parametrize("seed", [0, 1, 2, *(slow(seed) for seed in range(3, 9))])
def test_lengths_are_those_of_visibility_graphs_to_two_percent(seed: int) -> None:
    random = np.random.default_rng(seed)
    world = scattered_world(random) if seed % 3 == 0 else cells_world(random, random.choice([0.15, 0.25, 0.35]))
    radius = float(random.choice([0.1, 0.15, 0.2, 0.22]))
    problem = problem_in(world, [0.3, 0.3], [5.1, 5.1], radius)
    reach = problem.team.radius[0] + MARGIN
    positions = random.uniform(-0.2, 5.6, (150, 2))
    positions = np.concatenate([[[0.3, 0.3]], positions[world.clearance(positions) > reach + 1e-3]])
    expected = visible_lengths(world, reach, problem.goal[0].astype(np.float64), positions)
    lengths = problem.shortest_paths.distance(positions[:, None])[:, 0]
    assert lengths[0] == pytest.approx(problem.shortest_paths.length[0])
    np.testing.assert_array_equal(np.isfinite(lengths), np.isfinite(expected))
    ratio = lengths[np.isfinite(expected)] / expected[np.isfinite(expected)]
    assert ratio.min(initial=1) > 0.999
    assert ratio.max(initial=1) < 1.02


@pytest.mark.parametrize("seed", range(4))
def test_paths_are_as_long_as_they_say_and_free(seed: int) -> None:
    random = np.random.default_rng(100 + seed)
    problem = problem_in(scattered_world(random), [0.3, 0.3], [5.1, 5.1])
    path = problem.shortest_paths.path(0)
    np.testing.assert_array_equal(path[[0, -1]], np.stack([problem.start[0], problem.goal[0]]).astype(np.float64))
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(
        problem.shortest_paths.length[0], rel=1e-9
    )
    points = np.concatenate([a + np.linspace(0, 1, 100)[:, None] * (b - a) for a, b in pairwise(path)])
    assert problem.world.clearance(points).min() > 0.99 * REACH


@pytest.mark.parametrize("seed", range(3))
def test_who_follows_the_direction_gets_there(seed: int) -> None:
    problem = problem_in(cells_world(np.random.default_rng(seed + 30), 0.2), [0.3, 0.3], [5.1, 5.1])
    position, travelled, step = problem.start[:, :2].astype(np.float64), 0.0, 0.02
    while np.linalg.norm(position - problem.goal) > 0.05:
        direction = problem.shortest_paths.direction(position)
        np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1.0)
        position, travelled = position + step * direction, travelled + step
        assert travelled < 1.1 * problem.shortest_paths.length[0]


def around(first: float, second: float, radius: float, angle: float) -> float:
    """Length of a string from one point round a circle to another, by their distances from the centre and its angle."""
    turn = angle - math.acos(radius / first) - math.acos(radius / second)
    if turn <= 0:
        return math.sqrt(first**2 + second**2 - 2 * first * second * math.cos(angle))
    return math.sqrt(first**2 - radius**2) + math.sqrt(second**2 - radius**2) + radius * turn


@pytest.mark.parametrize("size", [0.3, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_paths_round_a_sphere(size: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    start = random.normal(size=3)
    start *= (size + random.uniform(0.5, 2)) / np.linalg.norm(start)
    goal = -start + 0.3 * random.normal(size=3)
    found = problem_in(World(3, spheres=[[0, 0, 0, size]]), start, goal).shortest_paths
    first, second = float(np.linalg.norm(start)), float(np.linalg.norm(goal))
    expected = around(first, second, size + REACH, math.acos(start @ goal / first / second))
    assert 0.999 < found.length[0] / expected < 1.02


@pytest.mark.parametrize("rise", [0.0, 1.0, 4.0])
def test_paths_round_a_cylinder_climb_evenly(rise: float) -> None:
    world = World(3, cylinders=[[0, 0, 0.5]], spheres=[[0, 0, 20, 0.1]])
    found = problem_in(world, [-1.5, 0, 0], [1.2, 0.1, rise]).shortest_paths
    flat = around(1.5, math.hypot(1.2, 0.1), 0.5 + REACH, math.pi - math.atan2(0.1, 1.2))
    assert 0.999 < found.length[0] / math.hypot(flat, rise) < 1.02


@pytest.mark.parametrize(("ahead", "aside"), [(1.0, 0.0), (2.0, 1.5), (1.0, 2.5)])
def test_paths_over_a_wall_unfold(ahead: float, aside: float) -> None:
    wall = World(3, boxes=[[-0.2, -3, 0, 0.2, 3, 1]], lower=[-4, -3, 0], upper=[4, 3, 4])
    found = problem_in(wall, [-ahead, -aside, 0.3], [ahead, aside, 0.3]).shortest_paths
    gap = math.hypot(ahead - 0.2, 0.7)
    # Up to where the string leaves the rounded edge for the top, in the plane across the wall.
    turn = math.atan2(0.7, ahead - 0.2) + math.pi / 2 - math.acos(REACH / gap)
    flat = 2 * (math.sqrt(gap**2 - REACH**2) + REACH * turn) + 0.4
    assert 0.999 < found.length[0] / math.hypot(flat, 2 * aside) < 1.02


@pytest.mark.parametrize("scenario", ["circle", "sphere"])
def test_open_worlds_have_straight_ways(scenario: str) -> None:
    problem = make_problem(scenario, num_robots=4)
    d = problem.dimension
    problem.check_reachable()
    offset = problem.goal - problem.start[:, :d].astype(np.float64)
    gaps = np.linalg.norm(offset, axis=1)
    np.testing.assert_allclose(problem.shortest_paths.length, gaps, rtol=1e-12)
    np.testing.assert_array_equal(problem.shortest_paths.distance(problem.start[:, :d]), problem.shortest_paths.length)
    np.testing.assert_allclose(problem.shortest_paths.direction(problem.start[:, :d]), offset / gaps[:, None])
    np.testing.assert_array_equal(problem.shortest_paths.direction(problem.goal), np.zeros((4, d)))
    assert problem.shortest_paths.path(1).shape == (2, d)


def test_lengths_and_directions_take_batches() -> None:
    problem = make_problem("four_obstacles")
    positions = problem.start[:, :2] + np.linspace(0, 0.2, 3)[:, None, None]
    lengths, directions = problem.shortest_paths.distance(positions), problem.shortest_paths.direction(positions)
    assert lengths.shape == (3, problem.num_robots)
    assert directions.shape == (3, problem.num_robots, 2)
    np.testing.assert_array_equal(lengths[0], problem.shortest_paths.length)
    np.testing.assert_array_equal(lengths[2], problem.shortest_paths.distance(positions[2]))


def test_robots_without_a_way_are_named() -> None:
    cage = [[-1, -1, -0.9, 1], [0.9, -1, 1, 1], [-0.9, -1, 0.9, -0.9], [-0.9, 0.9, 0.9, 1]]
    starts, goals = [[0, 0], [3, 0], [0, 3], [0.5, 0.5]], [[2, 0], [3, 1], [0, 0], [-0.5, 0.5]]
    problem = problem_in(World(boxes=cage), starts, goals)
    with pytest.raises(ValueError, match=r"^robot_0, robot_2 have no path from start to goal that is 0\.2 m clear .*"):
        problem.check_reachable()
    np.testing.assert_array_equal(np.isinf(problem.shortest_paths.length), [True, False, True, False])
    assert problem.shortest_paths.path(0).shape == (0, 2)
    np.testing.assert_array_equal(problem.shortest_paths.direction(problem.start)[[0, 2]], np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"^robot_0 has no path .* use a smaller radius or margin$"):
        problem.select([0, 1]).check_reachable()
    problem.select([1, 3]).check_reachable()


@pytest.mark.parametrize(("half", "reachable"), [(0.0, False), (0.1, False), (0.2, True), (0.25, True), (0.4, True)])
def test_footprints_are_refused_where_the_discs_within_them_have_no_path(half: float, reachable: bool) -> None:
    boxes = [[-1, -3, 1, -half], [-1, half, 1, 3]]
    world, team = World(boxes=boxes, lower=[-4, -3], upper=[4, 3]), Team(("unicycle",), footprint=Box(0.5, 0.3))
    problem = Problem(team, [[-2, 0, 0]], [[2, 0]], world, goal_heading=0.0)
    assert np.isfinite(problem.shortest_paths.length[0]) == (half >= 0.4)
    if reachable:
        problem.check_reachable()
        return
    with pytest.raises(ValueError, match=r"^robot_0 has no path from start to goal, not even for the disc of 0\.15 m"):
        problem.check_reachable()


def test_rewards_by_the_length_of_paths_need_those_of_the_discs_round_footprints() -> None:
    world = World(boxes=[[-1, -3, 1, -0.2], [-1, 0.2, 1, 3]], lower=[-4, -3], upper=[4, 3])
    problem = Problem(Team(("unicycle",), footprint=Box(0.5, 0.3)), [[-2, 0, 0]], [[2, 0]], world)
    with pytest.raises(
        ValueError, match=r"0\.3415 m clear of obstacles, for the disc round its footprint; .* footprint or margin"
    ):
        navigation_v0.parallel_env(problem=problem, progress="path")


@pytest.mark.parametrize(("slack", "passable"), [(0.02, True), (0.005, True), (-0.001, False)])
@pytest.mark.parametrize("turn", [0.0, 0.3, 0.785])
def test_a_gap_is_passed_if_it_is_wide_enough(slack: float, passable: bool, turn: float) -> None:
    half = REACH + slack / 2
    turned = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    wall = np.array([[-0.1, half], [0.1, half], [0.1, 20], [-0.1, 20]])
    world = World(polygons=[wall @ turned.T, -wall @ turned.T], lower=[-3, -3], upper=[3, 3])
    problem = problem_in(world, turned @ [-1.5, 0.3], turned @ [1.5, 0.3])
    assert np.isfinite(problem.shortest_paths.length[0]) == passable
    if passable:
        assert problem.shortest_paths.length[0] < 1.02 * (2 * math.hypot(1.4, 0.3) + 0.2)


def test_positions_within_the_margin_are_left_and_reached() -> None:
    world = World(boxes=[[-1, -1, 1, 0]])
    problem = problem_in(world, [-0.9, RADIUS + 0.01], [0.9, RADIUS + 0.02])
    problem.check_reachable()
    assert problem.shortest_paths.length[0] == pytest.approx(1.8, rel=0.04)
    assert problem.shortest_paths.distance([[0.0, 0.05]])[0] == pytest.approx(0.95, abs=0.06)  # in contact
    between = problem_in(World(boxes=[[-1, -1, 1, 0], [-1, 0.36, 1, 1]]), [-1.5, 0.18], [0, 0.18])
    with pytest.raises(ValueError, match="robot_0 has no path"):
        between.check_reachable()


def test_robots_of_different_size_have_paths_of_their_own() -> None:
    world = World(boxes=[[-0.1, 0.25, 0.1, 3], [-0.1, -3, 0.1, -0.25]])
    problem = problem_in(world, [[-2, 0], [-2, 1]], [[2, 0], [2, 1]], radius=np.array([0.15, 0.3]))
    assert problem.shortest_paths.length[0] == pytest.approx(4)
    assert problem.shortest_paths.length[1] > 6


def test_a_world_too_large_for_the_grid_gets_a_coarser_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("d4orm_env.paths.shortest_paths.MAX_NODES", 2**17)
    world = World(boxes=[[95, -75, 105, 75]])
    found = problem_in(world, [0, 0], [200, 0]).shortest_paths
    assert found._world is not None
    assert 2**15 < np.diff(found._world[1].first_anchor).max() <= 2**17
    assert found.length[0] == pytest.approx(2 * math.hypot(95, 75) + 10, rel=0.02)


def test_paths_stay_with_the_problem_and_not_with_its_copies() -> None:
    problem = make_problem("four_obstacles")
    assert problem.shortest_paths is problem.shortest_paths
    moved = problem.replace(goal=problem.start[:, :2], start=problem.start)
    assert moved.shortest_paths.length.max() == 0


def test_stretch_of_a_straight_drive_is_one() -> None:
    problem = Problem(Team(("velocity2d",) * 2), [[0, 0], [0, 2]], [[1, 0], [1, 2]], horizon=12)
    controls = np.tile([1.0, 0.0], (12, 2, 1))
    controls[:, 1] = 0
    trajectory = rollout(problem, controls)
    np.testing.assert_allclose(stretch(problem, trajectory), [1, np.inf], rtol=1e-6)
    assert mean_stretch(problem, trajectory) == pytest.approx(1)
    assert mean_stretch(problem, rollout(problem, 0 * controls)) == np.inf


def test_stretch_among_obstacles_is_measured_by_the_path_round() -> None:
    problem = problem_in(World(circles=[[0, 0, 0.5]]), [-1.5, 0], [1.5, 0]).replace(horizon=60)
    plan = make_planner("d4orm", num_samples=256).solve(problem, max_iterations=3)
    assert plan.solved
    assert 0.99 < plan.stretch < 1.5
    straight = problem_in(World(), [-1.5, 0], [1.5, 0]).replace(horizon=60)
    assert plan.stretch < stretch(straight, plan.trajectory)[0]


def test_shortest_paths_are_the_same_everywhere() -> None:
    """To the bit, as computed on x86-64 with AVX-512 and without AVX."""
    shapes = {"circles": [[1, 1, 0.3]], "polygons": [[[-1, -1], [-0.5, 0], [-1, 1]]]}
    flat = problem_in(World(boxes=[[0, -1, 0.4, 1]], **shapes), [-1.5, 0.1], [1.5, 0.2])
    assert flat.shortest_paths.length[0].hex() == "0x1.2ad66747603b8p+2"
    spatial = World(3, boxes=[[0, -1, -1, 0.4, 1, 1]], spheres=[[1, 1, 0, 0.5]])
    assert problem_in(spatial, [-1.5, 0.1, 0], [1.5, 0.2, 0.1]).shortest_paths.length[0].hex() == "0x1.f5b8178d42f7ep+1"


def test_shortest_paths_are_the_same_each_time() -> None:
    problem = make_problem("four_obstacles")
    one, other = shortest_paths(problem), shortest_paths(problem.replace())
    np.testing.assert_array_equal(one.length, other.length)
    assert one._world is not None
    assert other._world is not None
    for array, again in zip(one._world[1], other._world[1], strict=True):
        np.testing.assert_array_equal(array, again)
