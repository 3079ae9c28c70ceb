"""Rays among footprints: they end where an independent library says, on the CPU, in batches and in JAX."""

from __future__ import annotations

from functools import partial

import gymnasium
import jax
import numpy as np
import pytest
from shapely import affinity
from shapely import geometry as shapely

from d4orm_env import Problem, Team, navigation_v0
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.footprints import Box, Capsule, Disc, Footprint, Polygon, Train
from d4orm_env.jax import functional

RAYS, RANGE = 64, 6.0
KITE = Polygon([[0.3, 0.0], [0.0, 0.2], [-0.2, 0.1], [-0.2, -0.1]])
SHAPES: tuple[Footprint, ...] = (Box(0.6, 0.2, 0.1), Capsule(0.4, 0.1, -0.1), KITE, Disc(0.2))
HITCH = 0.5


def region(footprint: Footprint, x: float, y: float, turn: float) -> shapely.base.BaseGeometry:
    """What a body covers."""
    corners, rounding = footprint.core  # type: ignore[attr-defined]
    kinds = {1: lambda: shapely.Point(corners[0]), 2: lambda: shapely.LineString(corners)}
    core = kinds.get(len(corners), lambda: shapely.Polygon(corners))()
    placed = affinity.translate(affinity.rotate(core, turn, origin=(0, 0), use_radians=True), x, y)
    return placed.buffer(rounding, quad_segs=500) if rounding else placed


def bodies(problem: Problem, states: np.ndarray) -> list[list[shapely.base.BaseGeometry]]:
    """Those of each robot, at states ``(K, n)``."""
    listed = []
    for footprint, state in zip(problem.team.footprint, states.astype(float), strict=True):
        front = footprint.front if isinstance(footprint, Train) else footprint
        own = [region(front, *state[:3])]
        if isinstance(footprint, Train):
            turn = state[2] - state[3]
            at = state[:2] - HITCH * np.array([np.cos(turn), np.sin(turn)])
            own.append(region(footprint.trailers[0], *at, turn))
        listed.append(own)
    return listed


def expected(problem: Problem, states: np.ndarray) -> np.ndarray:
    """``(K, R)`` rays by shapely."""
    out, all_bodies = np.full((len(states), RAYS), RANGE), bodies(problem, states)
    for robot, state in enumerate(states.astype(float)):
        others = shapely.GeometryCollection([one for k, own in enumerate(all_bodies) if k != robot for one in own])
        for ray in range(RAYS):
            angle = state[2] + 2 * np.pi * ray / RAYS
            begin = shapely.Point(state[:2])
            line = shapely.LineString([begin, state[:2] + RANGE * np.array([np.cos(angle), np.sin(angle)])])
            hits = [one.intersection(line) for one in others.geoms]
            out[robot, ray] = min([hit.distance(begin) for hit in hits if not hit.is_empty], default=RANGE)
    return out


def teams() -> dict[str, Problem]:
    """A team of one footprint each, and one that pulls trailers."""
    positions = np.array([[0, 0], [2, 0], [0, 2], [2, 2]], float)
    alone = Team(("differential_drive",) * 4, footprint=SHAPES)
    train = Train(Box(0.5, 0.25, 0.1), [Capsule(0.2, 0.1)])
    pulling = Team(("car_with_1_trailer",) * 4, footprint=[train, train, train, Train(KITE, [Box(0.3, 0.2)])])
    start, goals = np.pad(positions, ((0, 0), (0, 2))), positions + np.array([0, 4])
    # With goal headings, as other tests have kernels compiled for the one.
    return {
        "alone": Problem(alone, start, goals, goal_heading=0.0),
        "pulling": Problem(pulling, start, goals),
    }


@pytest.mark.parametrize("name", ["alone", "pulling"])
def test_rays_end_where_shapely_says(name: str) -> None:
    problem, random = teams()[name], np.random.default_rng(1)
    env = navigation_v0.parallel_env(problem=problem, observed_rays=RAYS, ray_range=RANGE)
    env.reset(seed=0)
    layout = ObservationLayout.for_problem(problem, num_rays=RAYS, ray_range=RANGE)
    observe = jax.jit(partial(functional.observe, layout=layout))
    met = 0
    for _ in range(5):
        states = np.zeros_like(problem.start)
        states[:, :2] = random.uniform(-1.2, 1.2, (4, 2))
        states[:, 2:3] = random.uniform(-4, 4, (4, 1))
        if name == "pulling":
            states[:, 3] = random.uniform(-0.7, 0.7, 4)
        truth = expected(problem, states)
        seen = np.stack(list(env.unwrapped.set_state(states)[0].values()))[:, layout.rays]
        # A ray may graze a corner.
        assert (np.abs(seen - truth) > 1e-4).sum() <= 1
        state = functional.reset(problem, jax.random.key(0))._replace(states=states)
        np.testing.assert_allclose(np.asarray(observe(problem, state))[:, layout.rays], seen, atol=5e-4)
        met += int((truth < RANGE).sum())
    assert met > 200


def test_batches_measure_the_same() -> None:
    problem = teams()["pulling"]
    options = {"problem": problem, "observed_rays": 8}
    vector = gymnasium.make_vec("d4orm/Navigation-v0", 3, "vector_entry_point", **options)
    joint = gymnasium.make("d4orm/Navigation-v0", **options)
    observed, first = vector.reset(seed=0)[0], joint.reset(seed=0)[0]
    np.testing.assert_array_equal(observed[2], first)
    controls = np.ones(vector.action_space.shape, np.float32)
    np.testing.assert_array_equal(vector.step(controls)[0][1], joint.step(controls[1])[0])
