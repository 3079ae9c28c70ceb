"""Observations, rewards and whole environments as pure functions: the same as in the environments."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_support import trains

from d4orm_env import make_problem, navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.disturbances import ControlNoise, Delay
from d4orm_env.envs.rewards import RewardInput
from d4orm_env.jax import functional
from d4orm_env.jax.functional_env import EnvState, FunctionalEnv

KEY = jax.random.key(0)


def apart(problem: Problem) -> Problem:
    """The problem with starts moved a little, so that no two things are equally far by more than rounding."""
    start = problem.start.copy()
    start[:, : problem.dimension] += np.random.default_rng(1).uniform(-0.02, 0.02, problem.goal.shape)
    return problem.replace(start=start)


TRIANGLES = World(
    2, polygons=[[[-0.5, 1], [0.5, 1], [0, 1.6]], [[1, -1], [2, -1], [2, -0.5]]], lower=[-4, -4], upper=[4, 4]
)
MIXTURES = (("velocity2d", "differential_drive"), ("holonomic2d", "car"), ("unicycle", "unicycle"))
"""Every model in the plane, in teams that other tests compile kernels for as well."""


def mixture(models: tuple[str, ...]) -> Problem:
    team = Team(models * 2)
    start = np.zeros((4, team.state_size), np.float32)
    start[:, :2] = np.random.default_rng(2).uniform(-2, 2, (4, 2))
    return Problem(team, start, start[::-1, :2] + np.array([0.3, 0.1]), arrival="stay")


CASES: dict[str, tuple[str, Callable[[], Problem]]] = {
    **{" ".join(models): ("paper", partial(mixture, models)) for models in MIXTURES},
    "goal headings": (
        "training",
        lambda: mixture(MIXTURES[0]).replace(goal_heading=[np.nan, 2.0, np.nan, np.nan]),
    ),
    "trains": ("training", trains),
    "space": ("paper", lambda: apart(make_problem("sphere", num_robots=2))),
    "boxes": ("training", lambda: apart(make_problem("four_obstacles", num_robots=3))),
    "triangles": ("training", lambda: apart(make_problem("circle", num_robots=2)).replace(world=TRIANGLES)),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if "car" in name or "unicycle" in name or name == "trains" else [])
        for name in CASES
    ],
)
def test_it_observes_and_rewards_as_the_environments_do(name: str) -> None:
    reward, make = CASES[name]
    problem = make()
    env = navigation_v0.parallel_env(problem=problem, reward=reward, max_cycles=40)
    env.reset(seed=0)
    layout = env.unwrapped._simulation.setup.layout
    step = jax.jit(partial(functional.step, reward=reward))
    observe = jax.jit(lambda problem, state: functional.observe(problem, state, layout, max_cycles=40))
    state, random = functional.reset(problem, KEY), np.random.default_rng(0)
    limits = problem.team.control_limits
    for count in range(25):
        observed = np.asarray(observe(problem, state))
        np.testing.assert_allclose(observed, env.last_step.observations, atol=2e-4, err_msg=f"step {count}")
        assert (observed >= layout.low).all()
        assert (observed <= layout.high).all()
        controls = random.uniform(-limits, limits).astype(np.float32)
        env.step({agent: controls[int(agent.removeprefix("robot_"))] for agent in env.agents})
        state, happened = step(problem, state, controls)
        np.testing.assert_allclose(happened.rewards, env.last_step.rewards, atol=1e-4)
        np.testing.assert_allclose(happened.distances, env.last_step.distances, atol=1e-5)


@pytest.mark.parametrize(("robots", "obstacles"), [(0, 0), (4, 6)])
def test_as_much_is_seen_as_the_layout_says(robots: int, obstacles: int) -> None:
    problem = apart(make_problem("four_obstacles", num_robots=4))
    env = navigation_v0.parallel_env(problem=problem, observed_robots=robots, observed_obstacles=obstacles)
    observations, _ = env.reset(seed=0)
    layout = env.unwrapped._simulation.setup.layout
    seen = functional.observe(problem, functional.reset(problem, KEY), layout)
    np.testing.assert_allclose(seen, np.stack(list(observations.values())), atol=1e-5)


def test_a_reward_of_ones_own_is_traced() -> None:
    problem = make_problem("circle", num_robots=2)

    def speed(step: RewardInput) -> Any:
        return -((step.positions - step.previous_positions) ** 2).sum(-1)

    controls = jnp.ones((2, 2))
    state, first = jax.jit(partial(functional.step, reward=speed))(problem, functional.reset(problem, KEY), controls)
    np.testing.assert_allclose(first.rewards, -((state.states[:, :2] - problem.start[:, :2]) ** 2).sum(axis=1))
    with pytest.raises(ValueError, match="reward 'mine' is unknown"):
        functional.step(problem, state, controls, reward="mine")


@pytest.mark.parametrize("shape", [(3, 1), (1, 2), (2,), (2, 3)])
def test_actions_of_another_shape_are_not_broadcast(shape: tuple[int, ...]) -> None:
    env = FunctionalEnv("circle", num_robots=3)
    state, _ = env.reset(KEY)
    with pytest.raises(ValueError, match=r"actions have shape .*; expected \(K, m\) = \(3, 2\)"):
        jax.jit(env.step)(KEY, state, jnp.ones(shape))


def test_the_way_is_not_to_be_seen() -> None:
    env = navigation_v0.parallel_env("circle", 2, observed_path=True)
    with pytest.raises(ValueError, match="leave observed_path out"):
        functional.observe(env.problem, functional.reset(env.problem, KEY), env.unwrapped._simulation.setup.layout)


def test_worlds_are_those_of_the_batched_environment() -> None:
    options: dict[str, Any] = {"scenario": "circle", "num_robots": 3, "reward": "training", "max_cycles": 12}
    env = FunctionalEnv(problem=apart(make_problem("circle", num_robots=3)), reward="training", max_cycles=12)
    del options["scenario"], options["num_robots"]
    batch = gymnasium.make_vec(
        "d4orm/Navigation-v0", 4, vectorization_mode="vector_entry_point", autoreset_mode="SameStep",
        problem=env.problem, **options,
    )  # fmt: skip
    observed, _ = batch.reset(seed=0)
    keys = jax.random.split(KEY, 4)
    state, observations = jax.jit(jax.vmap(env.reset))(keys)
    step, random = jax.jit(jax.vmap(env.step)), np.random.default_rng(0)
    ends = 0
    for _ in range(30):
        np.testing.assert_allclose(np.asarray(observations).reshape(4, -1), observed, atol=1e-4)
        actions = random.uniform(-1, 1, (4, 3, 2)).astype(np.float32)
        observed, _, terminated, truncated, _ = batch.step(actions.reshape(4, -1))
        state, transition = step(keys, state, actions)
        observations = transition.observations
        np.testing.assert_allclose(transition.rewards, batch.unwrapped.robot_rewards, atol=1e-4)
        np.testing.assert_array_equal(transition.done, terminated | truncated)
        np.testing.assert_array_equal(transition.step.truncated, truncated)
        ends += int(transition.done.sum())
    assert ends == 8
    batch.close()


def test_every_reset_takes_one_of_the_instances() -> None:
    env = FunctionalEnv("random", 3, num_instances=5, seed=2)
    states, _ = jax.jit(jax.vmap(env.reset))(jax.random.split(KEY, 60))
    assert set(np.asarray(states.instance).tolist()) == set(range(5))
    starts = [np.asarray(env.instance(number).start) for number in range(5)]
    for world in range(10):
        np.testing.assert_array_equal(states.team.states[world], starts[int(states.instance[world])])
    assert len({start.tobytes() for start in starts}) == 5
    again = FunctionalEnv("random", 3, num_instances=5, seed=2)
    np.testing.assert_array_equal(again.instance(3).goal, env.instance(3).goal)
    assert (np.asarray(FunctionalEnv("random", 3, num_instances=1, seed=3).instance(0).start) != starts[0]).any()


def test_who_has_arrived_is_done_and_a_contact_spoils_it() -> None:
    problem = make_problem("circle", num_robots=2, model="velocity2d")
    ahead = (problem.goal - problem.start[:, :2]) / np.linalg.norm(problem.goal - problem.start[:, :2], axis=1)[:, None]
    env = FunctionalEnv(problem=problem)

    def run(controls: Any) -> Any:
        def move(state: EnvState, key: Any) -> Any:
            state, transition = env.advance(key, state, controls)
            return state, transition

        return jax.lax.scan(move, env.reset(KEY)[0], jax.random.split(KEY, problem.horizon))[1]

    crash = jax.jit(run)(jnp.asarray(ahead))
    last = int(np.argmax(crash.done))
    assert crash.finished[last].all()
    assert not bool(crash.success[last])
    assert bool(crash.acted[last].any())
    assert not crash.acted[last + 1].any()
    alone = jax.jit(run)(jnp.asarray(ahead * np.array([[1], [0]])))
    assert np.asarray(alone.finished)[-1].tolist() == [False, False] or not alone.done[:-1].any()


def test_noise_is_drawn_from_the_key() -> None:
    quiet, noisy = FunctionalEnv("circle", 2), FunctionalEnv("circle", 2, disturbances=[ControlNoise(0.3)])
    state, _ = quiet.reset(KEY)
    keys = jax.random.split(KEY, 50)

    def executed(env: FunctionalEnv) -> Any:
        return jax.jit(jax.vmap(lambda key: env.step(key, state, jnp.zeros((2, 2)))[0].team.controls))(keys)

    assert 0.2 < float(jnp.std(executed(noisy))) < 0.4
    assert not np.asarray(executed(quiet)).any()


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"disturbances": [Delay(2)]}, "disturbances other than ControlNoise and RayNoise are no pure functions"),
        ({"lifelong": True}, "lifelong is not possible in pure functions of JAX; use parallel_env"),
        ({"render_mode": "human"}, "render_mode is not possible in pure functions of JAX; use parallel_env"),
        ({"observed_path": True}, "observed_path is not possible"),
        ({"progress": "path"}, "progress='path' is not possible"),
        ({"num_instances": 0}, "num_instances is 0"),
        ({"colour": 1}, "colour"),
        ({"scenario": "maze", "num_instances": 4}, "differ in more than numbers"),
    ],
)
def test_what_is_not_possible_is_said(options: dict[str, Any], complaint: str) -> None:
    with pytest.raises((ValueError, TypeError), match=complaint):
        FunctionalEnv(**{"scenario": "circle", "num_robots": 2, **options})
