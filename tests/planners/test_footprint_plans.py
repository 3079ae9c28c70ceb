"""Plans of teams that are not round, and with goal headings: sampled, scored and judged by their footprints."""

from __future__ import annotations

import numpy as np
import pytest
from env_support import slow

from d4orm_env import Problem, Team, World, make_problem, navigation_v0, rollout, verify
from d4orm_env.footprints import Box, Capsule, Ellipsoid
from d4orm_planners import make_planner, make_policy, run_episode
from d4orm_planners.d4orm_c2f.coarse_plan import CoarsePlan
from d4orm_planners.engine.sampling_types import SamplingRules, SamplingTask, get_sampling_engine, moving_robots
from d4orm_planners.sampling.weights import SoftmaxWeights


def boxes(num_robots: int = 4, **changes: object) -> Problem:
    problem = make_problem("circle", num_robots=num_robots, model="differential_drive", num_obstacles=1, seed=2)
    return problem.replace(team=problem.team.replace(footprint=Box(0.36, 0.24)), **changes)


def straight(problem: Problem) -> np.ndarray:
    """Controls that run everybody into each other in the middle."""
    controls = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    controls[:15, :, 1] = 1
    return controls


@pytest.mark.parametrize("engine", ["cpu", "jax"])
@pytest.mark.parametrize("footprint", [slow(Box(0.8, 0.1), id="box"), Capsule(0.6, 0.05)])
def test_samples_are_scored_as_they_are_rolled_out(engine: str, footprint: object) -> None:
    """Without noise every sample is the motion itself, among two robots that are not sampled."""
    problem = boxes(horizon=60, goal_heading=0.0)
    problem = problem.replace(team=problem.team.replace(footprint=footprint))
    controls = straight(problem)
    path = rollout(problem, controls)
    assert path.margin_violated.any()
    part, others = problem.select([0, 1]), [2, 3]
    moving = moving_robots(problem.team.select(others), path.states[1:, others])
    task = SamplingTask(part, controls[:, :2], moving=moving, credit="robot")
    rules = SamplingRules(SoftmaxWeights(0.1))
    result = get_sampling_engine(engine).denoise(
        task, rules, np.zeros_like(task.base), np.full(1, 1e-9, np.float32), 64, 0
    )
    np.testing.assert_allclose(result.rewards[0], path.rewards[:, :2].mean(), rtol=1e-5)


@pytest.mark.parametrize("name", ["d4orm", "d4orm-d", "mapf", slow("hybrid")])
def test_planners_solve_teams_of_boxes_with_goal_headings(name: str) -> None:
    problem = boxes(horizon=200, goal_heading=[0.0, 1.0, np.nan, -2.0])
    plan = make_planner(name).solve(problem, seed=0, time_limit=60)
    assert plan.solved
    assert verify(problem, plan.controls).ok
    missed = plan.trajectory.states[-1, :, 2] - problem.goal_heading
    missed = np.abs((missed[[0, 1, 3]] + np.pi) % (2 * np.pi) - np.pi)
    assert (missed <= 0.1 + 1e-4).all()


def test_boxes_pass_where_discs_round_them_do_not() -> None:
    """Two long robots side by side in a lane, closer than the discs round them."""
    team = boxes(2).team.replace(footprint=Box(0.8, 0.1))
    start, goal = [[0, 0, 0, 0], [0, 0.2, 0, 0]], [[3, 0], [3, 0.2]]
    lane = Problem(team, start, goal, goal_heading=0.0, goal_heading_tolerance=0.05)
    plan = make_planner("d4orm").solve(lane, seed=0, time_limit=60)
    assert plan.solved


@pytest.mark.slow
def test_ellipsoids_fly_over_each_other_with_room() -> None:
    problem = make_problem("sphere", num_robots=4)
    problem = problem.replace(team=problem.team.replace(footprint=Ellipsoid(0.12, 0.12, 0.3)))
    plan = make_planner("d4orm").solve(problem, seed=0, time_limit=60)
    assert plan.solved
    assert plan.verified


@pytest.mark.slow
def test_c2f_executes_them() -> None:
    problem = boxes(horizon=150, goal_heading=0.0)
    episode = run_episode(navigation_v0.parallel_env(problem=problem), make_policy("d4orm-c2f", refine="sync"), seed=0)
    assert episode.metrics["success"] == 1.0


def test_c2f_guides_them_as_discs_which_move_all_at_once() -> None:
    problem = make_problem("circle", num_robots=8, footprint=Box(0.36, 0.24))
    policy = make_policy("d4orm-c2f", refine="sync")
    episode = run_episode(navigation_v0.parallel_env(problem=problem), policy, seed=0)
    assert episode.metrics["success"] == 1.0
    assert episode.metrics["makespan"] < 0.75 * problem.horizon * problem.dt
    assert isinstance(policy.guidance, CoarsePlan)
    assert not policy.guidance.problem.team.shapes


def test_c2f_guides_them_as_they_are_where_discs_do_not_pass() -> None:
    walls = [[-0.1, 0.25, 0.1, 2.0], [-0.1, -2.0, 0.1, -0.25]]
    world = World(boxes=walls, lower=[-2, -2], upper=[2, 2])
    team = Team(("differential_drive",), footprint=Box(0.5, 0.2))
    problem = Problem(team, [[-1.0, 0, 0, 0]], [[1.0, 0]], world)
    assert 2 * float(team.radius[0]) > 0.5
    policy = make_policy("d4orm-c2f", refine="sync", engine="cpu")
    env = navigation_v0.parallel_env(problem=problem)
    env.reset(seed=0)
    policy.reset(env, seed=0)
    assert isinstance(policy.guidance, CoarsePlan)
    assert policy.guidance.problem.team.shapes == team.shapes
    assert np.linalg.norm(policy.guidance.path[-1] - problem.goal) < 0.1
