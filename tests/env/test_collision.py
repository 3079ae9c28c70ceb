"""Contacts at, just inside and just outside, for every kind of obstacle, and their symmetries.

Lengths are powers of two or sums of a few, so that "at contact" is exact in float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from engine_support import ENGINE_NAMES, NUMPY_OPS, open_problem, stand
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.world import World
from d4orm_env.dynamics.collision import axis_gap, leaves
from d4orm_env.engine.choice import get_engine
from d4orm_env.engine.cpu import CpuEngine
from d4orm_env.engine.tiles import BIG_TEAM
from d4orm_env.engine.types import MOVED, WorldBatch
from d4orm_env.scenarios import make_problem

RADIUS, MARGIN = 0.25, 0.25
CONTACT, MARGIN_ONLY, CLEAR = (True, True), (False, True), (False, False)


def above(x: float) -> float:
    return float(np.nextafter(np.float32(x), np.float32(np.inf)))


def below(x: float) -> float:
    return float(np.nextafter(np.float32(x), np.float32(-np.inf)))


def test_axis_gap() -> None:
    assert [axis_gap(x, 1.0, 3.0, 0.0, NUMPY_OPS) for x in (-1.0, 1.0, 2.0, 3.0, 3.5)] == [2.0, 0.0, 0.0, 0.0, 0.5]


def test_leaves() -> None:
    positions = (-0.75, -0.74, 0.0, 0.74, 0.75, 2.0)
    assert [bool(leaves(x, 0.25, -1.0, 1.0)) for x in positions] == [True, False, False, False, True, True]


CIRCLE = World(2, circles=[[0, 0, 0.5]])
PLANAR_BOX = World(2, boxes=[[-1, -0.5, 1, 0.5]])
PLANAR_BOUNDS = World(2, lower=[-4, -2], upper=[8, 200])
SPHERE = World(3, spheres=[[0, 0, 0, 0.625]])
CYLINDER = World(3, cylinders=[[0, 0, 0.5]])
SPATIAL_BOX = World(3, boxes=[[-1, -1, -1, 1, 1, 1]])
SPATIAL_BOUNDS = World(3, lower=[-4, -4, -2], upper=[200, 200, 4])

# (world, place, what it is). A robot of radius 1/4 with a margin of 1/4 on top.
PLACES: list[tuple[World, Any, Any]] = [
    (CIRCLE, (0, 0), CONTACT),
    (CIRCLE, (0.75, 0), CONTACT),
    (CIRCLE, (above(0.75), 0), MARGIN_ONLY),
    (CIRCLE, (0, -1), MARGIN_ONLY),
    (CIRCLE, (0, below(-1)), CLEAR),
    (CIRCLE, (0.45, 0.59), CONTACT),  # 0.742 from the centre
    (CIRCLE, (0.46, 0.61), MARGIN_ONLY),  # 0.764
    (CIRCLE, (0.6, 0.81), CLEAR),  # 1.008
    (PLANAR_BOX, (0, 0), CONTACT),
    (PLANAR_BOX, (1.25, 0.25), CONTACT),
    (PLANAR_BOX, (above(1.25), 0.25), MARGIN_ONLY),
    (PLANAR_BOX, (0.5, -0.75), CONTACT),
    (PLANAR_BOX, (0.5, below(-0.75)), MARGIN_ONLY),
    (PLANAR_BOX, (0.5, -1), MARGIN_ONLY),
    (PLANAR_BOX, (0.5, below(-1)), CLEAR),
    (PLANAR_BOX, (1.2, 0.7), MARGIN_ONLY),  # 0.2 beyond the corner along both axes: 0.283
    (PLANAR_BOX, (1.17, 0.67), CONTACT),  # 0.17: 0.240
    (PLANAR_BOX, (1.4, 0.9), CLEAR),  # 0.4: 0.566
    (PLANAR_BOUNDS, (0, 0), CLEAR),
    (PLANAR_BOUNDS, (-3.75, 0), CONTACT),
    (PLANAR_BOUNDS, (above(-3.75), 0), MARGIN_ONLY),
    (PLANAR_BOUNDS, (-3.5, 0), MARGIN_ONLY),
    (PLANAR_BOUNDS, (above(-3.5), 0), CLEAR),
    (PLANAR_BOUNDS, (7.75, 0), CONTACT),
    (PLANAR_BOUNDS, (7.5, 0), MARGIN_ONLY),
    (PLANAR_BOUNDS, (below(7.5), 0), CLEAR),
    (PLANAR_BOUNDS, (0, -1.75), CONTACT),
    (PLANAR_BOUNDS, (0, 150), CLEAR),
    (PLANAR_BOUNDS, (50, 0), CONTACT),  # far outside
    (SPHERE, (0.25, 0.375, 0.75), CONTACT),  # 7/8 from the centre
    (SPHERE, (0.25, 0.375, above(0.75)), MARGIN_ONLY),
    (SPHERE, (0, 0, 1.125), MARGIN_ONLY),
    (SPHERE, (0, 0, above(1.125)), CLEAR),
    (CYLINDER, (0, 0.75, 40), CONTACT),
    (CYLINDER, (0, above(0.75), -40), MARGIN_ONLY),
    (CYLINDER, (-1, 0, 0), MARGIN_ONLY),
    (CYLINDER, (below(-1), 0, 0), CLEAR),
    (SPATIAL_BOX, (0, 0, 0.5), CONTACT),
    (SPATIAL_BOX, (0, 0, -1.25), CONTACT),
    (SPATIAL_BOX, (0, 0, below(-1.25)), MARGIN_ONLY),
    (SPATIAL_BOX, (0.5, -0.5, 1.5), MARGIN_ONLY),
    (SPATIAL_BOX, (0.5, -0.5, above(1.5)), CLEAR),
    (SPATIAL_BOX, (1.25, 1.25, 1.25), MARGIN_ONLY),  # 0.433 beyond the corner
    (SPATIAL_BOX, (1.3, 1.3, 1.3), CLEAR),  # 0.520
    (SPATIAL_BOUNDS, (0, 0, 3.75), CONTACT),
    (SPATIAL_BOUNDS, (0, 0, -1.5), MARGIN_ONLY),
    (SPATIAL_BOUNDS, (0, 0, above(-1.5)), CLEAR),
]


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize(("world", "position", "expected"), PLACES)
def test_obstacles(engine: str, world: World, position: Any, expected: tuple[bool, bool]) -> None:
    problem = open_problem(1, world.dimension, None, RADIUS, margin=MARGIN)
    problem = problem.replace(world=world, start=_inside(world, problem), goal=_goal(world))
    result = stand(get_engine(engine), problem, [position])
    assert (bool(result.collided[0]), bool(result.margin_violated[0])) == expected


def _inside(world: World, problem: Any) -> np.ndarray:
    start = np.zeros((1, problem.state_size))
    start[0, :2] = 3, 100
    return start


def _goal(world: World) -> np.ndarray:
    return np.array([[3.0, 99.0, 0.0]])[:, : world.dimension]


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize(
    ("second", "expected"),
    [
        ((0.75, 1.0), CONTACT),  # 5/4 apart, and radii of 1/2 and 3/4
        ((0.75, above(1.0)), MARGIN_ONLY),
        ((-0.9, -1.2), MARGIN_ONLY),  # 3/2 apart, to rounding
        ((0.0, 1.5), MARGIN_ONLY),
        ((0.0, above(1.5)), CLEAR),
        ((0.0, 0.0), CONTACT),
    ],
)
def test_two_robots(engine: str, second: Any, expected: tuple[bool, bool]) -> None:
    problem = open_problem(2, radius=[0.5, 0.75], margin=MARGIN)
    result = stand(get_engine(engine), problem, [[0, 0], np.array(second) * (1 - 1e-6 * (second[0] == -0.9))])
    assert result.collided.tolist() == [expected[0]] * 2
    assert result.margin_violated.tolist() == [expected[1]] * 2


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_two_robots_in_space(engine: str) -> None:
    problem = open_problem(2, 3, radius=[0.5, 0.375], margin=MARGIN)
    far, near = [[0, 0, 0], [0.25, 0.375, above(0.75)]], [[0, 0, 0], [0.25, 0.375, 0.75]]
    assert stand(get_engine(engine), problem, near).collided.tolist() == [True, True]
    assert stand(get_engine(engine), problem, far).collided.tolist() == [False, False]


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_only_those_that_touch_are_flagged(engine: str) -> None:
    problem = open_problem(4, radius=0.25, margin=0.25)
    result = stand(get_engine(engine), problem, [[0, 0], [5, 0], [0.4, 0], [5.7, 0]])
    assert result.collided.tolist() == [True, False, True, False]
    assert result.margin_violated.tolist() == [True, True, True, True]


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_docked_robot_is_an_obstacle_like_any(engine: str) -> None:
    problem = open_problem(2, radius=0.25)
    states = np.array([[0, 0], [1, 0]], np.float32)
    # The first drives into the second, which is docked, and would meet it after half a second and a bit.
    result = get_engine(engine).step(
        problem.replace(dt=0.5).arrays, states, np.array([False, True]), np.array([[1, 0], [-1, 0]], np.float32)
    )
    np.testing.assert_allclose(result.states, [[0.5, 0], [1, 0]])
    assert result.collided.tolist() == [True, True]


ENGINES = {name: get_engine(name) for name in ENGINE_NAMES}
RADII = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
PAIRS = open_problem(5, radius=RADII, margin=0.1, world=World(2, circles=[[0, 0, 0.3]], boxes=[[1, 1, 2, 2]]))
GRID = arrays.arrays(np.int64, (5, 2), elements=st.integers(-30, 30))


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@given(grid=GRID, order=st.permutations(range(5)))
def test_flags_and_rewards_follow_a_permutation_of_the_robots(engine: str, grid: np.ndarray, order: list[int]) -> None:
    # Off the grid of exact contacts, so that no rounding decides.
    positions = grid / 16 + 0.001
    result = stand(ENGINES[engine], PAIRS, positions)
    permuted = stand(ENGINES[engine], PAIRS.select(order), positions[order])
    np.testing.assert_array_equal(permuted.collided, result.collided[order])
    np.testing.assert_array_equal(permuted.margin_violated, result.margin_violated[order])
    np.testing.assert_allclose(permuted.rewards, result.rewards[order], rtol=1e-6)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@given(grid=GRID)
def test_flags_are_those_of_all_distances(engine: str, grid: np.ndarray) -> None:
    positions = grid / 16 + 0.001
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1) - RADII[:, None] - RADII[None]
    np.fill_diagonal(gaps, np.inf)
    # A contact belongs to both robots: the matrix is symmetric, and so is what follows from it.
    nearest = np.minimum(gaps.min(axis=1), PAIRS.world.clearance(positions) - RADII)
    result = stand(ENGINES[engine], PAIRS, positions)
    for flags, extra in ((result.collided, 0.0), (result.margin_violated, 0.1)):
        decided = np.abs(nearest - extra) > 1e-5
        np.testing.assert_array_equal(flags[decided], nearest[decided] <= extra)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@given(grid=GRID)
def test_a_mirrored_team_has_the_same_contacts(engine: str, grid: np.ndarray) -> None:
    problem = open_problem(5, radius=RADII, margin=0.1)
    positions = grid / 16
    result = stand(ENGINES[engine], problem, positions)
    for mirrored in (-positions, positions[:, ::-1], positions + 2):
        other = stand(ENGINES[engine], problem, mirrored)
        np.testing.assert_array_equal(other.collided, result.collided)
        np.testing.assert_array_equal(other.margin_violated, result.margin_violated)


@pytest.mark.parametrize(
    ("gap", "touched", "flags", "kinds"),
    [
        (0.25, False, MARGIN_ONLY, 1),
        (0.3125, False, CLEAR, 0),
        (0.0, False, CONTACT, 1),
        (9.0, True, CONTACT, 1),
        (0.25, True, CONTACT, 1),
    ],
)
def test_a_dynamic_obstacle_costs_the_penalty_once(
    gap: float, touched: bool, flags: tuple[bool, bool], kinds: int
) -> None:
    """However it was met: at the end of a step, or in the middle of one that another physics has taken."""
    problem = open_problem(1, radius=RADIUS, margin=MARGIN, collision_penalty=2.0)
    layout, worlds = ObservationLayout.for_problem(problem), WorldBatch.from_problem(problem, 1, num_bodies=1)
    worlds.state[0, 0, :2] = 0
    worlds.bodies[0, 0] = [2 * RADIUS + gap, 0, 0, 0, RADIUS]
    worlds.collided[0, 0] = touched
    nothing = np.empty((0, 1, layout.size), np.float32)
    CpuEngine().advance(problem.arrays, layout, 10, np.array([MOVED]), worlds, nothing)
    assert (worlds.collided[0, 0], worlds.violated[0, 0]) == flags
    progress = np.float32(1) - worlds.distance[0, 0] * worlds.inverse[0, 0]
    assert worlds.rewards[0, 0] == progress - 2 * kinds
    assert (worlds.steps[0], worlds.violations[0, 0]) == (1, flags[1])


def test_a_big_team_meets_whom_it_comes_near_to() -> None:
    """From some number of robots on pairs that are far apart are told by boxes."""
    num_robots = BIG_TEAM + 2
    problem = make_problem("random", num_robots=num_robots, seed=0).replace(horizon=70)
    random = np.random.default_rng(0)
    controls = random.normal(size=(70, num_robots, 2)).astype(np.float32)
    trajectory = CpuEngine().rollout(problem, controls)
    gaps = np.linalg.norm(trajectory.positions[:, :, None] - trajectory.positions[:, None], axis=3)
    gaps[:, np.arange(num_robots), np.arange(num_robots)] = np.inf
    radius = np.asarray(problem.team.radius)
    near = (gaps - radius - radius[:, None]).min(axis=2)
    undecided = np.abs(near - problem.margin) < 1e-5
    outside = (
        problem.world.clearance(trajectory.positions.reshape(-1, 2)).reshape(near.shape) <= radius + problem.margin
    )
    np.testing.assert_array_equal(
        trajectory.margin_violated[~undecided], ((near <= problem.margin) | outside)[~undecided]
    )
    assert 0 < trajectory.margin_violated.sum() < trajectory.margin_violated.size
    nobody = np.zeros(num_robots, bool)
    moved = CpuEngine().move(problem.arrays, problem.start, nobody, controls)
    np.testing.assert_array_equal(moved, trajectory.states)
