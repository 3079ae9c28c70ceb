"""The index of obstacles against testing all of them, in every engine, and polygons against shapely."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import shapely.ops
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from d4orm_env import load_problem, navigation_v0, rollout, save_problem, verify
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.engine.choice import get_engine
from d4orm_env.geometry.grid_refinement import FEW
from d4orm_env.geometry.world_index import MAX_BYTES, build_index, nearest_distance
from d4orm_env.verify.geometry import polygon_approach
from d4orm_planners import make_planner
from d4orm_planners.tracking.steering import straight_drives

ENGINES = pytest.mark.parametrize("engine", ["cpu", "jax"])


def star(random: np.random.Generator, corners: int, size: float) -> Any:
    """A simple polygon round the origin, convex or not."""
    angle = 2 * np.pi * (np.arange(corners) + random.uniform(0.1, 0.9, corners)) / corners
    radius = random.uniform(0.3, 1, corners) * size
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)[:: random.choice([-1, 1])]


def random_world(seed: int, dimension: int, count: int) -> World:
    """About ``4 count`` obstacles of all kinds, small and large, in a cube of 8 m."""
    random = np.random.default_rng(seed)
    position = random.uniform(-4, 4, (4, count, dimension))
    size = random.uniform(0.01, 1.0, (4, count, 1)) * 4 / count ** (1 / dimension)
    boxes = np.hstack([position[0], position[0] + size[0] * random.uniform(0.1, 1, (count, dimension))])
    balls = np.hstack([position[1], size[1] / 2])
    bounds: dict[str, Any] = {} if seed % 3 else {"lower": [-5] * dimension, "upper": [4.5] * dimension}
    if dimension == 3:
        cylinders = np.hstack([position[2, :, :2], size[2] / 4])
        return World(dimension=3, boxes=boxes, spheres=balls, cylinders=cylinders, **bounds)
    polygons = [
        at + star(random, random.integers(3, 9), float(extent[0]))
        for at, extent in zip(position[2], size[2], strict=True)
    ]
    return World(boxes=boxes, circles=balls, polygons=polygons, **bounds)


def all_clearances(world: World, points: Any) -> Any:
    """The clearance of points, all obstacles looked at."""
    every = np.repeat(np.arange(world.shapes.count), len(points))
    gaps = world.shapes.signed_distance(np.tile(points, (world.shapes.count, 1)), every).reshape(-1, len(points))
    bounds = np.minimum(points - world.bounds[0], world.bounds[1] - points).min(axis=1)
    return np.minimum(gaps.min(axis=0), bounds)


worlds = given(
    seed=st.integers(0, 10**6), dimension=st.sampled_from([2, 3]), count=st.integers(1, 30),
    radius=st.sampled_from([0.01, 0.15, 1.0]),
)  # fmt: skip


@worlds
@settings(max_examples=15, deadline=None)
def test_index_finds_the_nearest_obstacle(seed: int, dimension: int, count: int, radius: float) -> None:
    world = random_world(seed, dimension, count)
    points = np.random.default_rng(seed).uniform(-7, 7, (200, dimension))
    world.index(radius)
    np.testing.assert_array_equal(world.clearance(points), all_clearances(world, points))
    np.testing.assert_array_equal(world.clearance(points[7]), world.clearance(points)[7])
    for distance in (radius / 7, radius, 3 * radius):
        np.testing.assert_array_equal(world.is_clear(points, distance), all_clearances(world, points) > distance)


def test_distances_of_a_size_share_an_index_with_four_cells_for_each_and_one_round_who_observes() -> None:
    world = random_world(1, 2, 5)
    assert world.index(0.9) is world.index(0.6)
    assert (world.index(0.9).scale, world.index(0.9, positions=np.zeros((1, 2))).scale) == (4, 1)


@pytest.mark.parametrize("dimension", [2, 3])
def test_crowded_cells_keep_only_who_can_be_nearest(dimension: int, monkeypatch: pytest.MonkeyPatch) -> None:
    shapes, points = random_world(5, dimension, 400).shapes, np.random.default_rng(5).uniform(-5, 5, (4000, dimension))
    short = build_index(shapes, 0.25, 1.0)
    monkeypatch.setattr("d4orm_env.geometry.grid_refinement.CROWDED", 10**6)
    long = build_index(shapes, 0.25, 1.0)
    assert len(short.items) < 0.8 * len(long.items)
    distances = [nearest_distance(shapes, index, points) for index in (short, long)]
    np.testing.assert_array_equal(*distances)


@pytest.mark.parametrize("nearest", [3, FEW + 3])
@worlds
@settings(max_examples=10, deadline=None)
def test_index_finds_several_of_the_nearest(nearest: int, seed: int, dimension: int, count: int, radius: float) -> None:
    world = random_world(seed, dimension, count)
    index, random = world.index(radius, nearest=nearest), np.random.default_rng(seed)
    inside = index.low + random.uniform(0, 1, (50, dimension)) * index.size / index.scale
    for point in inside:
        cell = np.ravel_multi_index(tuple(((point - index.low) * index.scale).astype(int)), tuple(index.size))
        items = index.items[index.first[cell] : index.first[cell + 1]].astype(int)
        every = np.arange(world.shapes.count)
        gaps = world.shapes.signed_distance(np.repeat(point[None], len(every), axis=0), every)
        np.testing.assert_array_equal(np.sort(gaps[items])[:nearest], np.sort(gaps)[:nearest])


@worlds
@settings(max_examples=30, deadline=None)
def test_no_obstacle_within_reach_is_left_out(seed: int, dimension: int, count: int, radius: float) -> None:
    shapes, points = (
        random_world(seed, dimension, count).shapes,
        np.random.default_rng(seed).uniform(-5, 5, (20, dimension)),
    )
    found = np.zeros((20, shapes.count), bool)
    found[shapes.within(points, radius)] = True
    rows, items = (index.ravel() for index in np.indices(found.shape))
    near = shapes.signed_distance(points[rows], items).reshape(found.shape) <= radius
    assert not (near & ~found).any()
    assert not len(shapes.within(points + 100, radius)[0])


@ENGINES
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("seed", "count", "radius"), [(1, 1, 0.15), (2, 20, 0.01), (3, 20, 0.15), (4, 5, 1.0)])
def test_engines_flag_what_all_obstacles_would(
    engine: str, seed: int, dimension: int, count: int, radius: float
) -> None:
    world, random = random_world(seed, dimension, count), np.random.default_rng(seed)
    model = "holonomic2d" if dimension == 2 else "holonomic3d"
    start = random.uniform(-6, 6, (256, dimension)).astype(np.float32)
    start = start[all_clearances(world, start) > radius + 1e-3][:8]
    # Robots pass through everything; what they touch on the way is flagged.
    team = Team((model,) * len(start), radius=radius, max_speed=100.0, max_acceleration=1000.0)
    problem = unchecked(team, start, world)
    controls = random.normal(0, 300, (40, len(start), dimension)).astype(np.float32)
    trajectory = get_engine(engine).rollout(problem, controls)
    clearance = all_clearances(world, trajectory.positions.reshape(-1, dimension).astype(float))
    gap = clearance.reshape(trajectory.collided.shape) - radius
    alone = ~near_each_other(trajectory.positions, 2 * radius + problem.margin)
    for flags, reach in ((trajectory.collided, 0.0), (trajectory.margin_violated, problem.margin)):
        decided = alone & (np.abs(gap - reach) > 2e-5)
        np.testing.assert_array_equal(flags[decided], (gap <= reach)[decided])


def unchecked(team: Team, start: Any, world: World) -> Problem:
    """A problem whose robots may touch each other."""
    apart = np.zeros_like(start)
    apart[:, 0] = 1e3 + 50 * np.arange(len(start))
    states = np.concatenate([start, np.zeros_like(start)], axis=1)
    far = Problem(
        team, np.concatenate([apart, apart * 0], axis=1), apart, World(team.dimension), goal_radius=0.2, horizon=40
    )
    return far.with_state(states, apart, world=world)


def near_each_other(positions: Any, reach: float) -> Any:
    """``(H+1, K)`` robots whose centres are about within reach of another's."""
    gaps = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
    gaps[:, np.arange(gaps.shape[1]), np.arange(gaps.shape[1])] = np.inf
    return (gaps <= reach + 1e-4).any(axis=2)


