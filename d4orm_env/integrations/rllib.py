"""The environment for RLlib (https://docs.ray.io/en/latest/rllib), new API stack: every robot is an agent.

>>> from d4orm_env.integrations.rllib import RLlibNavigation
>>> PPOConfig().environment(RLlibNavigation, env_config={"scenario": "random", "num_robots": 4, "reward": "training"})
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import FloatArray
from d4orm_env.envs.team_step import AgentInfos

try:
    from ray.rllib.env.multi_agent_env import MultiAgentEnv
except ModuleNotFoundError as error:
    missing = (error.name or "ray").partition(".")[0]
    raise ImportError(
        f"this integration needs {missing}; give RLlib an environment of its own, with: "
        "pip install d4orm-env 'ray[rllib]' torch"
    ) from None

__all__ = ["RLlibNavigation"]


class RLlibNavigation(MultiAgentEnv):
    """A :class:`~d4orm_env.navigation_v0.parallel_env` whose episodes end for all when none acts any more.

    A robot that arrives is terminated and acts no more. ``terminateds["__all__"]`` says that all have arrived,
    ``truncateds["__all__"]`` that time is up for some robot. RLlib's own ``ParallelPettingZooEnv`` says neither where
    one robot arrives in the very step in which time is up for another.

    ``infos`` have ``is_success`` besides: whether all have arrived without a collision.

    Args:
        config: Arguments of :class:`~d4orm_env.navigation_v0.parallel_env`, as RLlib gives its ``env_config``.

    Attributes:
        env: The environment behind it.

    Raises:
        TypeError: For an argument that does not exist.
        ValueError: For a bad argument.
    """

    def __init__(self, config: Mapping[str, Any] | None = None) -> None:
        super().__init__()
        self.env = navigation_v0.parallel_env(**(config or {}))
        self.metadata, self.render_mode = self.env.metadata, self.env.render_mode
        self.possible_agents = list(self.env.possible_agents)
        self.agents = list(self.possible_agents)
        self.observation_spaces = dict(self.env.observation_spaces)
        self.action_spaces = dict(self.env.action_spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[dict[str, FloatArray], AgentInfos]:
        """Begin an episode; see :meth:`d4orm_env.navigation_v0.parallel_env.reset`."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return observations, self._after_step(infos)

    def step(
        self, action_dict: dict[str, FloatArray]
    ) -> tuple[dict[str, FloatArray], dict[str, float], dict[str, bool], dict[str, bool], AgentInfos]:
        """Advance one time step; see :meth:`d4orm_env.navigation_v0.parallel_env.step`."""
        observations, rewards, terminateds, truncateds, infos = self.env.step(action_dict)
        over, late = not self.env.agents, any(truncateds.values())
        return (
            observations,
            rewards,
            terminateds | {"__all__": over and not late},
            truncateds | {"__all__": over and late},
            self._after_step(infos),
        )

    def _after_step(self, infos: AgentInfos) -> AgentInfos:
        self.agents = list(self.env.agents)
        success = bool(self.env.metrics().get("success", 0.0))
        return {agent: info | {"is_success": success} for agent, info in infos.items()}

    def render(self) -> object:
        """The present picture; see :meth:`d4orm_env.navigation_v0.parallel_env.render`."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()
