"""Range sensors: numbers of small scenes, and a plain caster of rays that shares no code with the package's."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest

from d4orm_env import make_problem, navigation_v0
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.disturbances import Intruder, Occlusion, RayNoise, StateNoise
from d4orm_env.jax import functional
from d4orm_env.jax.functional_env import FunctionalEnv

STEP = 1e-3
"""Resolution of the plain caster [m]."""

SCENE = Problem(
    Team(("unicycle", "unicycle"), radius=[0.25, 0.5]),
    [[0, 0, math.pi / 2], [0, 3, 0]],
    [[4, 2], [0, 6]],
    World(
        2,
        circles=[[-3, 0, 1]],
        boxes=[[2, -1, 3, 1]],
        polygons=[[[-1, -2], [1, -2], [0, -4]]],
        lower=[-6, -7],
        upper=[9, 8],
    ),
)
"""From the first robot: the other one ahead, a disc on the left, a triangle behind and a box on the right."""


def rays_of(problem: Problem, num_rays: int, **options: Any) -> np.ndarray:
    """``(K, R)`` rays at a reset."""
    env = navigation_v0.parallel_env(problem=problem, observed_rays=num_rays, **options)
    observations, _ = env.reset(seed=0)
    return np.stack(list(observations.values()))[:, env.unwrapped._simulation.setup.layout.rays]


def test_rays_begin_at_the_centre_and_the_first_one_goes_ahead() -> None:
    first, second = rays_of(SCENE, 4, ray_range=20)
    assert first == pytest.approx([2.5, 2, 2, 2], abs=1e-5)
    # Its heading is along the x axis: the right bound, the upper one, the left one and the first robot below.
    assert second == pytest.approx([9, 5, 6, 2.75], abs=1e-5)
    # At 45 degrees ahead to the left the bounds; to the right likewise, past the box.
    assert rays_of(SCENE, 8, ray_range=20)[0, [1, 7]] == pytest.approx(np.sqrt(2) * np.array([6, 8]), abs=1e-5)


def test_a_ray_that_meets_nothing_reads_the_range_and_one_from_within_zero() -> None:
    assert rays_of(SCENE, 4, ray_range=2.25)[0] == pytest.approx([2.25, 2, 2, 2])
    inside = SCENE.replace(world=World(2, boxes=[[1, 1, 2, 2]]))
    env = navigation_v0.parallel_env(problem=inside, observed_rays=5, ray_range=3)
    env.reset(seed=0)
    observations, _ = env.unwrapped.set_state([[1.5, 1.5, 0], [-4, -4, 0]])
    assert (observations["robot_0"][-5:] == 0).all()
    assert env.observation_space("robot_0").high[-5:] == pytest.approx([3] * 5)


def _occupied(problem: Problem, states: np.ndarray, robot: int, points: np.ndarray) -> np.ndarray:
    """Whether anything but the robot itself is at points ``(N, 2)``; independent of the package's geometry."""
    world, hit = problem.world, np.zeros(len(points), bool)
    for other in range(problem.num_robots):
        if other != robot:
            hit |= np.linalg.norm(points - states[other, :2], axis=1) <= problem.team.radius[other]
    for x, y, radius in world.circles:
        hit |= np.hypot(points[:, 0] - x, points[:, 1] - y) <= radius
    for low_x, low_y, high_x, high_y in world.boxes:
        hit |= ((points >= [low_x, low_y]) & (points <= [high_x, high_y])).all(axis=1)
    for corners in world.polygons:
        crossings = np.zeros(len(points), int)
        for a, b in zip(corners, np.roll(corners, -1, axis=0)):
            straddles = (a[1] > points[:, 1]) != (b[1] > points[:, 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                at = a[0] + (points[:, 1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
            crossings += straddles & (points[:, 0] < at)
        hit |= crossings % 2 == 1
    if world.lower is not None:
        hit |= ((points < world.lower) | (points > world.upper)).any(axis=1)
    return hit


def _walked(problem: Problem, states: np.ndarray, num_rays: int, reach: float) -> np.ndarray:
    """``(K, R)`` rays by walking along them in small steps."""
    along = np.arange(0, reach, STEP)
    out = np.full((problem.num_robots, num_rays), reach)
    for robot, model in enumerate(problem.team.robot_models):
        heading = 0.0 if model.heading_index is None else float(states[robot, model.heading_index])
        for ray in range(num_rays):
            angle = heading + 2 * np.pi * ray / num_rays
            points = states[robot, :2] + along[:, None] * np.array([np.cos(angle), np.sin(angle)])
            hits = np.flatnonzero(_occupied(problem, states, robot, points))
            out[robot, ray] = along[hits[0]] if len(hits) else reach
    return out


@pytest.mark.parametrize("seed", range(6))
def test_rays_are_those_of_a_caster_that_walks_along_them(seed: int) -> None:
    random = np.random.default_rng(seed)
    boxes = random.uniform(-4, 3, (3, 2))
    polygons = [[[-3, 2.5], [-1, 2], [-2.2, 2.8], [-1, 3.5]], [[2, -3], [3.5, -2.5], [2.5, -1.5]]]
    world = World(
        2,
        circles=np.column_stack([random.uniform(-4, 4, (3, 2)), random.uniform(0.1, 0.6, 3)]),
        boxes=np.hstack([boxes, boxes + random.uniform(0.1, 1.5, (3, 2))]),
        polygons=polygons[: seed % 3],
        **({"lower": [-4.5, -4.5], "upper": [4.5, 4.5]} if seed % 2 else {}),
    )
    team = Team(("differential_drive", "holonomic2d", "differential_drive") * 2, radius=0.2)
    clear = [point for point in random.uniform(-4, 4, (500, 2)) if world.clearance(point) > 0.3]
    apart: list[np.ndarray] = []
    for point in clear:
        if all(np.linalg.norm(point - other) > 0.6 for other in apart):
            apart.append(point)
    start = np.zeros((6, team.state_size), np.float32)
    start[:, :2] = apart[:6]
    start[[0, 2, 3, 5], 2] = random.uniform(-20, 20, 4)  # the headings
    problem = Problem(team, start, np.stack(apart[:6]), world)
    error = np.abs(rays_of(problem, 16, ray_range=6) - _walked(problem, problem.start, 16, 6.0))
    # A walker may step over a corner that a ray only grazes.
    assert (error > 2 * STEP).sum() <= 1
    assert np.median(error) <= STEP


@pytest.mark.parametrize("seed", range(3))
def test_jax_measures_the_same(seed: int) -> None:
    random = np.random.default_rng(seed)
    layout = ObservationLayout.for_problem(SCENE, num_rays=32, ray_range=6.0)
    env = navigation_v0.parallel_env(problem=SCENE, observed_rays=32, ray_range=6.0)
    env.reset(seed=0)
    states = np.column_stack([random.uniform(-4, 4, (2, 2)), random.uniform(-9, 9, 2)]).astype(np.float32)
    observations, _ = env.unwrapped.set_state(states)
    state = functional.reset(SCENE, jax.random.key(0))._replace(states=states)
    seen = jax.jit(partial(functional.observe, layout=layout))(SCENE, state)
    np.testing.assert_allclose(seen, np.stack(list(observations.values())), atol=5e-4)


def test_batched_and_joint_environments_measure_the_same() -> None:
    options = {"scenario": "random", "num_robots": 3, "num_obstacles": 3, "observed_rays": 8}
    vector = gymnasium.make_vec("d4orm/Navigation-v0", 3, "vector_entry_point", **options)
    observed, _ = vector.reset(seed=[5, 6, 7])
    joint = gymnasium.make("d4orm/Navigation-v0", **options)
    for world, seed in enumerate((5, 6, 7)):
        np.testing.assert_array_equal(joint.reset(seed=seed)[0], observed[world].ravel())
    controls = np.ones(vector.action_space.shape, np.float32)
    np.testing.assert_array_equal(vector.step(controls)[0][2].ravel(), joint.step(controls[2].ravel())[0])


def test_rays_meet_intruders_and_measure_the_truth_where_states_are_seen_with_noise() -> None:
    env = navigation_v0.parallel_env(
        problem=SCENE, observed_rays=64, ray_range=20, disturbances=[Intruder(1, 0.5, 0.5), StateNoise(0.3)]
    )
    env.reset(seed=0)
    simulation = env.unwrapped._simulation
    body, layout = simulation.worlds.bodies[0, 0], simulation.setup.layout
    for _ in range(5):
        observations = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})[0]
    body = simulation.worlds.bodies[0, 0]
    state = simulation.states[0]
    gap = body[:2] - state[:2]
    ray = round((math.atan2(gap[1], gap[0]) - state[2]) / (2 * math.pi / 64)) % 64
    expected = rays_of(SCENE, 64, ray_range=20)[0, ray]
    measured = observations["robot_0"][layout.rays][ray]
    assert measured <= min(expected, np.linalg.norm(gap) - 0.45)


def test_noise_is_drawn_from_the_seed_and_leaves_rays_that_meet_nothing_alone() -> None:
    true, one, same, other = (
        rays_of(SCENE, 16, ray_range=4, disturbances=[RayNoise(std)]) for std in (0, 0.1, 0.1, 0.2)
    )
    assert (one == same).all()
    np.testing.assert_allclose((other - true)[true < 3], 2 * (one - true)[true < 3], atol=1e-5)
    assert (one[true == 4] == 4).all()
    assert 0.02 < np.std((one - true)[true < 3]) < 0.2
    hidden = rays_of(SCENE, 4, ray_range=4, disturbances=[Occlusion(2.2)])[0]
    assert hidden == pytest.approx([4, 2, 2, 2])


def test_pure_functions_have_noise_too() -> None:
    env = FunctionalEnv(problem=SCENE, observed_rays=16, ray_range=4.0, disturbances=[RayNoise(0.1)])
    state, observed = jax.jit(env.reset)(jax.random.key(0))
    true = jax.jit(partial(functional.observe, layout=env.layout))(SCENE, state.team)[:, env.layout.rays]
    errors = np.asarray(observed[:, env.layout.rays] - true)
    assert 0.02 < np.std(errors[true < 3]) < 0.2
    assert (errors[np.asarray(true) == 4] == 0).all()
    after, _ = jax.jit(env.step)(jax.random.key(1), state, np.zeros((2, 2), np.float32))
    assert (after.ray_noise != state.ray_noise).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "sphere", "observed_rays": 4}, "rays lie in the plane"),
        ({"problem": SCENE, "observed_rays": -1}, "observed_rays is -1"),
        ({"problem": SCENE, "observed_rays": 4, "ray_range": 0}, "ray_range is 0"),
        ({"problem": SCENE, "disturbances": [RayNoise(0.1)]}, "give observed_rays"),
    ],
)
def test_what_cannot_be_measured_is_an_error(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        navigation_v0.parallel_env(**arguments)


def test_components_have_names() -> None:
    problem = make_problem("circle", num_robots=2)
    names = ObservationLayout.for_problem(problem, 1, 0, observed_path=True, num_rays=2).names
    assert names[-5:] == ("ray_0", "ray_1", "path.direction_x", "path.direction_y", "path.length")
