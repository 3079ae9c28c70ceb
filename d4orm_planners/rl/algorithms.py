"""The algorithms of Stable-Baselines3 that are used here, with the settings that suit many robots at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import FloatSchedule, set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from d4orm_planners.rl.features import Features
from d4orm_planners.rl.masking import MaskedReplayBuffer, MaskedRolloutBuffer
from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.sb3_sets import SetExtractor
from d4orm_planners.rl.task_mixture import MixedVecEnv

_AS_THEY_ARE: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Algorithm:
    """One of Stable-Baselines3's algorithms.

    Attributes:
        buffer: Attribute in which a model keeps what it learns from.
        num_envs: Robots that act at once, unless configured otherwise.
        steps_per_update: Steps that each of them takes between two updates.
        learning_rate: At the beginning; it falls linearly to a tenth.
        gamma: Discount per step.
        tunable: Further keywords of Stable-Baselines3 that a training may set otherwise, with their values here.
    """

    buffer: ClassVar[str]
    num_envs: ClassVar[int]
    steps_per_update: ClassVar[int]
    learning_rate: ClassVar[float] = 3e-4
    gamma: ClassVar[float] = 0.99
    tunable: ClassVar[Mapping[str, float]]

    def make(
        self, env: VecNormalize, sets: Features | None = None, tuned: Mapping[str, float] = _AS_THEY_ARE
    ) -> BaseAlgorithm:
        """A new model, whose first weights are drawn from the global random state.

        Args:
            env: Environment that it learns from.
            sets: Its features, for a network that pools neighbours and obstacles; ``None`` makes a flat one.
            tuned: Those of :attr:`tunable` that are otherwise.
        """
        raise NotImplementedError

    def _settings(self, tuned: Mapping[str, float]) -> dict[str, Any]:
        """Further keywords of Stable-Baselines3."""
        return {**self.tunable, **tuned}

    def checked(self, tuned: Mapping[str, float], name: str) -> dict[str, float]:
        """Values for :attr:`tunable`, whole where those here are.

        Raises:
            ValueError: For a keyword that is not one of them, or a value that makes no sense.
        """
        values: dict[str, float] = {}
        for keyword, value in tuned.items():
            if keyword not in self.tunable:
                raise ValueError(f"{name} has {keyword!r}; choose of {', '.join(self.tunable)}")
            least = 1 if isinstance(self.tunable[keyword], int) else None
            if value < 0 or (least and (value < least or value != int(value))):
                wanted = "a whole number of at least 1" if least else "at least 0"
                raise ValueError(f"{name} has {keyword}={value:g}; it must be {wanted}")
            values[keyword] = int(value) if least else value
        return values

    def prepare(self, model: BaseAlgorithm, robots: RobotVecEnv | MixedVecEnv, seed: int) -> None:
        """Tell the model's buffer which robots act, and seed whatever the model draws."""
        set_random_seed(seed)
        model.action_space.seed(seed)
        buffer = getattr(model, self.buffer)
        buffer.source, buffer.random = robots, np.random.default_rng(seed)

    def set_learning_rate(self, model: BaseAlgorithm, remaining: float, first: float | None = None) -> None:
        """Set the rate for the share of the training that remains, 1 to 0, from ``first`` on, by default its own."""
        model.lr_schedule = FloatSchedule((first or self.learning_rate) * (0.1 + 0.9 * remaining))


def _batch_size(steps: int, num_envs: int) -> int:
    """About 4096 samples, such that batches of one size make up an update; ``steps`` is a power of two."""
    parts = 1
    while parts < steps and steps * num_envs // parts > 4096:
        parts *= 2
    return steps * num_envs // parts


def _sets_of(features: Features) -> dict[str, object]:
    """Arguments of a policy that pools neighbours and obstacles."""
    return {"features_extractor_class": SetExtractor, "features_extractor_kwargs": {"features": features}}


class _PPO(Algorithm):
    buffer = "rollout_buffer"
    num_envs = 1024
    steps_per_update = 32
    tunable = MappingProxyType(
        {"n_epochs": 4, "gae_lambda": 0.95, "clip_range": 0.2, "ent_coef": 0.0, "vf_coef": 0.5, "max_grad_norm": 0.5}
    )

    def make(
        self, env: VecNormalize, sets: Features | None = None, tuned: Mapping[str, float] = _AS_THEY_ARE
    ) -> BaseAlgorithm:
        network: dict[str, object] = {"net_arch": [128, 128], "log_std_init": -0.5}
        if sets is not None:
            network |= {**_sets_of(sets), "activation_fn": torch.nn.ReLU}
        return stable_baselines3.PPO(
            "MlpPolicy",
            env,
            learning_rate=self.learning_rate,
            n_steps=self.steps_per_update,
            batch_size=_batch_size(self.steps_per_update, env.num_envs),
            gamma=self.gamma,
            policy_kwargs=network,
            rollout_buffer_class=MaskedRolloutBuffer,
            device="cpu",
            **self._settings(tuned),
        )


class _SAC(Algorithm):
    buffer = "replay_buffer"
    num_envs = 64
    steps_per_update = 1
    learning_rate = 1e-3
    tunable = MappingProxyType({"batch_size": 256, "gradient_steps": 4, "tau": 0.02, "buffer_size": 300_000})

    def make(
        self, env: VecNormalize, sets: Features | None = None, tuned: Mapping[str, float] = _AS_THEY_ARE
    ) -> BaseAlgorithm:
        network: dict[str, object] = {"net_arch": [128, 128]}
        if sets is not None:
            network |= _sets_of(sets)
        return stable_baselines3.SAC(
            "MlpPolicy",
            env,
            learning_rate=self.learning_rate,
            # Little entropy from the beginning: what is paid for at first stays in the values for long.
            ent_coef="auto_0.05",
            learning_starts=50 * env.num_envs,
            train_freq=self.steps_per_update,
            gamma=self.gamma,
            policy_kwargs=network,
            replay_buffer_class=MaskedReplayBuffer,
            device="cpu",
            **self._settings(tuned),
        )


ALGORITHMS: Mapping[str, Algorithm] = MappingProxyType({"ppo": _PPO(), "sac": _SAC()})
"""Algorithms by the names of their policies."""
