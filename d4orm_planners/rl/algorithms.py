"""The algorithms of Stable-Baselines3 that are used here, with the settings that suit many robots at once.

Their buffers hand out the steps in which a robot acted, and no others.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples, RolloutBufferSamples
from stable_baselines3.common.utils import FloatSchedule, set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from d4orm_env.envs.features import Features
from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.sb3_network import SetExtractor
from d4orm_planners.rl.task_mixture import MixedVecEnv

_AS_THEY_ARE: Mapping[str, float] = MappingProxyType({})


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
        """Return as many steps as there are rows, drawn again until a robot acted in them."""
        slots = self.random.integers(0, self.n_envs, len(rows))
        last = self.buffer_size if self.full else self.pos
        while (idle := ~self.acted[rows, slots]).any():
            rows[idle] = self.random.integers(0, last, int(idle.sum()))
            slots[idle] = self.random.integers(0, self.n_envs, int(idle.sum()))
        return rows, slots


class Algorithm:
    """One of Stable-Baselines3's algorithms.

    Attributes:
        model: Its class.
        buffer: Attribute in which a model keeps what it learns from.
        buffer_class: Class of that.
        num_envs: Robots that act at once, unless configured otherwise.
        steps_per_update: Steps that each of them takes between two updates.
        learning_rate: At the beginning; it falls linearly to a tenth.
        gamma: Discount per step.
        network: Further keywords of its networks.
        tunable: Further keywords of Stable-Baselines3 that a training may set otherwise, with their values here.
    """

    model: ClassVar[Any]
    buffer: ClassVar[str]
    buffer_class: ClassVar[type[BaseBuffer]]
    num_envs: ClassVar[int]
    steps_per_update: ClassVar[int]
    learning_rate: ClassVar[float] = 3e-4
    gamma: ClassVar[float] = 0.99
    network: ClassVar[Mapping[str, object]] = MappingProxyType({})
    tunable: ClassVar[Mapping[str, float]]

    def make(
        self, env: VecNormalize, sets: Features | None = None, tuned: Mapping[str, float] = _AS_THEY_ARE
    ) -> BaseAlgorithm:
        """A new model, whose first weights are drawn from the global random state."""
        network: dict[str, object] = {"net_arch": [128, 128], **self.network}
        if sets is not None:
            network |= {"features_extractor_class": SetExtractor, "features_extractor_kwargs": {"features": sets}}
            network |= {"activation_fn": torch.nn.ReLU}
        settings: dict[str, Any] = {"learning_rate": self.learning_rate, "gamma": self.gamma, **self.tunable, **tuned}
        settings |= {f"{self.buffer}_class": self.buffer_class, **self._settings(env)}
        made: BaseAlgorithm = self.model("MlpPolicy", env, policy_kwargs=network, device="cpu", **settings)
        return made

    def _settings(self, env: VecNormalize) -> dict[str, Any]:
        """Further keywords of Stable-Baselines3 for an environment."""
        raise NotImplementedError

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


class _PPO(Algorithm):
    model = stable_baselines3.PPO
    buffer, buffer_class = "rollout_buffer", MaskedRolloutBuffer
    num_envs = 1024
    steps_per_update = 32
    network = MappingProxyType({"log_std_init": -0.5})
    tunable = MappingProxyType(
        {"n_epochs": 4, "gae_lambda": 0.95, "clip_range": 0.2, "ent_coef": 0.0, "vf_coef": 0.5, "max_grad_norm": 0.5}
    )

    def _settings(self, env: VecNormalize) -> dict[str, Any]:
        steps = self.steps_per_update
        return {"n_steps": steps, "batch_size": _batch_size(steps, env.num_envs)}


class _SAC(Algorithm):
    model = stable_baselines3.SAC
    buffer, buffer_class = "replay_buffer", MaskedReplayBuffer
    num_envs = 64
    steps_per_update = 1
    learning_rate = 1e-3
    tunable = MappingProxyType({"batch_size": 256, "gradient_steps": 4, "tau": 0.02, "buffer_size": 300_000})

    def _settings(self, env: VecNormalize) -> dict[str, Any]:
        # Little entropy from the beginning: what is paid for at first stays in the values for long.
        entropy = "auto_0.05"
        return {"ent_coef": entropy, "learning_starts": 50 * env.num_envs, "train_freq": self.steps_per_update}


ALGORITHMS: Mapping[str, Algorithm] = MappingProxyType({"ppo": _PPO(), "sac": _SAC()})
"""Algorithms by the names of their policies."""
