"""JAX_ENABLE_X64 changes nothing: every array of the JAX code says its type, and results are the same to the bit."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine_support import random_controls
from env_support import mixed_problem

from d4orm_env import make_problem
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.disturbances import ControlNoise
from d4orm_env.jax import functional
from d4orm_env.jax.functional_env import FunctionalEnv
from d4orm_planners import make_planner
from d4orm_planners import reference as plain
from d4orm_planners.engine.jax_sampling import JaxSamplingEngine
from d4orm_planners.engine.sampling_types import MovingObstacles, SamplingRules, SamplingTask
from d4orm_planners.sampling.settings import annealed
from d4orm_planners.sampling.weights import EliteWeights, GroupWeights, SoftmaxWeights

WALLS = World(
    2,
    circles=[[0, 1, 0.25]],
    boxes=[[-3, 2, 3, 3]],
    polygons=[[[2, 1], [3, 1], [2.5, 1.6]]],
    lower=[-4, -4],
    upper=[4, 4],
)
MANY = World(2, circles=[[x, y, 0.1] for x in range(-3, 4) for y in (2, -2)])
SPACE = World(3, spheres=[[0, 0, 2, 0.3]], cylinders=[[2, 2, 0.3]])


def every_model(world: World | None = WALLS) -> Problem:
    team = Team(("velocity2d", "unicycle", "car", "holonomic2d", "differential_drive"))
    start = np.zeros((5, team.state_size), np.float32)
    start[:, :2] = [[-2, -0.5], [-1, 0.2], [0, -0.3], [1, 0.1], [2, -0.2]]
    return Problem(team, start, start[::-1, :2] + np.array([0.3, 0.1]), world, horizon=12, goal_speed=0.8, margin=0.07)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "models": every_model,
    "index": lambda: mixed_problem().replace(horizon=12, world=MANY),
    "space": lambda: make_problem("sphere", num_robots=2, horizon=12).replace(world=SPACE),
}
RULES = {
    "softmax": SamplingRules(SoftmaxWeights(0.3)),
    "elite": SamplingRules(EliteWeights(0.1), adapt=lambda deviation2, xp: xp.sqrt(deviation2) + 0.1),
    "importance": SamplingRules(GroupWeights(SoftmaxWeights(0.3), ((0, 1), (2, 3, 4))), importance=0.1),
}


def denoise(rules: SamplingRules) -> Any:
    problem = every_model()
    body = MovingObstacles(np.zeros((problem.horizon, 1, 2), np.float32), np.array([0.3], np.float32))
    task = SamplingTask(
        problem, random_controls(problem, 0), moving=body, credit="robot" if rules.importance else "team"
    )
    return JaxSamplingEngine().denoise(task, rules, np.zeros_like(task.base), annealed(2, 1e-4, 2e-2), 50, 3)


def rollout(problem: Problem) -> Any:
    return vars(JaxSamplingEngine().rollout(problem, random_controls(problem, 1)))


def functions(problem: Problem) -> Any:
    """States, observations and rewards, of controls as users have them, in float64."""
    layout = FunctionalEnv(problem=problem).layout
    controls = np.float64(random_controls(problem, 2))

    def episode(problem: Problem, controls: Any) -> Any:
        def advance(state: functional.State, control: Any) -> Any:
            state, step = functional.step(problem, state, control, "training")
            return state, (state, step, functional.observe(problem, state, layout, 40))

        return jax.lax.scan(advance, functional.reset(problem, jax.random.key(0)), controls)

    return jax.jit(episode)(problem, controls)


def gradient() -> Any:
    """Of the rewards of an episode, by its controls."""
    problem = PROBLEMS["space"]()

    def total(controls: Any) -> Any:
        def advance(state: functional.State, control: Any) -> Any:
            state, step = functional.step(problem, state, control)
            return state, step.rewards.sum()

        return jax.lax.scan(advance, functional.reset(problem, jax.random.key(0)), controls)[1].sum()

    return jax.jit(jax.grad(total))(jnp.asarray(random_controls(problem, 2), jnp.float32))


def worlds() -> Any:
    """Instances drawn, noise, auto-reset."""
    env = FunctionalEnv(
        "random", num_robots=2, num_instances=3, reward="training", max_cycles=3, disturbances=[ControlNoise(0.2)]
    )
    state, seen = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), 4))
    steps = []
    step_all = jax.jit(jax.vmap(env.step))
    for count in range(5):
        controls = np.full((4, *env.action_limits.shape), 0.1 * count)
        state, step = step_all(jax.random.split(jax.random.key(count), 4), state, controls)
        steps.append((state, step))
    return seen, steps


def scores(model: str) -> Any:
    problem = make_problem("four_obstacles", num_robots=3, model=model, horizon=8)
    return plain.denoise_around_rest(problem, [0.5, 0.2], 16, 0.3, 0)


CASES: dict[str, Callable[[], Any]] = {
    **{f"denoise {name}": lambda rules=rules: denoise(rules) for name, rules in RULES.items()},
    **{f"rollout {name}": lambda make=make: rollout(make()) for name, make in PROBLEMS.items()},
    **{f"functions {name}": lambda make=make: functions(make()) for name, make in PROBLEMS.items()},
    "plain": lambda: scores("differential_drive"),
    "gradient": gradient,
    "worlds": worlds,
}


@contextmanager
def double_precision(enabled: bool) -> Iterator[None]:
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", enabled)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.slow
def test_the_flag_changes_no_bit(name: str) -> None:
    with double_precision(False):
        expected = jax.tree.leaves(CASES[name]())
    with double_precision(True):
        leaves = jax.tree.leaves(CASES[name]())
    assert len(leaves) == len(expected) > 0
    for leaf, other in zip(leaves, expected, strict=True):
        assert np.asarray(leaf).dtype == np.asarray(other).dtype != np.float64
        np.testing.assert_array_equal(leaf, other)


def test_planners_plan_the_same() -> None:
    problem, plans = make_problem("circle", num_robots=2, horizon=20), []
    for enabled in (False, True):
        with double_precision(enabled):
            plans.append(make_planner("d4orm", num_samples=32, engine="jax").solve(problem, seed=0, max_iterations=2))
    np.testing.assert_array_equal(plans[0].controls, plans[1].controls)


@pytest.mark.slow
def test_a_process_that_starts_with_the_flag_plans() -> None:
    program = (
        "from d4orm_planners import make_planner; from d4orm_env import make_problem\n"
        "import jax; assert jax.config.jax_enable_x64\n"
        "problem = make_problem('circle', num_robots=2, horizon=20)\n"
        "plan = make_planner('mbd', num_samples=32, engine='jax').solve(problem, seed=0, max_iterations=1)\n"
        "print(plan.controls.dtype)"
    )
    environment = {**os.environ, "JAX_ENABLE_X64": "1", "PYTHONPATH": str(Path(functional.__file__).parents[2])}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "float32\n"), done.stderr
