"""Boxes rule out only what does not touch: flags against all distances, numpy in double precision."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from d4orm_env import World, make_problem
from d4orm_env.engine.compiling import aligned_zeros
from d4orm_env.engine.simd import BLOCK, TILE
from d4orm_planners.engine import proximity
from d4orm_planners.engine.cpu_sampling import bound_boxes, make_bodies
from d4orm_planners.engine.proximity import make_scratch
from d4orm_planners.engine.sampling_types import MovingObstacles

PROBLEMS = {2: make_problem("circle", num_robots=2), 3: make_problem("sphere", num_robots=2)}


@numba.njit
def _enclose(radius, margin, dimension, table, scratch):
    for k in range(radius.shape[0]):
        proximity.enclose(k, radius[k] + np.float32(0.5) * margin, dimension, table, scratch.boxes)


@numba.njit
def _mark(arrays, bodies, digits, first, count, table, turns, scratch):
    proximity.mark_robots(arrays, bodies, digits, first, count, table, turns, scratch)


@numba.njit
def _near_static(arrays, k, bounds, scratch):
    return proximity.near_static(arrays, k, bounds, scratch.boxes, scratch.buffer)


def table_of(positions):
    """Positions ``(K, BLOCK, TILE, d)`` in the kernel's rows."""
    rows = positions.transpose(0, 1, 3, 2).ravel()
    table = aligned_zeros(rows.size)
    table[:] = rows
    return table


def walk(random, num_robots, dimension, spread, samples):
    """Random places of robots in a block: where each is, how its samples differ, how it moves."""
    centre = random.uniform(-1.5, 1.5, (num_robots, 1, 1, dimension))
    sample = samples * random.normal(size=(num_robots, 1, TILE, dimension))
    steps = np.cumsum(spread * random.normal(size=(num_robots, BLOCK, TILE, dimension)), axis=1)
    return (centre + sample + steps).astype(np.float32)


def bits(masks):
    return (masks[..., None] >> np.arange(TILE, dtype=np.uint64)) & np.uint64(1) == 1


@pytest.mark.parametrize("dimension", [2, 3])
@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32), num_robots=st.integers(1, 7), num_bodies=st.integers(0, 3), count=st.integers(1, BLOCK),
    spread=st.floats(0, 0.3), samples=st.sampled_from([0.0, 0.05, 0.5, 3.0]), broken=st.booleans(),
    digits=st.sampled_from([1, 2, 4]),
)  # fmt: skip
def test_whatever_is_within_the_margin_is_counted_and_nothing_else(
    dimension, seed, num_robots, num_bodies, count, spread, samples, broken, digits
):
    random = np.random.default_rng(seed)
    positions = walk(random, num_robots, dimension, spread, samples)
    if broken:
        positions[0, :, random.integers(TILE)] = random.choice([np.nan, np.inf, -np.inf])
    radius, margin = random.uniform(0.05, 0.3, num_robots).astype(np.float32), np.float32(0.05)
    first = BLOCK
    moving = random.uniform(-1.5, 1.5, (first + count, num_bodies, dimension)).astype(np.float32)
    moving_radius = random.uniform(0.05, 0.3, num_bodies).astype(np.float32)
    scratch, table = make_scratch(num_robots, dimension), table_of(positions)
    _enclose(radius, margin, dimension, table, scratch)
    goal = np.zeros((num_robots, dimension), np.float32)
    arrays = PROBLEMS[dimension].arrays._replace(radius=radius, margin=margin, goal=goal)
    bodies = make_bodies(MovingObstacles(moving, moving_radius), margin)
    _mark(arrays, bodies, digits, first, count, table, aligned_zeros(0), scratch)

    steps = np.minimum(first + np.arange(BLOCK), first + count - 1)
    bodies = moving[steps].astype(np.float64).transpose(1, 0, 2)[:, :, None]
    things = [*positions.astype(np.float64), *np.broadcast_to(bodies, (num_bodies, BLOCK, TILE, dimension))]
    reach = np.concatenate([radius, moving_radius]).astype(np.float64)
    counted = (bits(scratch.near[:digits]) << np.arange(digits)[:, None, None, None]).sum(axis=0)
    # The last digit stands for all that does not fit.
    most = 2 ** (digits - 1)
    for k in range(num_robots):
        surely, perhaps = np.zeros((BLOCK, TILE), int), np.zeros((BLOCK, TILE), int)
        for other in range(len(things)):
            if other != k:
                with np.errstate(invalid="ignore"):
                    gap = np.sqrt(((things[k] - things[other]) ** 2).sum(axis=-1)) - reach[k] - reach[other] - margin
                # What single precision cannot tell may come out either way.
                surely += gap < -1e-5
                perhaps += gap < 1e-5
        found = counted[k, :count]
        assert (found >= np.minimum(surely[:count], most)).all()
        assert (found <= perhaps[:count]).all()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", range(40))
def test_obstacles_and_bounds_are_looked_at_where_a_sample_is_near(dimension, seed):
    random = np.random.default_rng(seed)
    model = "holonomic2d" if dimension == 2 else "holonomic3d"
    far = random.uniform(3, 6, (3, dimension))
    world = World(
        dimension, lower=np.full(dimension, -7.0), upper=np.full(dimension, 9.0),
        boxes=[[*(far[1] - 0.2), *(far[1] + 0.3)]], cylinders=[[*far[2, :2], 0.4]] if dimension == 3 else (),
        **{"circles" if dimension == 2 else "spheres": [[*far[0], 0.5]]},
    )  # fmt: skip
    problem = make_problem("circle", num_robots=2, model=model).replace(world=world)
    arrays = problem.arrays
    scratch, bounds = make_scratch(2, dimension), bound_boxes(arrays)
    position = random.uniform(-8, 10, (2, 1, 1, dimension)) + 0.1 * random.normal(size=(2, BLOCK, TILE, dimension))
    _enclose(arrays.radius, arrays.margin, dimension, table_of(position.astype(np.float32)), scratch)
    for k in range(2):
        reach = problem.team.radius[k] + problem.margin
        gaps = [np.linalg.norm(position[k] - far[0], axis=-1) - 0.5]
        outside = np.maximum(np.maximum(far[1] - 0.2 - position[k], position[k] - far[1] - 0.3), 0)
        gaps += [np.linalg.norm(outside, axis=-1), (position[k] + 7).min(axis=-1), (9 - position[k]).min(axis=-1)]
        if dimension == 3:
            gaps.append(np.linalg.norm(position[k][..., :2] - far[2, :2], axis=-1) - 0.4)
        if min(gap.min() for gap in gaps) < reach - 1e-5:
            assert _near_static(arrays, k, bounds, scratch)
        if min(gap.min() for gap in gaps) > 1.5 + reach + 2 * arrays.grid.slack:
            assert not _near_static(arrays, k, bounds, scratch)
