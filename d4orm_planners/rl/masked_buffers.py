"""Buffers of Stable-Baselines3 that hand out the steps in which a robot acted, and no others."""

from __future__ import annotations

from collections.abc import Generator
from functools import cached_property

import numpy as np
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples, RolloutBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.task_mixture import MixedVecEnv


class _MaskedBuffer(BaseBuffer):
    """Keeps in which steps :attr:`RobotVecEnv.acted` was true, and hands out only those.

    Set :attr:`source`, and :attr:`random`, by which steps are drawn, before the first step.
    """

    source: RobotVecEnv | MixedVecEnv
    random: np.random.Generator

    @cached_property
    def acted(self) -> np.ndarray:
        """``(T, B)`` which robots acted in which steps."""
        return np.zeros((self.buffer_size, self.n_envs), np.bool_)

    def add(self, *args: object, **kwargs: object) -> None:
        self.acted[self.pos] = self.source.acted
        super().add(*args, **kwargs)


class MaskedRolloutBuffer(_MaskedBuffer, RolloutBuffer):
    """A rollout buffer without the steps in which a robot did nothing."""

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


class MaskedReplayBuffer(_MaskedBuffer, ReplayBuffer):
    """A replay buffer likewise."""

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        rows, slots = self._acted_steps(batch_inds)
        rewards = self._normalize_reward(self.rewards[rows, slots].reshape(-1, 1), env)
        dones = (self.dones[rows, slots] * (1 - self.timeouts[rows, slots])).reshape(-1, 1)
        return ReplayBufferSamples(
            self.to_torch(self._normalize_obs(self.observations[rows, slots], env)),  # type: ignore[arg-type]
            self.to_torch(self.actions[rows, slots]),
            self.to_torch(self._normalize_obs(self.next_observations[rows, slots], env)),  # type: ignore[arg-type]
            self.to_torch(dones),
            self.to_torch(rewards),
        )

    def _acted_steps(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return as many steps as there are rows, drawn again until a robot acted in them."""
        slots = self.random.integers(0, self.n_envs, len(rows))
        last = self.buffer_size if self.full else self.pos
        while (idle := ~self.acted[rows, slots]).any():
            rows[idle] = self.random.integers(0, last, int(idle.sum()))
            slots[idle] = self.random.integers(0, self.n_envs, int(idle.sum()))
        return rows, slots
