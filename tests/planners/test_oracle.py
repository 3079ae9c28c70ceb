"""Both engines against the plain formulation, which shares no code with them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from engine_support import (
    ENGINE_NAMES,
    MODEL_NAMES,
    RecordedRules,
    cpu_rewards,
    engine_noise,
    random_controls,
    toward_goals,
)
from reference import evaluate, position_error

from d4orm_env import make_problem
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_planners import reference as plain
from d4orm_planners.engine.sampling_types import SamplingRules, SamplingTask, get_sampling_engine
from d4orm_planners.sampling.weights import SoftmaxWeights

TEMPERATURE = 0.3
RULES = SamplingRules(SoftmaxWeights(TEMPERATURE))


def sample_controls(task: SamplingTask, mean: Any, sigma: float, num_samples: int, seed: int, step: int) -> np.ndarray:
    """``(M, H, K, m)`` deformations of one step, from the engines' own noise."""
    normals = engine_noise(task.problem, seed, step, num_samples)
    return (mean + np.float32(sigma) * normals).astype(np.float32)


def score(problem: Problem, controls: Any) -> np.ndarray:
    """``(M, K)`` mean rewards of ``controls`` ``(M, H, K, m)`` by the plain formulation."""
    model, team = plain.plain_team(problem)
    return np.asarray(plain.score(model, team, np.asarray(controls, np.float32)))


def furnished(problem: Problem) -> Problem:
    """The same robots among obstacles of every kind, in bounds that the robots can reach."""
    d = problem.dimension
    box = [0.3, -0.9, 0.7, -0.4] if d == 2 else [0.3, -0.9, -1, 0.7, -0.4, 1]
    kinds: dict[str, Any] = (
        {"circles": [[-0.6, 0.2, 0.2]]}
        if d == 2
        else {"spheres": [[-0.6, 0.2, 0, 0.2]], "cylinders": [[0.5, 0.8, 0.15]]}
    )
    return problem.replace(world=World(dimension=d, boxes=[box], lower=[-2.8] * d, upper=[2.8] * d, **kinds))


@pytest.mark.parametrize("model", MODEL_NAMES)
@pytest.mark.parametrize("among_obstacles", [False, True])
def test_rollout_rewards_agree(model: str, among_obstacles: bool) -> None:
    problem = make_problem("circle", num_robots=4, model=model, horizon=60)
    problem = furnished(problem) if among_obstacles else problem
    candidates = [random_controls(problem, seed) for seed in range(4)] + [toward_goals(problem)]
    expected = score(problem, np.stack(candidates))
    # The cases are worth nothing unless robots lose reward to each other.
    assert (score(problem, candidates[-1][None]) < 0).any() or expected.min() < 0.2
    for name in ENGINE_NAMES:
        rewards = [get_sampling_engine(name).rollout(problem, controls).rewards.mean(axis=0) for controls in candidates]
        np.testing.assert_allclose(rewards, expected, atol=2e-4)


@pytest.mark.parametrize(("goal_speed", "step"), [(np.inf, 51), (0.35, 56)])
def test_docking_agrees(goal_speed: float, step: int) -> None:
    problem = make_problem("circle", num_robots=4, model="holonomic2d", goal_speed=goal_speed, goal_radius=0.3)
    controls = toward_goals(problem)
    # At the speed limit a step is 0.105 m, since the limit comes after the integration. So 4.595 m after 49 steps, and
    # then braking: 4.775 m and 0.8 m/s after 51 steps, 5.05 m and 0.3 m/s after 56.
    controls[49:] *= -1
    trajectory = get_sampling_engine("cpu").rollout(problem, controls)
    assert (trajectory.arrived.argmax(axis=0) == step).all()
    np.testing.assert_allclose(score(problem, controls[None])[0], trajectory.rewards.mean(axis=0), atol=2e-4)


@pytest.mark.parametrize("model", MODEL_NAMES)
def test_sampled_rewards_agree(model: str) -> None:
    problem = make_problem("circle", num_robots=5, model=model, horizon=40)
    task = SamplingTask(problem, toward_goals(problem), credit="robot")
    rewards = cpu_rewards(get_sampling_engine("cpu"), task, 0.7, 96, seed=3)
    samples = sample_controls(task, np.zeros_like(task.base), 0.7, 96, 3, 0)
    expected = score(problem, task.base[None] + samples).T
    # A comparison with a threshold may fall either way by rounding, and then one step's penalty makes the difference.
    clear = evaluate(task, task.base + samples).doubt > position_error(task, samples)
    assert clear.mean() > 0.8
    np.testing.assert_allclose(rewards[:, clear], expected[:, clear], atol=2e-4)


@pytest.mark.parametrize("name", ENGINE_NAMES)
def test_a_denoising_run_agrees(name: str) -> None:
    """Each step by itself, going on from the rewards that the engine found."""
    problem = make_problem("circle", num_robots=4, horizon=30)
    task = SamplingTask(problem, toward_goals(problem), credit="team")
    noise_scale, mean, recorded = np.array([1.0, 0.6, 0.3], np.float32), np.zeros_like(task.base), RecordedRules(RULES)
    result = get_sampling_engine(name).denoise(task, recorded.rules, mean, noise_scale, 128, 5)
    for step, (sigma, rewards) in enumerate(zip(noise_scale, recorded.rewards, strict=True)):
        samples = sample_controls(task, mean, sigma, 128, 5, step)
        clear = evaluate(task, task.base + samples).doubt > position_error(task, samples, control_error=1e-5)
        assert clear.mean() > 0.8
        expected = score(problem, task.base + samples).mean(axis=1)
        np.testing.assert_allclose(rewards[0, clear], expected[clear], atol=2e-4)
        mean = np.asarray(plain.softmax_mean(rewards[0], samples, TEMPERATURE))
    assert np.abs(mean).max() > 0.1
    np.testing.assert_allclose(result.mean, mean, atol=5e-5)


def test_the_plain_run_improves_what_it_optimises() -> None:
    problem = make_problem("circle", num_robots=2, horizon=30)
    noise_scale = np.linspace(1, 0.2, 10).astype(np.float32)
    controls = plain.denoise_around_rest(problem, noise_scale, 128, TEMPERATURE, seed=0)
    before, after = (score(problem, each[None]).mean() for each in (np.zeros_like(controls), controls))
    assert after > before + 0.03


def test_collisions_can_be_left_out() -> None:
    problem = make_problem("circle", num_robots=4)
    model, team = plain.plain_team(problem)
    controls = toward_goals(problem)[None]
    apart = np.asarray(plain.score(model, team, controls, collisions=False))
    assert (apart > score(problem, controls) + 0.01).all()


def test_mixed_teams_are_refused() -> None:
    with pytest.raises(ValueError, match="one model at a time"):
        plain.plain_team(make_problem("heterogeneous", num_robots=2))
