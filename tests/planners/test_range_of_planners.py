"""Policies that decide for each robot by itself know only of those within an environment's communication range."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from d4orm_env import Problem, Team, World, make_problem, navigation_v0
from d4orm_env.engine.observing import communication_links
from d4orm_planners import make_planner, make_policy, run_episode
from d4orm_planners.base.solve import SolveRun

WALL = Problem(
    Team(("velocity2d",) * 3), [[0, 0], [1.5, 0], [0, 1.5]], [[3, 0], [-2, 0], [0, 3]], World(boxes=[[0.7, -1, 0.8, 1]])
)


def test_links_are_those_of_observations() -> None:
    for reach, sight in ((None, False), (1.6, False), (1.0, False), (None, True), (1.6, True)):
        links = communication_links(WALL, WALL.start[:, :2], reach, sight)
        env = navigation_v0.parallel_env(problem=WALL, communication_range=reach, line_of_sight=sight)
        observations, _ = env.reset(seed=0)
        rows = env.unwrapped._simulation.setup.layout.neighbors(np.stack(list(observations.values())))
        np.testing.assert_array_equal(links.sum(axis=1), rows[..., 0].sum(axis=1))
        assert not links.diagonal().any()


def first_actions(**options: Any) -> np.ndarray:
    """``(2, 2)`` what ORCA does with two robots that meet head on, 2 m apart."""
    problem = Problem(Team(("velocity2d",) * 2), [[-1, 0], [1, 0.05]], [[2, 0], [-2, 0.05]])
    policy = make_policy("orca", deviation=0.0)
    env = navigation_v0.parallel_env(problem=problem, **options)
    observations, _ = env.reset(seed=0)
    policy.reset(env)
    return np.stack(list(policy.act(observations, env.state()).values()))


def test_orca_avoids_those_it_knows_of() -> None:
    pytest.importorskip("pyrvo")
    all_known, near, far = first_actions(), first_actions(communication_range=2.5), first_actions(communication_range=1)
    np.testing.assert_array_equal(near, all_known)
    assert (np.abs(all_known[:, 1]) > 1e-3).all()
    np.testing.assert_allclose(far, [[1, 0], [-1, 0]], atol=1e-5)


def test_nodes_hear_each_other_within_the_range() -> None:
    settings = {"engine": "cpu", "num_samples": 64, "num_steps": 5, "improve": True, "nodes": None}
    problem = make_problem("circle", num_robots=4)  # neighbours 3.5 m apart, opposite ones 5 m
    planner = make_planner("d-d4orm", **settings).within(4.0)
    search = SolveRun(planner, problem, 0, None)
    try:
        search.advance()
        heard = [sorted(node.inbox.newest) for node in search.state.pool.alive]
    finally:
        search.close()
    assert heard == [[1, 3], [0, 2], [1, 3], [0, 2]]
    policy = make_policy("d-d4orm", **settings, max_iterations=1)
    env = navigation_v0.parallel_env(problem=problem, communication_range=1.0, max_cycles=1)
    run_episode(env, policy)
    assert policy.plan.provenance is not None


def test_a_range_is_for_nodes_that_are_robots() -> None:
    with pytest.raises(ValueError, match="give nodes=None"):
        make_planner("d-d4orm", nodes=2, communication_range=2.0)
    central = make_planner("d-d4orm", nodes=2)
    assert central.within(1.0) is central
