"""Wrappers for PettingZoo's parallel environments."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from pettingzoo import ParallelEnv
from pettingzoo.utils.wrappers import BaseParallelWrapper

from d4orm_env.core.arrays import FloatArray, as_float32
from d4orm_env.core.seeds import Stream, generator
from d4orm_env.envs.inputs import noise_std
from d4orm_env.envs.team_step import AgentInfos

__all__ = ["GaussianControlNoise"]


class GaussianControlNoise(BaseParallelWrapper[str, FloatArray, FloatArray]):
    """Adds Gaussian noise to every action, as if the robots' actuators were inaccurate.

    The noise is independent over steps, agents and components, and comes from a generator of the wrapper's own that
    :meth:`reset` seeds. It is added before the environment clips the controls, as the noise of
    :class:`d4orm_env.navigation_v0.parallel_env`'s own ``control_noise_std`` is.

    Args:
        env: The environment; all agents need box actions of one shape.
        std: Standard deviation in the actions' units, one number or one per component.

    Raises:
        ValueError: If ``std`` has another shape, or a value is negative or not finite, or the agents' actions differ.
    """

    def __init__(self, env: ParallelEnv[str, FloatArray, FloatArray], std: ArrayLike) -> None:
        super().__init__(env)
        shapes = {env.action_space(agent).shape for agent in env.possible_agents}
        shape = shapes.pop()
        if shapes or shape is None or len(shape) != 1:
            raise ValueError("GaussianControlNoise needs agents whose actions are vectors of one size")
        self._shape: tuple[int] = (shape[0],)
        self._std = noise_std(std, shape[0])
        self._random = np.random.default_rng()

    def reset(
        self, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[dict[str, FloatArray], AgentInfos]:
        """Reset the environment, and with a seed the noise too; without one the noise goes on."""
        if seed is not None:
            self._random = generator(seed, Stream.CONTROL_NOISE)
        return super().reset(seed=seed, options=options)

    def step(
        self, actions: dict[str, FloatArray]
    ) -> tuple[dict[str, FloatArray], dict[str, float], dict[str, bool], dict[str, bool], AgentInfos]:
        """Step the environment with disturbed actions."""
        if self._std is None or not isinstance(actions, Mapping):  # what is no dictionary is refused further in
            return super().step(actions)
        # Drawn for all agents whoever is left, so that one agent's noise does not depend on the others' fate.
        noise = self._std * self._random.standard_normal((self.max_num_agents, *self._shape), dtype=np.float32)
        disturbance = dict(zip(self.possible_agents, noise))
        disturbed = {
            agent: self._disturb(actions[agent], disturbance[agent]) for agent in self.agents if agent in actions
        }
        return super().step({**actions, **disturbed})

    def _disturb(self, action: ArrayLike, noise: FloatArray) -> ArrayLike:
        # What is not a control of this shape goes on as it is, for the environment to refuse by name.
        try:
            control = as_float32(action)
        except ValueError:
            return action
        return control + noise if control.shape == self._shape else action
