"""When robots that never stop working have reached a goal."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from env_support import line_problem

from d4orm_env import mujoco, navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import MODELS
from d4orm_env.envs.joint_env import JointNavigationEnv
from d4orm_env.envs.joint_state import split_state
from d4orm_env.envs.lifelong import fresh_goal, reached_goals
from d4orm_planners import run_episode


@pytest.mark.parametrize("model", MODELS)
def test_a_goal_is_reached_there_and_no_faster_than_the_goal_speed(model: str) -> None:
    problem = line_problem([1.0, 1.0, 1.0], model, goal_radius=0.1, goal_speed=0.2)
    states = np.zeros_like(problem.start)
    states[:, : problem.dimension] = problem.goal
    states[1, 0] -= 0.15  # outside the goal radius
    controls = np.zeros((3, problem.control_size), np.float32)
    kind = MODELS[model]
    # The third robot drives at half a metre a second: by its state, or where it has no inertia by its control.
    (states if kind.speed_indices else controls)[2, kind.speed_indices[0] if kind.speed_indices else 0] = 0.5
    assert reached_goals(problem.team, problem.arrays, states, controls).tolist() == [True, False, False]


def test_new_goals_lie_where_the_robot_can_get_to() -> None:
    # A ring of walls with room for a robot inside, which nobody can enter or leave.
    walls = [[1, 1, 3, 1.2], [1, 2.8, 3, 3], [1, 1, 1.2, 3], [2.8, 1, 3, 3]]
    world = World(boxes=walls, lower=[-1, -1], upper=[4, 4])
    start, inside = [[0, 0], [2, 2]], [[3.5, 3.5], [1.7, 1.7]]
    problem = Problem(Team(("velocity2d",) * 2, radius=0.1), start, inside, world)
    goals, random = problem.goal.copy(), np.random.default_rng(0)
    for _ in range(20):
        for robot in range(2):
            goals[robot] = fresh_goal(problem, robot, problem.start[:, :2], goals, random)
            within = (np.abs(goals[robot] - 2) < 1).all()
            assert within == (robot == 1)


# Goals that a user's function gives.

SHUTTLE = line_problem([0.6, 0.6], "velocity2d", world=World(lower=[-1, -1], upper=[2, 4]), goal_radius=0.1)


def back_and_forth(problem: Problem, robot: int, positions: Any, goals: Any, random: Any) -> Any:
    """To the goal and back to the start, in turn."""
    assert np.linalg.norm(positions[robot] - goals[robot]) <= problem.goal_radius
    at_goal = (goals[robot] == problem.goal[robot]).all()
    positions[:] = goals[:] = np.nan  # they are the function's own
    return problem.start[robot, :2] if at_goal else problem.goal[robot]


@pytest.mark.parametrize("make_env", [navigation_v0.parallel_env, mujoco.parallel_env], ids=["model", "mujoco"])
def test_a_function_gives_the_goals(make_env: Any) -> None:
    model = "velocity2d" if make_env is navigation_v0.parallel_env else "holonomic2d"
    problem = line_problem([0.6, 0.6], model, goal_radius=0.1, goal_speed=np.inf)
    env = make_env(problem=problem, lifelong=back_and_forth, max_cycles=80)
    assert env.lifelong is True
    episode = run_episode(env, "go-to-goal")
    assert set(np.round(episode.goals[:, 0, 0], 3)) == {0.0, np.float32(0.6).round(3)}
    assert episode.metrics["goals_reached"] >= 6
    assert np.isfinite(episode.trajectory.states).all()


def test_the_joint_environment_takes_it_too() -> None:
    env = JointNavigationEnv(problem=SHUTTLE, lifelong=back_and_forth)
    env.reset(seed=0)
    for _ in range(6):
        env.step(np.float32([1, 0, 1, 0]))
    assert split_state(SHUTTLE, env.state()).goals[:, 0].tolist() == [0, 0]


def test_the_function_draws_with_the_seed_of_the_episode() -> None:
    def drawn(seed: int) -> list[float]:
        def goal(problem: Problem, robot: int, positions: Any, goals: Any, random: np.random.Generator) -> Any:
            return random.uniform([-0.5, robot - 0.2], [1.5, robot + 0.2])

        episode = run_episode(navigation_v0.parallel_env(problem=SHUTTLE, lifelong=goal), "go-to-goal", seed)
        return episode.goals.ravel().tolist()

    assert drawn(1) == drawn(1) != drawn(2)


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ([1.0], r"the next goal of robot_0 has shape \(1,\); expected \(2,\)"),
        (None, "the next goal of robot_0"),
        ([np.nan, 0], r"the next goal of robot_0\[0\] is nan; every value must be finite"),
        ([5, 0], r"the next goal of robot_0 is \[5.0, 0.0\]; it must lie between \[-1.0, -1.0\] and \[2.0, 4.0\]"),
        ([0, 2.1], "clearance from obstacles and bounds is 0.1 m; it must be at least the robot's radius of 0.15 m"),
    ],
)
def test_a_goal_where_the_robot_cannot_be_is_refused(goal: Any, message: str) -> None:
    world = World(boxes=[[-0.5, 2.2, 0.5, 2.4]], lower=[-1, -1], upper=[2, 4])
    env = navigation_v0.parallel_env(problem=SHUTTLE.replace(world=world), lifelong=lambda *_: goal)
    with pytest.raises(ValueError, match=message):
        run_episode(env, "go-to-goal")


def test_what_gives_no_goals_is_refused() -> None:
    with pytest.raises(ValueError, match="lifelong is 'often'; it must be True or False, or a function that gives"):
        navigation_v0.parallel_env("circle", lifelong="often")
