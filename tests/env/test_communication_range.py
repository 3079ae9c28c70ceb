"""Neighbours that are too far away or behind an obstacle are not observed."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import numpy as np
import pytest

from d4orm_env import navigation_v0
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.disturbances import Intruder
from d4orm_env.jax import functional

ROW = Problem(
    Team(("holonomic2d",) * 5, radius=0.1),
    np.column_stack([[0, 1, 2, 3.5, 5], np.zeros((5, 3))]),
    np.column_stack([[0, 1, 2, 3.5, 5], np.full(5, 4)]),
    World(2, boxes=[[0.4, -1, 0.6, 0.5]], circles=[[2.7, 0.4, 0.5]], polygons=[[[4, -1], [4.5, -1], [4.2, 1]]]),
)
"""A box, a disc and a triangle stand between the first two robots, the next two and the last two."""


def neighbours_of(problem: Problem, **options: Any) -> list[list[float]]:
    """How far every robot's observed neighbours are along the x axis."""
    env = navigation_v0.parallel_env(problem=problem, **options)
    observations, _ = env.reset(seed=0)
    layout = env.unwrapped._simulation.setup.layout
    rows = layout.neighbors(np.stack(list(observations.values())))
    return [[float(row[1]) for row in robot if row[0]] for robot in rows]


def test_neighbours_within_the_range_are_observed() -> None:
    assert neighbours_of(ROW, communication_range=1.5) == [[1], [-1, 1], [-1, 1.5], [-1.5, 1.5], [-1.5]]
    assert neighbours_of(ROW, communication_range=1.4)[3] == []
    assert neighbours_of(ROW) == neighbours_of(ROW, communication_range=100)


def test_those_behind_obstacles_are_not_and_others_take_their_place() -> None:
    assert neighbours_of(ROW, line_of_sight=True) == [[], [1], [-1], [], []]
    # Of five robots two nearest are listed: from above, the third one is seen past those that are hidden.
    raised = ROW.replace(start=ROW.start + np.array([[0, 2, 0, 0]] * 4 + [[0, 0, 0, 0]]))
    assert neighbours_of(raised, line_of_sight=True, observed_robots=2)[0] == [1, 2]
    assert neighbours_of(raised, line_of_sight=True, communication_range=1.5)[2] == [-1, 1.5]


@pytest.mark.parametrize("options", [{"communication_range": 1.6}, {"line_of_sight": True}])
def test_jax_and_a_batch_of_worlds_observe_the_same(options: dict[str, Any]) -> None:
    layout = ObservationLayout.for_problem(ROW, **options)
    env = navigation_v0.parallel_env(problem=ROW, **options)
    observe = jax.jit(partial(functional.observe, layout=layout))
    state, random = functional.reset(ROW, jax.random.key(0)), np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(10):
        states = np.concatenate([random.uniform(-1, 5, (5, 2)), np.zeros((5, 2))], axis=1).astype(np.float32)
        observations, _ = env.unwrapped.set_state(states)
        seen = observe(ROW, state._replace(states=states))
        np.testing.assert_allclose(seen, np.stack(list(observations.values())), atol=1e-5)


def test_intruders_are_neighbours_too() -> None:
    options = {"problem": ROW, "disturbances": [Intruder(3)], "observed_robots": 7}
    near, far = (neighbours_of(communication_range=reach, **options) for reach in (0.5, 100))
    assert [len(row) for row in far] == [7] * 5
    assert sum(map(len, near)) < 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"communication_range": 0}, "communication_range is 0"),
        ({"line_of_sight": 1}, "line_of_sight is 1; it must be True or False"),
        ({"scenario": "sphere", "line_of_sight": True}, "line_of_sight is for the plane"),
    ],
)
def test_bad_arguments_are_errors(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        navigation_v0.parallel_env(**arguments)
