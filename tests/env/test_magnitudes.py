"""Whatever a problem's construction accepts, its physics stays finite under any action that is accepted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import LARGEST, MAX_ACTION, SMALLEST
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import MAX_TIME_STEP, MIN_TIME_STEP
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.envs.joint_env import JointNavigationEnv
from d4orm_env.envs.joint_state import split_state
from d4orm_env.envs.vector_env import NavigationVectorEnv


def magnitudes(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers spread over all powers of ten, the ends among them."""
    exponents = st.floats(float(np.log10(low)), float(np.log10(high)))
    return st.one_of(st.sampled_from([low, high, 1.0]), exponents.map(lambda power: min(max(10**power, low), high)))


limits = magnitudes(SMALLEST, LARGEST)


@st.composite
def extreme_problems(draw: st.DrawFn) -> Problem:
    """Problems of any magnitude that construction accepts."""
    dimension = draw(st.sampled_from([2, 3]))
    names = ["holonomic3d"] if dimension == 3 else ["holonomic2d", "velocity2d", "differential_drive"]
    models = tuple(draw(st.lists(st.sampled_from(names), min_size=1, max_size=3)))
    count = len(models)

    def each(numbers: st.SearchStrategy[float]) -> list[float]:
        return draw(st.lists(numbers, min_size=count, max_size=count))

    dt = draw(magnitudes(MIN_TIME_STEP, MAX_TIME_STEP))
    speed, radius = np.array(each(limits)), np.array(each(magnitudes(SMALLEST, 1e3)))
    # As fast a turn as construction allows at that speed, or less.
    turn = np.clip((28 / (speed * dt)) ** 0.25 / dt, SMALLEST, LARGEST) * draw(st.floats(0.01, 0.99))
    team = Team(models, radius, speed, each(limits), np.maximum(turn, SMALLEST))
    pitch = 2.5 * radius.max()
    start, goal = np.zeros((count, team.state_size)), np.zeros((count, dimension))
    start[:, 0] = goal[:, 0] = np.arange(count) * pitch
    goal[:, 1] += draw(magnitudes(SMALLEST, LARGEST))
    for robot, model in enumerate(team.robot_models):
        start[robot, list(model.speed_indices)] = draw(st.floats(-0.5, 0.5)) * speed[robot]
        if model.heading_index is not None:
            start[robot, model.heading_index] = draw(st.floats(-1000, 1000))
    far = {"circles" if dimension == 2 else "spheres": [[-LARGEST] * dimension + [draw(limits)]]}
    world = World(dimension, **far) if draw(st.booleans()) else None
    try:
        return Problem(team, start, goal, world, dt=dt, horizon=8, goal_radius=draw(limits), margin=draw(limits))
    except ValueError:
        assume(False)
        raise


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow])
@given(extreme_problems(), st.integers(0, 2**32 - 1))
def test_states_rewards_and_observations_stay_finite(problem: Problem, seed: int) -> None:
    random = np.random.default_rng(seed)
    shape = (problem.num_robots, problem.control_size)
    envs = (navigation_v0.parallel_env(problem=problem), JointNavigationEnv(problem=problem))
    batch = NavigationVectorEnv(1, problem=problem)
    for env in (*envs, batch):
        env.reset(seed=0)
    for _ in range(4):
        controls = random.choice([-1, 1], shape) * random.choice([0, 1e-30, 1.0, 1e6, MAX_ACTION], shape)
        agents = envs[0].agents
        _, rewards, *_ = envs[0].step({agent: controls[int(agent[6:])] for agent in agents})
        assert np.isfinite(list(rewards.values())).all()
        if not agents or not envs[0].agents:
            break
        observation, reward, *_ = envs[1].step(controls.ravel())
        observations, batch_reward, *_ = batch.step(controls.reshape(1, -1))
        for values in (observation, reward, observations, batch_reward, envs[0].state(), envs[1].state()):
            assert np.isfinite(values).all()
        assert np.isfinite(split_state(problem, envs[0].state()).states).all()


@pytest.mark.parametrize("model", ["holonomic2d", "velocity2d", "differential_drive", "holonomic3d"])
def test_the_fastest_robots_stay_finite_over_the_longest_episodes(model: str) -> None:
    # As far from the origin as the largest speed and time step lead in a million steps.
    team = Team((model, model), max_speed=LARGEST, max_acceleration=LARGEST, max_turn_rate=SMALLEST)
    start = np.zeros((2, team.state_size))
    start[1, 0] = 1.0
    goal = start[:, : team.dimension] + 1
    problem = Problem(team, start, goal, dt=MAX_TIME_STEP, horizon=2)
    start[:, 0] = LARGEST * MAX_TIME_STEP * 1e6, -LARGEST * MAX_TIME_STEP * 1e6
    env = JointNavigationEnv(problem=problem.with_state(start, goal))
    env.reset(seed=0)
    observation, reward, *_ = env.step(np.full(env.action_space.shape, MAX_ACTION))
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)
    assert np.isfinite(env.state()).all()
