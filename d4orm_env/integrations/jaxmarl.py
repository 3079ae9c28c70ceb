"""The environment for JaxMARL (https://github.com/FLAIROx/JaxMARL), whose algorithms compile it into their training.

>>> from d4orm_env.integrations.jaxmarl import JaxMARLNavigation
>>> env = JaxMARLNavigation("random", num_robots=8, reward="training")
>>> observations, state = env.reset(key)
>>> observations, state, rewards, dones, infos = env.step(key, state, actions)
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from d4orm_env.jax.functional_env import EnvState, FunctionalEnv
from d4orm_env.scenarios.problems import ScenarioLike

try:
    from jaxmarl.environments.multi_agent_env import MultiAgentEnv
    from jaxmarl.environments.spaces import Box
except ModuleNotFoundError as error:
    missing = (error.name or "jaxmarl").partition(".")[0]
    # gymnax, which JaxMARL brings, imports six and does not say so.
    raise ImportError(
        f"this integration needs {missing}; give JaxMARL an environment of its own, with: pip install d4orm-env "
        "jaxmarl six"
    ) from None

__all__ = ["JaxMARLNavigation"]

ByAgent = dict[str, jax.Array]


class JaxMARLNavigation(MultiAgentEnv):
    """A :class:`~d4orm_env.jax.functional_env.FunctionalEnv` with a dictionary for every robot's part.

    A robot that has finished stays among the agents, as JaxMARL has it: its reward is zero, its action counts for
    nothing, and ``dones`` goes on saying so until the episode ends for all. ``step`` begins the next one then.

    ``infos`` hold ``acted``, ``arrived``, ``collided``, ``margin_violated`` and ``distance_to_goal`` ``(K,)``, and
    ``success`` ``()``.

    Args:
        scenario: As for :class:`~d4orm_env.jax.functional_env.FunctionalEnv`, like all others.
        num_robots: Size of the team.
        **options: Further arguments of it.

    Attributes:
        world: The environment behind it.

    Raises:
        TypeError: For an argument that does not exist.
        ValueError: For a bad argument.
    """

    def __init__(self, scenario: ScenarioLike | None = None, num_robots: int | None = None, **options: Any) -> None:
        self.world = FunctionalEnv(scenario, num_robots, **options)
        super().__init__(self.world.problem.num_robots)
        self.agents = [f"robot_{robot}" for robot in range(self.num_agents)]
        (low, high), limit = self.world.observation_bounds, self.world.action_limits.max(axis=0)
        self.observation_spaces = {agent: Box(low, high, low.shape) for agent in self.agents}
        self.action_spaces = {agent: Box(-limit, limit, limit.shape) for agent in self.agents}

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: jax.Array) -> tuple[ByAgent, EnvState]:
        """Begin an episode: observations ``(D,)`` by agent, and the state."""
        state, observations = self.world.reset(key)
        return self._by_agent(observations), state

    def step_env(
        self, key: jax.Array, state: EnvState, actions: ByAgent
    ) -> tuple[ByAgent, EnvState, ByAgent, ByAgent, dict[str, jax.Array]]:
        """One step without auto-reset, which ``step`` adds; ``actions`` are controls ``(m,)`` by agent."""
        controls = jnp.stack([actions[agent] for agent in self.agents])
        state, transition = self.world.advance(key, state, controls)
        dones = self._by_agent(transition.finished | transition.done) | {"__all__": transition.done}
        infos = {
            "acted": transition.acted,
            **{name: getattr(transition.step, name) for name in ("arrived", "collided", "margin_violated")},
            "distance_to_goal": transition.step.distances,
            "success": transition.success,
        }
        rewards = self._by_agent(transition.rewards * transition.acted)
        return self._by_agent(transition.observations), state, rewards, dones, infos

    def get_obs(self, state: EnvState) -> ByAgent:
        """Observations ``(D,)`` by agent."""
        return self._by_agent(self.world.observe(state))

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """All robots are of one class."""
        return {"robots": self.agents}

    def _by_agent(self, values: jax.Array) -> ByAgent:
        return {agent: values[robot] for robot, agent in enumerate(self.agents)}
