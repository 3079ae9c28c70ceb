"""Who comes near whom: what the index of paths says is what every pair at every step says."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.engine.threads import Threads
from d4orm_planners.engine import path_index, path_table
from d4orm_planners.engine.path_index import PathIndex, check_alone

RADIUS = np.array([0.125, 0.25, 0.5, 0.0, 0.25])


def near(paths: np.ndarray, path: np.ndarray, robot: int, margin: float) -> np.ndarray:
    """``(H, K)`` whom a robot on a path comes near after each step, by looking at all."""
    gap2 = ((paths[1:].astype(np.float64) - path[1:, None].astype(np.float64)) ** 2).sum(axis=2)
    close = gap2 <= (RADIUS + RADIUS[robot] + margin) ** 2
    close[:, robot] = False
    return close


def drawn_paths(dimension: int, count: int = 5) -> st.SearchStrategy[np.ndarray]:
    """``(H+1, count, d)`` with a horizon that is no whole number of blocks."""
    return arrays(np.float32, (22, count, dimension), elements=st.floats(-3, 3, width=32))


@pytest.mark.parametrize("dimension", [2, 3])
@given(st.data(), st.floats(0, 1))
def test_pairs_and_counts_are_those_of_looking_at_all(dimension: int, data: Any, margin: float) -> None:
    paths, others = data.draw(drawn_paths(dimension)), data.draw(drawn_paths(dimension, 3))
    index = PathIndex(paths, RADIUS, margin)
    expected = [(i, j) for i in range(5) for j in range(i + 1, 5) if near(paths, paths[:, i], i, margin)[:, j].any()]
    assert [tuple(pair) for pair in index.pairs().tolist()] == expected
    met, when = index.count_meetings([4, 1], np.stack([others.swapaxes(0, 1)] * 2))
    for row, robot in enumerate([4, 1]):
        for path in range(3):
            close = near(paths, others[:, path], robot, margin)
            assert met[row, path] == close.any(axis=0).sum()
            assert when[row, path] == (close.any(axis=1).argmax() + 1 if close.any() else 22)


@given(drawn_paths(2), drawn_paths(2, 2))
def test_robots_that_were_moved_are_found_where_they_are(paths: np.ndarray, others: np.ndarray) -> None:
    index = PathIndex(paths, RADIUS, 0.1)
    index.move([3, 0], others)
    changed = paths.copy()
    changed[:, [3, 0]] = others
    np.testing.assert_array_equal(index.positions, changed)
    np.testing.assert_array_equal(index.pairs(), PathIndex(changed, RADIUS, 0.1).pairs())


@numba.njit
def _both_counts(table, robot, exclude, path, block, box, nearby):
    first, _ = path_table.steps_of(table, block)
    path_table.find_nearby(table, robot, exclude, box, block, nearby)
    many = path_table.count_near(table, robot, exclude, path, first, block)
    return many, path_table.count_among(table, robot, nearby, path, block)


@pytest.mark.parametrize("dimension", [2, 3])
@given(st.data(), st.floats(0, 1))
def test_counting_among_those_nearby_is_counting_in_buckets(dimension: int, data: Any, margin: float) -> None:
    """Even where cells share a bucket, and a robot counts twice."""
    index, others = PathIndex(data.draw(drawn_paths(dimension)), RADIUS, margin), data.draw(drawn_paths(dimension, 1))
    nearby, exclude = path_table.make_nearby(5), np.array([2, 4])
    for block in range(3):
        path = np.zeros((path_table.BLOCK, dimension), np.float32)
        steps = others[1 + block * path_table.BLOCK :][: path_table.BLOCK, 0]
        path[: len(steps)] = steps
        low, high = (
            tuple(np.pad(end(axis=0).astype(float), (0, 3 - dimension)).tolist()) for end in (steps.min, steps.max)
        )
        many, few = _both_counts(index.table, 4, exclude, path, block, (low, high), nearby)
        assert many == few


def test_who_has_stopped_is_still_met_by_who_comes_later() -> None:
    """The index leaves out blocks in which nothing moves; the first stands there from the start on."""
    paths = np.zeros((60, 2, 2), np.float32)
    paths[:, 1, 0] = np.concatenate([np.full(50, 9.0), np.linspace(9, 0, 10)])
    assert PathIndex(paths, RADIUS[:2], 0.1).pairs().tolist() == [[0, 1]]
    waiting = np.full((1, 1, 60, 2), 5.0, np.float32)
    still = paths.copy()
    still[:, 1] = [9, 0]
    index = PathIndex(still, RADIUS[:2], 0.1)
    assert index.count_meetings([0], waiting)[0].tolist() == [[0]]
    waiting[0, 0, 30:] = [9, 0]
    assert [values.tolist() for values in index.count_meetings([0], waiting)] == [[[1]], [[30]]]


def test_any_number_of_threads_says_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(0)
    paths = np.cumsum(random.normal(size=(80, 60, 2)) / 5, axis=0, dtype=np.float32) + random.uniform(-4, 4, (60, 2))
    results = []
    for threads in (1, 2, 5):
        monkeypatch.setattr(path_index, "Threads", lambda _, threads=threads: Threads(threads))
        index = PathIndex(paths, np.full(60, 0.15), 0.05)
        others = np.ascontiguousarray(paths.swapaxes(0, 1))[:, None]
        results.append([index.pairs(), *index.count_meetings(np.arange(60), others)])
    for other in results[1:]:
        for one, same in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(one, same)
    assert len(results[0][0]) > 10


def test_a_path_alone_touches_stops_and_is_unsure_when_it_is() -> None:
    """Past a circle, and on to where the goal begins: there rounding decides."""
    world = World(circles=[[2, 0.4, 0.25]])
    problem = Problem(Team(("holonomic2d",)), [[0, 0, 0, 0]], [[4, 0]], world, horizon=50, goal_radius=0.25)
    path = np.zeros((1, 2, 51, 2), np.float32)
    path[0, 0, :, 0] = np.minimum(np.linspace(0, 5, 51), 3.75)
    path[0, 1, :, 1] = -np.minimum(np.arange(51) / 10, 1)
    touching, moves, unsure = check_alone(problem.arrays, [0], path)
    clearance = world.clearance(path[0, 0]) <= float(problem.team.radius[0]) + problem.margin
    assert touching.tolist() == [[int(clearance.argmax()), 51]]
    assert moves.tolist() == [[38, 10]]
    assert unsure.tolist() == [[38, 51]]
