"""The algorithms of Stable-Baselines3 that are used here, with the settings that suit many robots at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import FloatSchedule, set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from d4orm_planners.rl.features import Features
from d4orm_planners.rl.masking import MaskedReplayBuffer, MaskedRolloutBuffer
from d4orm_planners.rl.mixture import MixedVecEnv
from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.sb3_sets import SetExtractor


@dataclass(frozen=True)
class Algorithm:
    """One of Stable-Baselines3's algorithms.

    Attributes:
        buffer: Attribute in which a model keeps what it learns from.
        num_envs: Robots that act at once, unless configured otherwise.
        steps_per_update: Steps that each of them takes between two updates.
        learning_rate: At the beginning; it falls linearly to a tenth.
        gamma: Discount per step.
    """

    buffer: ClassVar[str]
    num_envs: ClassVar[int]
    steps_per_update: ClassVar[int]
    learning_rate: ClassVar[float] = 3e-4
    gamma: ClassVar[float] = 0.99

    def make(self, env: VecNormalize, sets: Features | None = None) -> BaseAlgorithm:
        """A new model, whose first weights are drawn from the global random state.

        Args:
            env: What it learns from.
            sets: What it sees, for a network that pools neighbours and obstacles; ``None`` makes a flat one.
        """
        raise NotImplementedError

    def prepare(self, model: BaseAlgorithm, robots: RobotVecEnv | MixedVecEnv, seed: int) -> None:
        """Tell the model's buffer which robots act, and seed whatever the model draws."""
        set_random_seed(seed)
        model.action_space.seed(seed)
        buffer = getattr(model, self.buffer)
        buffer.source, buffer.random = robots, np.random.default_rng(seed)

    def set_learning_rate(self, model: BaseAlgorithm, remaining: float, first: float | None = None) -> None:
        """For the share of the training that remains, 1 to 0, where it began with ``first``, by default its own."""
        model.lr_schedule = FloatSchedule((first or self.learning_rate) * (0.1 + 0.9 * remaining))


def _batch_size(steps: int, num_envs: int) -> int:
    """About 4096 samples, such that batches of one size make up an update; ``steps`` is a power of two."""
    parts = 1
    while parts < steps and steps * num_envs // parts > 4096:
        parts *= 2
    return steps * num_envs // parts


class _PPO(Algorithm):
    buffer = "rollout_buffer"
    num_envs = 1024
    steps_per_update = 32

    def make(self, env: VecNormalize, sets: Features | None = None) -> BaseAlgorithm:
        network: dict[str, object] = {"net_arch": [128, 128], "log_std_init": -0.5}
        if sets is not None:
            extractor = {"features_extractor_class": SetExtractor, "features_extractor_kwargs": {"features": sets}}
            network |= {**extractor, "activation_fn": torch.nn.ReLU}
        return stable_baselines3.PPO(
            "MlpPolicy",
            env,
            learning_rate=self.learning_rate,
            n_steps=self.steps_per_update,
            batch_size=_batch_size(self.steps_per_update, env.num_envs),
            n_epochs=4,
            gamma=self.gamma,
            gae_lambda=0.95,
            policy_kwargs=network,
            rollout_buffer_class=MaskedRolloutBuffer,
            device="cpu",
        )


class _SAC(Algorithm):
    buffer = "replay_buffer"
    num_envs = 64
    steps_per_update = 1
    learning_rate = 1e-3

    def make(self, env: VecNormalize, sets: Features | None = None) -> BaseAlgorithm:
        assert sets is None, "settings refuse that"
        return stable_baselines3.SAC(
            "MlpPolicy",
            env,
            learning_rate=self.learning_rate,
            # Little entropy from the beginning: what is paid for at first stays in the values for long.
            ent_coef="auto_0.05",
            tau=0.02,
            buffer_size=300_000,
            learning_starts=50 * env.num_envs,
            batch_size=256,
            train_freq=self.steps_per_update,
            gradient_steps=4,
            gamma=self.gamma,
            policy_kwargs={"net_arch": [128, 128]},
            replay_buffer_class=MaskedReplayBuffer,
            device="cpu",
        )


ALGORITHMS: Mapping[str, Algorithm] = MappingProxyType({"ppo": _PPO(), "sac": _SAC()})
"""By the names of the policies that come of them."""
