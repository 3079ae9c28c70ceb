"""Vector instructions written out: masks against numpy, world by world."""

import numba
import numpy as np
import pytest

from d4orm_env.engine import simd
from d4orm_env.engine.compiling import aligned_zeros
from d4orm_env.engine.simd import BLOCK, BOX, CHUNK, TILE


@numba.njit
def _within_2(w, a, b, reach2):
    return simd.within_2(w, a, b, reach2)


@numba.njit
def _within_3(w, a, b, reach2):
    return simd.within_3(w, a, b, reach2)


@numba.njit
def _at_most(w, offset, bound):
    return simd.at_most(w, offset, bound)


@numba.njit
def _subtract_where(w, offset, mask, amount):
    simd.subtract_where(w, offset, mask, amount)


@numba.njit
def _chunk_within_2(w, a, b, reach2):
    return simd.chunk_within_2(w, a, b, reach2)


@numba.njit
def _enclose(w, first, step, widening, boxes, begin):
    simd.enclose(w, first, step, widening, boxes, begin)


@numba.njit
def _overlap(boxes, a, b):
    return simd.worlds_overlap_2(boxes, a, b), simd.lanes_overlap_2(boxes, a, b)


@numba.njit
def _copy_chunk(source, a, target, b):
    simd.copy_chunk(source, a, target, b)


@numba.njit
def _add_turned(sums, a, draws, b, cosine, c, sine, d):
    simd.add_turned(sums, a, draws, b, cosine, c, sine, d)


@numba.njit
def _add_turned_squares(sums, a, draws, b, cosine, c, sine, d):
    simd.add_turned_squares(sums, a, draws, b, cosine, c, sine, d)


def bits(mask):
    return np.array([int(mask) >> s & 1 for s in range(TILE)], bool)


@pytest.mark.parametrize(("dimension", "within"), [(2, _within_2), (3, _within_3)])
@pytest.mark.parametrize("seed", range(3))
def test_two_positions_are_within_reach_where_their_distance_is(dimension, within, seed):
    w = np.random.default_rng(seed).normal(size=3 + 2 * dimension * TILE).astype(np.float32)
    a, b = 3, 3 + dimension * TILE
    positions = w[3:].reshape(2, dimension, TILE).astype(np.float64)
    distance2 = ((positions[0] - positions[1]) ** 2).sum(axis=0)
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


def test_a_chunk_is_the_first_worlds_of_the_rows():
    w = np.random.default_rng(0).normal(size=4 * TILE).astype(np.float32)
    whole, part = (
        bits(_within_2(w, 0, 2 * TILE, np.float32(1.5))),
        bits(_chunk_within_2(w, 0, 2 * TILE, np.float32(1.5))),
    )
    assert whole[:CHUNK].any()
    np.testing.assert_array_equal(part[:CHUNK], whole[:CHUNK])
    assert not part[CHUNK:].any()


def test_boxes_enclose_the_rows_world_by_world_and_lane_by_lane():
    step, first, begin = 2 * TILE, 5, 3
    w = np.random.default_rng(0).normal(size=first + BLOCK * step).astype(np.float32)
    w[first + 7] = np.nan
    w[first + step + 8] = np.inf
    boxes = np.zeros(begin + BOX, np.float32)
    _enclose(w, first, step, np.float32(0.25), boxes, begin)
    rows = np.stack([w[first + i * step : first + i * step + TILE] for i in range(BLOCK)])
    low, high = np.nanmin(rows, axis=0) - np.float32(0.25), np.nanmax(rows, axis=0) + np.float32(0.25)
    expected = [low, high, low.reshape(-1, CHUNK).min(axis=0), high.reshape(-1, CHUNK).max(axis=0)]
    np.testing.assert_array_equal(boxes[begin:], np.concatenate(expected))
    assert not boxes[:begin].any()


def test_boxes_that_touch_overlap_and_others_do_not():
    boxes = np.zeros((2, 2, BOX), np.float32)
    boxes[0, :, TILE : 2 * TILE] = boxes[0, :, 2 * TILE + CHUNK :] = 1
    boxes[1, :, :TILE] = boxes[1, :, 2 * TILE : 2 * TILE + CHUNK] = 2
    boxes[1, :, TILE : 2 * TILE] = boxes[1, :, 2 * TILE + CHUNK :] = 3
    assert _overlap(boxes.ravel(), 0, 2 * BOX) == (0, 0)
    # World 40 touches along both axes, world 41 along one only; so do lanes 5 and 6.
    boxes[1, :, [40, 2 * TILE + 5]] = 1
    boxes[1, 0, [41, 2 * TILE + 6]] = 1
    assert _overlap(boxes.ravel(), 0, 2 * BOX) == (1 << 40, 1 << 5)
    assert _overlap(boxes.ravel(), 2 * BOX, 0) == (1 << 40, 1 << 5)


def test_a_chunk_is_copied_and_nothing_else():
    source, target = np.arange(40, dtype=np.float32), np.full(40, -1, np.float32)
    _copy_chunk(source, 3, target, 10)
    np.testing.assert_array_equal(target[10 : 10 + CHUNK], source[3 : 3 + CHUNK])
    assert (target[:10] == -1).all()
    assert (target[10 + CHUNK :] == -1).all()


@pytest.mark.parametrize("power", [1, 2])
def test_turned_draws_are_added_with_their_weights(power):
    random = np.random.default_rng(power)
    sums, draws, cosine, sine = (random.normal(size=3 * CHUNK).astype(np.float32) for _ in range(4))
    x, y = draws[2 : 2 + CHUNK].astype(float), draws[2 + CHUNK : 2 + 2 * CHUNK].astype(float)
    c, s = cosine[4 : 4 + CHUNK], sine[1 : 1 + CHUNK]
    added = [c * x - s * y, c * y + s * x] if power == 1 else [c * x * x + s * y * y, c * y * y + s * x * x]
    expected = sums.astype(float)
    expected[3 : 3 + 2 * CHUNK] += np.concatenate(added)
    (_add_turned if power == 1 else _add_turned_squares)(sums, 3, draws, 2, cosine, 4, sine, 1)
    np.testing.assert_allclose(sums, expected, atol=1e-6)


@pytest.mark.parametrize("size", [1, 64, 1088])
def test_workspaces_begin_with_a_cache_line(size):
    space = aligned_zeros(size)
    assert space.ctypes.data % 64 == 0
    assert space.shape == (size,)
    assert not space.any()
