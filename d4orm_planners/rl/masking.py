"""Buffers that leave out what a robot does after it has arrived: it does nothing, so there is nothing to learn."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples, RolloutBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from d4orm_planners.rl.robot_vec_env import RobotVecEnv


class MaskedRolloutBuffer(RolloutBuffer):
    """A rollout buffer that hands out only the steps in which :attr:`RobotVecEnv.acted` was true.

    Set :attr:`source`, and :attr:`random`, which shuffles, before the first step.
    """

    source: RobotVecEnv
    random: np.random.Generator

    def reset(self) -> None:
        super().reset()
        self.acted = np.zeros((self.buffer_size, self.n_envs), np.bool_)

    def add(self, *args: Any, **kwargs: Any) -> None:
        self.acted[self.pos] = self.source.acted
        super().add(*args, **kwargs)

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        assert self.full
        if not self.generator_ready:
            for name in ("observations", "actions", "values", "log_probs", "advantages", "returns"):
                self.__dict__[name] = self.swap_and_flatten(self.__dict__[name])
            self.generator_ready = True
        indices = self.random.permutation(np.flatnonzero(self.acted.swapaxes(0, 1)))
        size = batch_size or len(indices)
        # The rest that does not fill a batch is left out: the next epoch shuffles anew.
        for begin in range(0, max(len(indices) - size + 1, 1), size):
            yield self._get_samples(indices[begin : begin + size])


class MaskedReplayBuffer(ReplayBuffer):
    """A replay buffer likewise. Set :attr:`source`, and :attr:`random`, which samples, before the first step."""

    source: RobotVecEnv
    random: np.random.Generator

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.acted = np.zeros((self.buffer_size, self.n_envs), np.bool_)

    def add(self, *args: Any, **kwargs: Any) -> None:
        self.acted[self.pos] = self.source.acted
        super().add(*args, **kwargs)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        rows, slots = self._acted_steps(batch_inds)
        rewards = self._normalize_reward(self.rewards[rows, slots].reshape(-1, 1), env)
        dones = (self.dones[rows, slots] * (1 - self.timeouts[rows, slots])).reshape(-1, 1)
        return ReplayBufferSamples(
            self._seen(self.observations[rows, slots], env),
            self.to_torch(self.actions[rows, slots]),
            self._seen(self.next_observations[rows, slots], env),
            self.to_torch(dones),
            self.to_torch(rewards),
        )

    def _seen(self, observations: np.ndarray, env: VecNormalize | None) -> torch.Tensor:
        normalized = self._normalize_obs(observations, env)
        assert isinstance(normalized, np.ndarray)
        return self.to_torch(normalized)

    def _acted_steps(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As many steps as there are rows, drawn again until somebody acted in them."""
        slots = self.random.integers(0, self.n_envs, len(rows))
        last = self.buffer_size if self.full else self.pos
        while (idle := ~self.acted[rows, slots]).any():
            rows[idle] = self.random.integers(0, last, int(idle.sum()))
            slots[idle] = self.random.integers(0, self.n_envs, int(idle.sum()))
        return rows, slots