@given(seed=st.integers(0, 10**6), corners=st.integers(3, 20))
@settings(max_examples=50, deadline=None)
def test_polygons_are_those_of_shapely(seed: int, corners: int) -> None:
    random = np.random.default_rng(seed)
    outline = star(random, corners, 2.0).astype(np.float32)
    if not shapely.Polygon(outline).is_valid:
        with pytest.raises(ValueError, match="cross or touch"):
            World(polygons=[outline])
        return
    polygon, points = shapely.Polygon(outline), random.uniform(-3, 3, (200, 2))
    clearance = World(polygons=[outline]).clearance(points)
    expected = shapely.distance(polygon, shapely.points(points))
    outside = expected > 0
    np.testing.assert_allclose(clearance[outside], expected[outside], atol=1e-9)
    assert (clearance[~outside] <= 0).all()


@given(seed=st.integers(0, 10**6), corners=st.integers(3, 12))
@settings(max_examples=50, deadline=None)
def test_verify_sees_how_near_a_way_comes_to_a_polygon(seed: int, corners: int) -> None:
    random = np.random.default_rng(seed)
    outline = star(random, corners, 2.0).astype(np.float32).astype(float)
    polygon = shapely.Polygon(outline)
    assume(polygon.is_valid)
    start, end = random.uniform(-3, 3, (2, 40, 2))
    distance, fraction = polygon_approach(start, end, outline)
    expected = [shapely.LineString(pair).distance(polygon) for pair in zip(start, end, strict=True)]
    np.testing.assert_allclose(np.maximum(distance, 0), expected, atol=1e-9)
    positions = start + fraction[:, None] * (end - start)
    apart = shapely.distance(polygon, shapely.points(positions))
    np.testing.assert_allclose(apart, expected, atol=1e-9)


