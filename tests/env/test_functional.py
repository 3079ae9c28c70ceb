"""The functional API: pure functions that jit, vmap and grad, and step exactly as the engines do."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine_support import ENGINE_NAMES, MODEL_NAMES, random_controls
from env_support import mixed_problem, slow, trains

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.engine.choice import get_engine
from d4orm_env.jax import functional
from d4orm_env.scenarios import make_problem

KEY = jax.random.key(0)
STEP = jax.jit(functional.step)

OBSTACLES = Problem(
    Team(("holonomic2d", "differential_drive"), radius=[0.2, 0.3], max_speed=[1.0, 2.0]),
    [[-1, 0, 0.5, 0], [1, 0, 3.0, 0]],
    [[1, 0], [-1, 0]],
    World(2, circles=[[0, 1, 0.25]], boxes=[[-3, 2, 3, 3]], lower=[-2, -4], upper=[2, 4]),
    horizon=25,
    goal_speed=0.8,
)
PROBLEMS = {
    "mixed": mixed_problem().replace(horizon=25),
    "obstacles": OBSTACLES,
    "space": make_problem("amswarm_4", horizon=25),
    "trains": trains(),
}


def test_rank_promotion_raises_in_this_suite() -> None:
    assert jax.config.jax_numpy_rank_promotion == "raise"


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize("name", PROBLEMS)
def test_it_steps_as_the_engines_do(engine: str, name: str) -> None:
    problem = PROBLEMS[name]
    controls = random_controls(problem, 3, scale=0.5)
    trajectory = get_engine(engine).rollout(problem, controls)
    state = functional.reset(problem, KEY)
    np.testing.assert_array_equal(state.states, problem.start)
    assert not np.asarray(state.arrived).any()
    for t, control in enumerate(controls):
        state, step = STEP(problem, state, control)
        np.testing.assert_allclose(state.states, trajectory.states[t + 1], atol=1e-5)
        np.testing.assert_allclose(step.rewards, trajectory.rewards[t], atol=1e-5)
        np.testing.assert_allclose(step.controls, trajectory.controls[t], atol=1e-6)
        np.testing.assert_array_equal(step.arrived, trajectory.arrived[t + 1])
        np.testing.assert_array_equal(state.arrived, trajectory.arrived[t + 1])
        np.testing.assert_array_equal(step.collided, trajectory.collided[t + 1])
        np.testing.assert_array_equal(step.margin_violated, trajectory.margin_violated[t + 1])
        assert int(state.steps) == t + 1
        assert bool(step.truncated) == (t + 1 == problem.horizon)


def test_it_runs_without_jit_too() -> None:
    problem = Problem(Team(("velocity2d",)), [[0, 0]], [[2, 0]])
    controls = np.array([[3.0, 4.0]], np.float32)
    state = functional.reset(problem, KEY)
    plain, jitted = functional.step(problem, state, controls), STEP(problem, state, controls)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(jitted), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_one_compilation_serves_problems_that_differ_in_their_numbers_only() -> None:
    traces = []

    @jax.jit
    def step(problem: Problem, state: functional.State, controls: Any) -> Any:
        traces.append(1)
        return functional.step(problem, state, controls)

    controls = np.zeros((4, 2), np.float32)
    for seed in range(3):
        problem = make_problem("random", num_robots=4, seed=seed, size=8.0, horizon=20, margin=0.01 * seed)
        step(problem, functional.reset(problem, KEY), controls)
    assert len(traces) == 1
    other = problem.replace(horizon=21)
    step(other, functional.reset(other, KEY), controls)
    assert len(traces) == 2


def test_a_batch_of_states_and_controls() -> None:
    controls = random_controls(OBSTACLES, 1)[:8]
    state = functional.reset(OBSTACLES, KEY)
    batched, steps = jax.jit(jax.vmap(functional.step, in_axes=(None, None, 0)))(OBSTACLES, state, controls)
    assert batched.states.shape == (8, 2, 4)
    for i in range(8):
        single, step = STEP(OBSTACLES, state, controls[i])
        np.testing.assert_allclose(batched.states[i], single.states, atol=1e-6)
        np.testing.assert_allclose(steps.rewards[i], step.rewards, atol=1e-6)
    # And on from there, each from its own state.
    again, _ = jax.jit(jax.vmap(functional.step, in_axes=(None, 0, 0)))(OBSTACLES, batched, controls)
    single, _ = STEP(OBSTACLES, jax.tree.map(lambda leaf: leaf[5], batched), controls[5])
    np.testing.assert_allclose(again.states[5], single.states, atol=1e-6)
    assert again.steps.tolist() == [2] * 8


def test_a_batch_of_resets_over_keys() -> None:
    batch = jax.vmap(functional.reset, in_axes=(None, 0))(OBSTACLES, jax.random.split(KEY, 5))
    # Problems start where they say: the key has no effect.
    np.testing.assert_array_equal(batch.states, np.broadcast_to(OBSTACLES.start, (5, 2, 4)))
    assert batch.steps.tolist() == [0] * 5


def test_a_batch_of_problems() -> None:
    problems = [make_problem("random", num_robots=3, seed=seed, size=6.0, horizon=20) for seed in range(4)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *problems)
    controls = np.full((3, 2), 0.5, np.float32)
    states = jax.vmap(functional.reset, in_axes=(0, None))(stacked, KEY)
    after, steps = jax.jit(jax.vmap(functional.step, in_axes=(0, 0, None)))(stacked, states, controls)
    for i, problem in enumerate(problems):
        single, step = STEP(problem, functional.reset(problem, KEY), controls)
        np.testing.assert_allclose(after.states[i], single.states, atol=1e-6)
        np.testing.assert_allclose(steps.rewards[i], step.rewards, atol=1e-6)


@jax.jit
def total_reward(problem: Problem, controls: Any) -> Any:
    def advance(state: functional.State, control: Any) -> Any:
        state, step = functional.step(problem, state, control)
        return state, step.rewards.sum()

    return jax.lax.scan(advance, functional.reset(problem, KEY), controls)[1].sum()


GRADIENT = jax.jit(jax.grad(total_reward, argnums=1))


@pytest.mark.parametrize("model", [*MODEL_NAMES[1::2], *map(slow, MODEL_NAMES[::2])])
def test_gradients_are_finite_and_point_to_the_goal(model: str) -> None:
    team = Team((model,))
    goal = np.eye(team.dimension)[:1] * 3
    problem = Problem(team, np.zeros((1, team.state_size)), goal, horizon=10)
    # From rest and no control: where norms and clips have their corners.
    gradient = np.asarray(GRADIENT(problem, np.zeros((10, 1, team.control_size), np.float32)))
    assert np.isfinite(gradient).all()
    forward = 1 if model == "differential_drive" else 0
    assert (gradient[:-1, 0, forward] > 0).all()
    # A differential drive cannot yet gain by turning, nor the others by moving across.
    across = np.delete(gradient[:, 0], forward, axis=1)
    np.testing.assert_allclose(across, 0, atol=1e-6)


@pytest.mark.parametrize("model", MODEL_NAMES)
def test_gradients_are_finite_for_a_robot_at_rest_at_its_goal(model: str) -> None:
    team = Team((model,))
    problem = Problem(team, np.zeros((1, team.state_size)), np.zeros((1, team.dimension)), horizon=10)
    for value in (0.0, 0.1):
        controls = np.full((10, 1, team.control_size), value, np.float32)
        assert np.isfinite(GRADIENT(problem, controls)).all()


def test_the_gradient_is_that_of_finite_differences() -> None:
    problem = make_problem("circle", num_robots=3, model="differential_drive", horizon=8)
    controls = 0.3 * random_controls(problem, 2)
    gradient = GRADIENT(problem, controls)
    direction = np.random.default_rng(0).standard_normal(controls.shape).astype(np.float32)
    numeric = (
        total_reward(problem, controls + 0.01 * direction) - total_reward(problem, controls - 0.01 * direction)
    ) / 0.02
    assert float((gradient * direction).sum()) == pytest.approx(float(numeric), rel=2e-3)


def test_a_problem_may_be_differentiated() -> None:
    problem = OBSTACLES
    controls = random_controls(problem, 4)

    def reward_of_goal(goal: Any) -> Any:
        # Not through replace(), which checks numbers.
        leaves, tree = jax.tree.flatten(problem)
        moved = [goal if leaf is problem.goal else leaf for leaf in leaves]
        return total_reward(jax.tree.unflatten(tree, moved), controls)

    gradient = np.asarray(jax.jit(jax.grad(reward_of_goal))(jnp.asarray(problem.goal)))
    assert gradient.shape == (2, 2)
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0


def test_a_problem_is_a_pytree_and_back() -> None:
    leaves, tree = jax.tree.flatten(OBSTACLES)
    assert all(not isinstance(leaf, str) for leaf in leaves)
    again = jax.tree.unflatten(tree, leaves)
    assert again == OBSTACLES
    for field in dataclasses.fields(Problem):
        assert hasattr(again, field.name)
    assert again.name == OBSTACLES.name
