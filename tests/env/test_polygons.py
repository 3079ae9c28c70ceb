"""Polygons: what is simple and what is not, exactly and quickly, and the triangles that fill them."""

from __future__ import annotations

from itertools import combinations
from typing import TypeAlias

import jax
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from shapely import Polygon

from d4orm_env import Problem, Team, World, navigation_v0, rollout
from d4orm_env.geometry import polygon as polygons
from d4orm_env.geometry.polygon import first_crossing, orientation, triangulate
from d4orm_env.jax.functional_env import FunctionalEnv

Corners: TypeAlias = list[tuple[float, float]]
GRID = st.lists(st.tuples(st.integers(0, 4).map(float), st.integers(0, 4).map(float)), min_size=3, max_size=8)
REAL = st.lists(st.tuples(*[st.floats(-10, 10, width=32)] * 2), min_size=3, max_size=12)


def edges_meet(corners: Corners, one: int, other: int) -> bool:
    """Two edges of integer corners, one after the other or not, by the parameters at which they meet."""
    count = len(corners)
    a, b, c, d = (np.array(corners[index % count]) for index in (one, one + 1, other, other + 1))
    if (other - one) % count in (1, count - 1):
        shared, first, second = (b, a, d) if (other - one) % count == 1 else (a, b, c)
        u, v = first - shared, second - shared
        return u[0] * v[1] == u[1] * v[0] and u @ v > 0
    sides = [
        np.sign((q - p)[0] * (r - p)[1] - (q - p)[1] * (r - p)[0])
        for p, q, r in ((a, b, c), (a, b, d), (c, d, a), (c, d, b))
    ]
    boxes = (np.maximum(np.minimum(a, b), np.minimum(c, d)) <= np.minimum(np.maximum(a, b), np.maximum(c, d))).all()
    return bool(boxes and sides[0] * sides[1] <= 0 and sides[2] * sides[3] <= 0)


@given(GRID)
def test_what_crosses_or_touches_is_found(corners: Corners) -> None:
    assume(all(a != b for a, b in zip(corners, corners[1:] + corners[:1])))
    pairs = [pair for pair in combinations(range(len(corners)), 2) if edges_meet(corners, *pair)]
    found = first_crossing(corners)
    assert (found is None) == (not pairs)
    if found is not None:
        assert found in pairs or corners[found[0]] == corners[found[1]]


@given(REAL)
def test_as_shapely_says(corners: Corners) -> None:
    assume(all(a != b for a, b in zip(corners, corners[1:] + corners[:1])))
    assert (first_crossing(corners) is None) == Polygon(corners).is_valid


def test_orientation_is_exact() -> None:
    b, ulp = (12.0, 12.0), 2.0**-53
    for offset, side in ((ulp, 1), (0.0, 0), (-ulp, -1)):  # the plain expression says 0 for some
        assert orientation(b, (24.0, 24.0), (0.5, 0.5 + offset)) == side
    assert orientation((1e6, 1e6), (1e6, 1e6 + 0.0625), (1e-45, 0.0)) == 1


