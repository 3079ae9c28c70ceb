"""Vector instructions written out: masks against numpy, world by world."""

import numba
import numpy as np
import pytest

from d4orm_env.engine import lanes
from d4orm_env.engine.lanes import TILE
from d4orm_env.engine.tiles import aligned_zeros


@numba.njit
def _within_2(w, a, b, reach2):
    return lanes.within_2(w, a, b, reach2)


@numba.njit
def _within_3(w, a, b, reach2):
    return lanes.within_3(w, a, b, reach2)


@numba.njit
def _at_most(w, offset, bound):
    return lanes.at_most(w, offset, bound)


@numba.njit
def _subtract_where(w, offset, mask, amount):
    lanes.subtract_where(w, offset, mask, amount)


def bits(mask):
    return np.array([int(mask) >> s & 1 for s in range(TILE)], bool)


@pytest.mark.parametrize(("dimension", "within"), [(2, _within_2), (3, _within_3)])
@pytest.mark.parametrize("seed", range(3))
def test_two_places_are_within_reach_where_their_distance_is(dimension, within, seed):
    w = np.random.default_rng(seed).normal(size=3 + 2 * dimension * TILE).astype(np.float32)
    a, b = 3, 3 + dimension * TILE
    places = w[3:].reshape(2, dimension, TILE).astype(np.float64)
    distance2 = ((places[0] - places[1]) ** 2).sum(axis=0)
    reach2 = np.float32(np.median(distance2) + 1e-3)
    np.testing.assert_array_equal(bits(within(w, a, b, reach2)), distance2 <= reach2)


def test_touching_counts_and_not_a_number_is_nowhere():
    w = np.zeros(4 * TILE, np.float32)
    w[0], w[1], w[2], w[TILE - 1] = 0.5, 0.5000001, np.nan, np.inf
    mask = bits(_within_2(w, 0, 2 * TILE, np.float32(0.25)))
    assert mask[[0, 3]].all()
    assert not mask[[1, 2, TILE - 1]].any()
    assert mask.sum() == TILE - 3


def test_rows_are_compared_to_a_bound():
    w = np.arange(2 * TILE, dtype=np.float32)
    assert int(_at_most(w, 0, np.float32(2))) == 0b111
    assert int(_at_most(w, 1, np.float32(63))) == 2**63 - 1
    assert int(_at_most(w, TILE, np.float32(63.5))) == 0


def test_an_amount_is_taken_where_the_mask_says_and_nowhere_else():
    w = np.ones(3 * TILE, np.float32)
    _subtract_where(w, TILE, np.uint64(1 << 63 | 1 << 17 | 1), np.float32(0.25))
    changed = np.ones(3 * TILE, np.float32)
    changed[[TILE, TILE + 17, TILE + 63]] = 0.75
    np.testing.assert_array_equal(w, changed)


@pytest.mark.parametrize("size", [1, 64, 1088])
def test_workspaces_begin_with_a_cache_line(size):
    space = aligned_zeros(size)
    assert space.ctypes.data % 64 == 0
    assert space.shape == (size,)
    assert not space.any()
