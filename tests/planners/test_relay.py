"""Paths for a team that never rests: new ones around those that the others have, who leave their goals again."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from d4orm_env import Problem, Team, World, make_problem, navigation_v0
from d4orm_env.core.arrays import FloatArray
from d4orm_planners import make_policy, run_episode
from d4orm_planners.mapf.one_by_one import plan_one_by_one
from d4orm_planners.mapf.planner import DWELL, compile_path_finding, relay_paths
from d4orm_planners.mapf.roadmap import lay_roadmap
from d4orm_planners.mapf.roadmap_team import Replanning


def standing(problem: Problem) -> FloatArray:
    """Paths of robots that stay where they are."""
    return problem.start[None, :, : problem.dimension]


def everybody(problem: Problem) -> np.ndarray:
    return np.ones(problem.num_robots, bool)


def arrivals(problem: Problem, paths: FloatArray) -> np.ndarray:
    """``(K,)`` first step at which each robot is at its goal."""
    there = np.linalg.norm(paths - problem.goal, axis=2) <= problem.goal_radius
    assert there.any(axis=0).all()
    return there.argmax(axis=0)


@pytest.mark.parametrize("seed", [0, 1])
def test_paths_keep_everybody_apart_until_they_leave_their_goals(seed: int) -> None:
    problem = make_problem("warehouse", num_robots=12, seed=seed)
    paths = relay_paths(problem, standing(problem), everybody(problem), seed)
    assert paths is not None
    assert paths.shape == (problem.horizon + 1, 12, 2)
    np.testing.assert_array_equal(paths[0], problem.start[:, :2])
    ends, radius = arrivals(problem, paths) + round(DWELL / problem.dt), np.asarray(problem.team.radius)
    for i, j in combinations(range(12), 2):
        together = slice(None, min(ends[i], ends[j]))
        gap = np.linalg.norm(paths[together, i] - paths[together, j], axis=1).min()
        assert gap > radius[i] + radius[j] + problem.margin
    clearance = problem.world.clearance(paths.reshape(-1, 2)).reshape(paths.shape[:2])
    assert (clearance > radius).all()


def test_who_keeps_its_goal_keeps_its_way_if_it_can() -> None:
    problem = make_problem("warehouse", num_robots=6, seed=0)
    paths = relay_paths(problem, standing(problem), everybody(problem), 0)
    assert paths is not None
    changed = np.arange(6) == 2
    again = relay_paths(problem, paths, changed, 1)
    assert again is not None
    np.testing.assert_array_equal(again[:, ~changed], paths[:, ~changed])
    assert arrivals(problem, again)[2] < problem.horizon


def corridor_past_a_goal() -> Problem:
    """A corridor for one, in which robot 0 heads for the middle, and robot 1 behind it for the end."""
    boxes = [[-4, 0.3, 4, 1.0], [-4, -1.0, 4, -0.3]]
    world = World(dimension=2, boxes=boxes, lower=(-3, -1), upper=(3, 1))
    states = np.zeros((2, 4))
    states[:, 0] = [-1.5, -2.3]
    return Problem(Team(("holonomic2d",) * 2, radius=0.15), states, [[0, 0], [2.3, 0]], world, horizon=200)


def test_a_goal_can_be_passed_once_who_arrived_has_gone_on() -> None:
    problem = corridor_past_a_goal()
    paths = relay_paths(problem, standing(problem), everybody(problem), 0)
    assert paths is not None
    first, second = arrivals(problem, paths)
    assert first < second < problem.horizon
    # Nobody gets past a robot that stays for good.
    compile_path_finding(problem)
    staying = Replanning(problem, lay_roadmap(problem))
    assert plan_one_by_one(staying, np.random.default_rng(0), lambda: False, 20) is None


def test_a_goal_without_a_way_has_no_ways() -> None:
    problem = make_problem("warehouse", num_robots=3, seed=0)
    walls = World(
        dimension=2, boxes=[*problem.world.boxes, *ring(problem.goal[1])],
        lower=problem.world.lower, upper=problem.world.upper,
    )  # fmt: skip
    closed = Problem(problem.team, problem.start, problem.goal, walls, horizon=problem.horizon)
    assert relay_paths(closed, standing(closed), everybody(closed), 0) is None


def ring(position: FloatArray) -> list[list[float]]:
    """Four boxes round a place."""
    x, y = map(float, position)
    return [
        [x - 0.5, y + 0.3, x + 0.5, y + 0.4], [x - 0.5, y - 0.4, x + 0.5, y - 0.3],
        [x - 0.5, y - 0.4, x - 0.4, y + 0.4], [x + 0.4, y - 0.4, x + 0.5, y + 0.4],
    ]  # fmt: skip


def test_a_team_in_a_warehouse_goes_on_without_end() -> None:
    """Nobody touches anybody, and few wait: half of the alone bound was what docking for good let them reach."""
    problem = make_problem("warehouse", num_robots=8, seed=0)
    env = navigation_v0.parallel_env(problem=problem, lifelong=True, max_cycles=150)
    policy = make_policy("d4orm-c2f", refine="off")
    executed = run_episode(env, policy, seed=0)
    assert not executed.trajectory.collided.any()
    assert executed.metrics["goals_reached"] >= 8