@pytest.mark.parametrize("count", [500, 1000, 2000])
def test_it_takes_few_comparisons(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """n log n of them, for a comb that all edges of a sweep line lie in, and for a star."""
    calls = 0

    def counted(*corners: tuple[float, float]) -> int:
        nonlocal calls
        calls += 1
        return orientation(*corners)

    monkeypatch.setattr(polygons, "orientation", counted)
    for corners in (comb(count), comb(count)[:, ::-1], star(count)):
        calls = 0
        assert first_crossing([(x, y) for x, y in corners.tolist()]) is None
        assert calls < 3 * count * np.log2(count)


def comb(count: int) -> np.ndarray:
    x = np.arange(count - 2) * 0.05
    teeth = np.column_stack([x, np.where(np.arange(count - 2) % 2, 50.0, 1.0)])
    return np.vstack([teeth, [[x[-1], 0], [0, 0]]]).astype(np.float32)


def star(count: int) -> np.ndarray:
    angle, radius = 2 * np.pi * np.arange(count) / count, np.random.default_rng(0).uniform(50, 100, count)
    return (np.column_stack([np.cos(angle), np.sin(angle)]) * radius[:, None]).astype(np.float32)


def in_line() -> np.ndarray:
    """The last corner is in the middle of an edge, but for rounding."""
    return np.array([[-1.5, -0.4], [-0.8, -0.6], [-0.9, 0.4], [-1.2, 0.0]], np.float32)


@pytest.mark.parametrize("corners", [comb(300), comb(300)[::-1], star(300), star(7), in_line()])
def test_triangles_fill_a_polygon(corners: np.ndarray) -> None:
    triangles = triangulate(corners)
    assert len(triangles) <= len(corners) - 2
    parts = [Polygon(corners[triangle]) for triangle in triangles]
    assert all(Polygon(corners).buffer(1e-6).contains(part) for part in parts)
    assert sum(part.area for part in parts) == pytest.approx(Polygon(corners).area, rel=1e-6)
    assert min(2 * part.area / part.length for part in parts) > 1e-6


def test_the_order_in_which_ears_go() -> None:
    """The largest first, which the bits of plans depend on."""
    assert triangulate(np.array([[0, 0], [4, 0], [4, 3], [2, 1], [0, 3]], np.float32)).tolist() == [
        [1, 2, 3],
        [3, 4, 0],
        [0, 1, 3],
    ]


def test_more_corners_than_are_checked_quickly_are_refused() -> None:
    with pytest.raises(ValueError, match=r"polygons\[0\] has 2001 corners, and a polygon at most 2000; leave some out"):
        World(polygons=[star(2001)])
    with pytest.raises(ValueError, match="polygons have 31500 corners in all, and a world at most 30000; give fewer"):
        World(polygons=[star(1500)] * 21)
    assert World(polygons=[star(2000)]).num_obstacles == 1


@pytest.mark.parametrize("engine", ["cpu", "jax"])
def test_a_corner_in_the_middle_of_an_edge_hides_and_touches_nothing(engine: str) -> None:
    """Rays and contacts near the line through that edge, beyond its ends."""
    world = World(2, lower=[-4, -4], upper=[4, 4], polygons=[in_line()])
    beyond = [-0.720539391040802, 0.6392807364463806]
    assert world.clearance(np.float32(beyond)) == pytest.approx(0.299, abs=1e-3)
    problem = Problem(Team(("velocity2d",)), [beyond], [[3.5, -3.5]], world, horizon=1)
    assert not rollout(problem, np.zeros((1, 1, 2)), engine=engine).collided.any()
    start, goals = [[-2.7541589736938477, -2.900834083557129], [3, 3]], [[3.5, -3.5], [-3.5, -3.5]]
    seen = Problem(Team(("velocity2d",) * 2), start, goals, world)
    options = {"observed_rays": 36, "ray_range": 8.0}
    if engine == "cpu":
        env = navigation_v0.parallel_env(problem=seen, **options)
        ranges = env.reset(seed=0)[0]["robot_0"][env.layout.rays]
    else:
        functional_env = FunctionalEnv(problem=seen, **options)
        _, observations = jax.jit(functional_env.reset)(jax.random.key(0))
        ranges = np.asarray(observations)[0, functional_env.layout.rays]
    assert ranges[7] == pytest.approx(7.344, abs=1e-3)


def test_a_corner_in_the_middle_of_an_edge_blocks_no_sight() -> None:
    world = World(2, lower=[-4, -4], upper=[4, 4], polygons=[in_line()])
    start, goals = [[-2.4959, 1.9959], [1.7226, -1.5638]], [[3.5, -3.5], [-3.5, -3.5]]
    problem = Problem(Team(("velocity2d",) * 2), start, goals, world)
    env = navigation_v0.parallel_env(problem=problem, line_of_sight=True)
    assert env.reset(seed=0)[0]["robot_0"][12] == 1
