"""Whole environments as pure JAX functions: instances, observations, rewards and auto-reset, for training in one jit.

>>> env = FunctionalEnv("random", num_robots=8, reward="training")
>>> state, observations = jax.vmap(env.reset)(jax.random.split(key, 1024))
>>> state, transition = jax.vmap(env.step)(keys, state, actions)
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import PyTreeDef
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import whole_number
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.controls import ControlNoise
from d4orm_env.disturbances.perception import RayNoise
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.rewards import find_reward
from d4orm_env.envs.setup import EnvSetup
from d4orm_env.jax import functional
from d4orm_env.scenarios.problems import ScenarioLike

__all__ = ["EnvState", "FunctionalEnv", "Transition"]

MAX_INSTANCES = 1_000_000


class EnvState(NamedTuple):
    """A world in the middle of an episode."""

    team: functional.State  #: State of the team
    instance: jax.Array  #: ``()`` int32, which of the instances it runs
    touched: jax.Array  #: ``(K,)`` bool: has been in contact
    ray_noise: jax.Array  #: ``(K, R)`` errors of what the range sensors measure now [m]; ``R`` is 0 without noise


class Transition(NamedTuple):
    """Result of one step."""

    observations: jax.Array  #: ``(K, D)``; after the end of an episode those of the next one
    rewards: jax.Array  #: ``(K,)`` of all robots, arrived ones too, as ``robot_rewards`` of the batched environment
    acted: jax.Array  #: ``(K,)`` bool: was still under way when the step began
    finished: jax.Array  #: ``(K,)`` bool: is done, which is terminated
    done: jax.Array  #: ``()`` bool: the episode is over; all have finished, or the time is up
    success: jax.Array  #: ``()`` bool: all have arrived, and none was ever in contact
    step: functional.Step  #: Result of :func:`d4orm_env.jax.functional.step`


class FunctionalEnv:
    """One world; ``jax.vmap`` makes many of it. World for world it is the environment of the same arguments.

    Where the scenario draws at random, so many instances are drawn when it is made, and every reset takes one of them
    by its key: the scenario's own generator draws until positions are free, which no traced function does quickly.

    Args:
        scenario: As in :class:`~d4orm_env.envs.options.EnvOptions`, like all arguments not named here.
        num_robots: Size of the team.
        num_instances: Number of instances to choose among, for a scenario that draws at random; ``seed=``
            draws others.
        **options: Further attributes of :class:`~d4orm_env.envs.options.EnvOptions`, and arguments of the scenario. Not
            ``render_mode``, ``lifelong``, ``progress="path"``, ``observed_path``, nor disturbances but
            :class:`~d4orm_env.disturbances.ControlNoise` and :class:`~d4orm_env.disturbances.RayNoise`: they are not
            pure functions.

    Attributes:
        problem: The first instance.
        layout: Layout of one robot's observation, before it becomes features.
        features: What robots are shown instead, if they are egocentric.
        observation_bounds: ``(D,)`` lowest and highest of what one robot is shown.
        action_bounds: ``(K, m)`` lowest and highest actions.
        max_cycles: Steps until truncation.

    Raises:
        TypeError: For an argument that neither the environment nor the scenario has.
        ValueError: For a bad argument, one that is not possible here, or instances that differ in shape.
    """

    def __init__(
        self,
        scenario: ScenarioLike | None = None,
        num_robots: int | None = None,
        *,
        num_instances: int = 256,
        **options: object,
    ) -> None:
        chosen = EnvOptions.of(scenario=scenario, num_robots=num_robots, **options)
        _refuse(chosen)
        count = whole_number(num_instances, "num_instances", 1, MAX_INSTANCES)
        setup = EnvSetup(chosen)
        self.problem: Problem = setup.problem
        self.layout: ObservationLayout = setup.layout
        self.features: Any = setup.features  # which take arrays of JAX too
        self.observation_bounds, self.action_bounds = setup.observation_bounds, setup.action_bounds
        self.max_cycles: int = setup.max_cycles
        self._reward = find_reward(chosen.reward) or "paper"
        known = [one for one in setup.disturbances if isinstance(one, ControlNoise | RayNoise)]
        if len(known) < len(setup.disturbances):
            raise ValueError(
                "disturbances other than ControlNoise and RayNoise are no pure functions; use gymnasium.make_vec"
            )
        self._noise = _joint_std([one.std for one in known if isinstance(one, ControlNoise)])
        self._ray_noise = _joint_std([one.std for one in known if isinstance(one, RayNoise)])
        random = np.random.default_rng(chosen.scenario_settings.get("seed") or 0)
        drawn = [setup.draw(random) for _ in range(count)] if setup.redraws else [setup.problem]
        self._num_instances, self._varying, self._common, self._structure = len(drawn), *_stacked(drawn)

    @cached_property
    def observation_shape(self) -> tuple[int, int]:
        """``(K, D)``."""
        return self.problem.num_robots, len(self.observation_bounds[0])

    @cached_property
    def action_limits(self) -> np.ndarray:
        """``(K, m)`` largest actions: controls in physical units, zero where a robot has no such component; or ones."""
        return self.problem.team.control_limits if self.features is None else self.action_bounds[1]

    def instance(self, number: int | jax.Array) -> Problem:
        """One of the instances; the number may be traced."""
        chosen = {index: stack[number] for index, stack in self._varying.items()}
        leaves = [chosen.get(index, leaf) for index, leaf in enumerate(self._common)]
        return jax.tree.unflatten(self._structure, leaves)

    def reset(self, key: jax.Array) -> tuple[EnvState, jax.Array]:
        """Begin an episode; the key chooses the instance.

        Returns:
            The state, and observations ``(K, D)``.
        """
        state = self._begin(key)
        return state, self.observe(state)

    def observe(self, state: EnvState) -> jax.Array:
        """``(K, D)`` what every robot is shown."""
        seen = self._seen(state)
        shown: jax.Array = seen if self.features is None else self.features.encode(seen)[0]
        return shown

    def _seen(self, state: EnvState) -> jax.Array:
        """``(K, D)`` what every robot sees, in physical units."""
        seen = functional.observe(self.instance(state.instance), state.team, self.layout, self.max_cycles)
        if not self._ray_noise:
            return seen
        rays, max_range = self.layout.rays, self.layout.ray_range
        true = seen[:, rays]
        return seen.at[:, rays].set(jnp.where(true < max_range, jnp.clip(true + state.ray_noise, 0, max_range), true))

    def advance(self, key: jax.Array, state: EnvState, actions: jax.Array) -> tuple[EnvState, Transition]:
        """One step, without reset at the end of an episode.

        Args:
            key: Key of the noise.
            state: The world.
            actions: ``(K, m)`` controls in physical units, clipped to the robots' limits; or what egocentric robots do.
        """
        after, transition = self._move(key, state, actions)
        return after, transition._replace(observations=self.observe(after))

    def step(self, key: jax.Array, state: EnvState, actions: jax.Array) -> tuple[EnvState, Transition]:
        """The same; where the episode is over the state returned is the first of the next."""
        noise, fresh = jax.random.split(key)
        after, transition = self._move(noise, state, actions)
        after = jax.tree.map(lambda new, old: jnp.where(transition.done, new, old), self._begin(fresh), after)
        return after, transition._replace(observations=self.observe(after))

    def _begin(self, key: jax.Array) -> EnvState:
        number = jax.random.randint(key, (), 0, self._num_instances, jnp.int32)
        problem = self.instance(number)
        touched = jnp.zeros(problem.num_robots, bool)
        return EnvState(functional.reset(problem, key), number, touched, self._draw_ray_noise(key))

    def _draw_ray_noise(self, key: jax.Array) -> jax.Array:
        shape = self.problem.num_robots, self.layout.num_rays * bool(self._ray_noise)
        return jax.random.normal(jax.random.fold_in(key, 1), shape, jnp.float32) * self._ray_noise

    def _move(self, key: jax.Array, state: EnvState, actions: jax.Array) -> tuple[EnvState, Transition]:
        problem, team = self.instance(state.instance), state.team
        actions = functional.checked_controls(problem, actions)
        if self.features is not None:
            frames = self.features.encode(self._seen(state))[1]
            actions = self.features.decode(actions, frames, self.problem.team.control_limits)
        if np.any(self._noise):
            actions = actions + self._noise * jax.random.normal(key, actions.shape, jnp.float32)
        after, step = functional.step(problem, team, actions, self._reward)
        before, finished = (self._finished(arrived) for arrived in (team.arrived, step.arrived))
        touched = state.touched | step.collided
        everyone = step.arrived.all()
        transition = Transition(
            observations=jnp.zeros((), jnp.float32),
            rewards=step.rewards,
            acted=~before,
            finished=finished,
            done=finished.all() | (after.steps >= self.max_cycles),
            success=everyone & ~touched.any(),
            step=step._replace(truncated=(after.steps >= self.max_cycles) & ~finished.all()),
        )
        return EnvState(after, state.instance, touched, self._draw_ray_noise(key)), transition

    def _finished(self, arrived: jax.Array) -> jax.Array:
        return arrived if self.problem.docks else arrived & arrived.all()


def _joint_std(stds: Sequence[ArrayLike]) -> np.ndarray:
    """The standard deviation of the sum of independent noises."""
    return np.sqrt(np.sum([np.square(std) for std in stds], axis=0)).astype(np.float32)


def _refuse(options: EnvOptions) -> None:
    """Raise ``ValueError`` for what the environments have and this has not."""
    refused = {
        "render_mode": options.render_mode is not None,
        "lifelong": options.lifelong,
        "progress='path'": options.progress == "path",
        "observed_path": options.observed_path,
    }
    for name, given in refused.items():
        if given:
            other = "parallel_env" if name in ("render_mode", "lifelong") else "gymnasium.make_vec or parallel_env"
            raise ValueError(f"{name} is not possible in pure functions of JAX; use {other}")


def _stacked(problems: list[Problem]) -> tuple[dict[int, jax.Array], list[ArrayLike], PyTreeDef]:
    """Leaves that differ from instance to instance, stacked, by their index; those of the first; and the structure."""
    flattened: list[tuple[list[ArrayLike], PyTreeDef]] = [jax.tree.flatten(problem) for problem in problems]
    common, structure = flattened[0]
    shapes = [np.shape(leaf) for leaf in common]
    if any(other != structure or [np.shape(leaf) for leaf in leaves] != shapes for leaves, other in flattened):
        raise ValueError(
            f"instances of scenario {problems[0].name!r} differ in more than numbers, as in how many obstacles there "
            "are; use gymnasium.make_vec, or one instance with randomize_instance=False"
        )
    columns = [np.stack([np.asarray(leaves[index]) for leaves, _ in flattened]) for index in range(len(common))]
    varying = {index: jnp.asarray(column) for index, column in enumerate(columns) if (column != column[0]).any()}
    return varying, common, structure