def wall_problem(model: str = "holonomic2d") -> Problem:
    """One robot, and across its straight path a slanted wall that leaves a gap at one side."""
    wall = [(-0.3, -2.0), (0.2, -2.1), (0.1, 0.4), (-0.2, 0.3)]
    start = np.zeros((1, 4), np.float32)
    start[0, 0] = -1.5
    return Problem(Team((model,)), start, [(1.5, 0.0)], World(polygons=[wall]))


def test_a_polygon_is_in_the_way_of_everyone_alike() -> None:
    problem = wall_problem()
    controls = straight_drives(problem).controls[:, :, 0]
    report, trajectory = verify(problem, controls), rollout(problem, controls)
    assert trajectory.collided.any()
    (contact,) = [violation for violation in report.violations if violation.kind == "obstacle contact"]
    assert "polygons[0]" in contact.detail
    first = float(np.flatnonzero(trajectory.collided[:, 0])[0] * problem.dt)
    assert first - problem.dt <= contact.time <= first


@pytest.mark.parametrize("name", ["d4orm", "d4orm-d", "ipopt"])
def test_planners_go_round_a_polygon(name: str) -> None:
    plan = make_planner(name, **({} if name == "ipopt" else {"engine": "cpu"})).solve(wall_problem(), seed=0)
    assert plan.solved
    assert verify(plan.problem, plan.controls).ok
    assert np.abs(plan.trajectory.positions[:, 0, 1]).max() > 0.4


def test_polygons_come_back_from_a_file(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    polygons = [np.add((4 * i, 3), star(random, 7, 1.0)) for i in range(3)]
    problem = wall_problem().replace(world=World(polygons=polygons, circles=[(0, -4, 1)]))
    save_problem(problem, tmp_path / "walls.yaml")
    again = load_problem(tmp_path / "walls.yaml")
    assert again == problem
    assert pickle.loads(pickle.dumps(problem)) == problem
    assert problem != problem.replace(world=World(polygons=polygons[:2], circles=[(0, -4, 1)]))


def test_a_robot_sees_the_nearest_edge_of_a_polygon() -> None:
    env = navigation_v0.parallel_env(problem=wall_problem(), observed_obstacles=2)
    seen, _ = env.reset(seed=0)
    present, x, y, gap = seen["robot_0"][-8:-4]
    nearest = shapely.ops.nearest_points(shapely.Polygon(wall_problem().world.polygons[0]), shapely.Point(-1.5, 0))[0]
    distance = np.hypot(nearest.x + 1.5, nearest.y)
    np.testing.assert_allclose([present, x, y, gap], [1, nearest.x + 1.5, nearest.y, distance - 0.15], atol=1e-5)


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([(0, 0), (1, 0)], "has 2 corners; a polygon needs three or more"),
        ([(0, 0), (0, 0), (1, 1)], "corner 0 and the one after it are both at"),
        ([(0, 0), (1, 1), (1, 0), (0, 1)], "edges from corner 0 and from corner 2 cross or touch"),
        ([(0, 0), (1, 0), (2, 0)], "cross or touch"),
        ([(0, 0), (4, 0), (4, 4), (2, 0), (0, 4)], "cross or touch"),
        ([(0, 0), (np.nan, 0), (1, 1)], "polygons"),
        ([(0, 0, 0), (1, 0, 0), (1, 1, 0)], "polygons"),
    ],
)  # fmt: skip
def test_degenerate_polygons_are_refused(corners: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        World(polygons=[corners])


def test_polygons_are_for_the_plane() -> None:
    with pytest.raises(ValueError, match="polygons need a world of dimension 2"):
        World(dimension=3, polygons=[[(0, 0), (1, 0), (0, 1)]])


@pytest.mark.parametrize("extent", [1.0, 1e3, 9e5])
def test_an_index_is_bounded_in_memory(extent: float) -> None:
    random = np.random.default_rng(0)
    low = random.uniform(-extent, extent, (500, 2))
    world = World(boxes=np.hstack([low, low + extent / 100]))
    index = build_index(world.shapes, 0.05, 0.2)
    assert index.num_bytes <= MAX_BYTES
    points = random.uniform(-extent, extent, (500, 2))
    np.testing.assert_array_equal(world.clearance(points), all_clearances(world, points))
