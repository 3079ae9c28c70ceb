"""The algorithms of Stable-Baselines3 that are used here, with the settings that suit many robots at once.

Their policies become networks of this package.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
import stable_baselines3
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from d4orm_env.envs.features import Features
from d4orm_planners.rl.masked_buffers import MaskedReplayBuffer, MaskedRolloutBuffer
from d4orm_planners.rl.network import FORMAT, KINDS, SUM_SCALE, Header, Network
from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.task_mixture import MixedVecEnv

START_COUNT = 1e6  #: Observations that a trained network's normalisation counts for: what it knows is not forgotten
WIDTHS = (64, 32)  #: Widths of the layers that neighbours go through, and of those of obstacles


class _Set(nn.Module):
    """Rows ``(N, R, row)`` and the robot itself ``(N, own)`` to what all rows have in common, ``(N, 2 * width)``."""

    def __init__(self, row: int, own: int, width: int) -> None:
        super().__init__()
        self.first, self.own = nn.Linear(row, width), nn.Linear(own, width, bias=False)
        self.second = nn.Linear(width, width)

    def forward(self, rows: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
        hidden = torch.relu(self.first(rows) + self.own(own)[:, None])
        hidden = torch.relu(self.second(hidden)) * rows[..., :1]
        if not rows.shape[1]:
            return hidden.new_zeros(len(rows), 2 * hidden.shape[2])
        return torch.cat([hidden.amax(dim=1), SUM_SCALE * hidden.sum(dim=1)], dim=1)


_FILED = {"first.weight": "weight_0", "own.weight": "own", "first.bias": "bias_0", "second.weight": "weight_1",
          "second.bias": "bias_1"}  # fmt: skip
"""Names of a set's parameters in policy files."""


class SetExtractor(BaseFeaturesExtractor):
    """Pooled features of neighbours and obstacles, beside a robot's own."""

    def __init__(self, observation_space: Box, features: Features) -> None:
        own = features.own_size
        super().__init__(observation_space, own + 2 * sum(WIDTHS))
        self._features = features
        rows = (features.neighbor_size, features.obstacle_size)
        self._sets = [_Set(row, own, width) for row, width in zip(rows, WIDTHS, strict=True)]
        for kind, part in zip(KINDS, self._sets, strict=True):
            self.add_module(kind, part)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        own, *rows = self._features.parts(observations)
        return torch.cat([own, *(part(listed, own) for part, listed in zip(self._sets, rows, strict=True))], dim=1)

    def arrays(self) -> dict[str, torch.Tensor]:
        """Parameters by the names that policy files have for them."""
        parts = zip(KINDS, self._sets, strict=True)
        return {f"{kind}_{_FILED[name]}": own for kind, part in parts for name, own in part.named_parameters()}


SHARES = ("tau", "gae_lambda")  #: Settings that are at most 1


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """One of Stable-Baselines3's algorithms."""

    model: Any  #: Its class
    buffer: str  #: Attribute in which a model keeps what it learns from
    buffer_class: type[BaseBuffer]  #: Class of that
    num_envs: int  #: Robots that act at once, unless configured otherwise
    steps_per_update: int  #: Steps that each of them takes between two updates
    settings: Callable[[int, int], dict[str, Any]]  #: Further keywords of SB3 for so many steps and robots
    learning_rate: float = 3e-4  #: At the beginning; it falls linearly to a tenth
    gamma: float = 0.99  #: Discount per step
    network: Mapping[str, object] = field(default_factory=dict)  #: Further keywords of its networks
    tunable: Mapping[str, float]  #: More keywords of SB3 that a training may set, with values here

    def make(self, env: VecNormalize, sets: Features | None, tuned: Mapping[str, float]) -> BaseAlgorithm:
        """A new model, whose first weights are drawn from the global random state."""
        network: dict[str, object] = {"net_arch": [128, 128], **self.network}
        if sets is not None:
            network |= {"features_extractor_class": SetExtractor, "features_extractor_kwargs": {"features": sets}}
            network |= {"activation_fn": torch.nn.ReLU}
        settings: dict[str, Any] = {"learning_rate": self.learning_rate, "gamma": self.gamma, **self.tunable, **tuned}
        settings |= {f"{self.buffer}_class": self.buffer_class, **self.settings(self.steps_per_update, env.num_envs)}
        return self.model("MlpPolicy", env, policy_kwargs=network, device="cpu", **settings)

    def checked(self, tuned: Mapping[str, float]) -> dict[str, float]:
        """``learner_settings``, values for :attr:`tunable`, whole where those here are; ValueError for others."""
        values: dict[str, float] = {}
        for keyword, value in tuned.items():
            if keyword not in self.tunable:
                raise ValueError(f"learner_settings has {keyword!r}; choose of {', '.join(self.tunable)}")
            least = 1 if isinstance(self.tunable[keyword], int) else None
            if keyword in SHARES and value > 1:
                raise ValueError(f"learner_settings has {keyword}={value:g}; it must be at most 1")
            if value < 0 or (least and (value < least or value != int(value))):
                wanted = "a whole number of at least 1" if least else "at least 0"
                raise ValueError(f"learner_settings has {keyword}={value:g}; it must be {wanted}")
            values[keyword] = int(value) if least else value
        return values

    def prepare(self, model: BaseAlgorithm, robots: RobotVecEnv | MixedVecEnv, seed: int) -> None:
        """Tell the model's buffer which robots act, and seed whatever the model draws."""
        set_random_seed(seed)
        model.action_space.seed(seed)
        buffer = getattr(model, self.buffer)
        buffer.source, buffer.random = robots, np.random.default_rng(seed)


def _batch_size(steps: int, num_envs: int) -> int:
    """About 4096 samples, such that batches of one size make up an update; ``steps`` is a power of two."""
    parts = 1
    while parts < steps and steps * num_envs // parts > 4096:
        parts *= 2
    return steps * num_envs // parts


ALGORITHMS: Mapping[str, Algorithm] = MappingProxyType({
    "ppo": Algorithm(
        model=stable_baselines3.PPO,
        buffer="rollout_buffer",
        buffer_class=MaskedRolloutBuffer,
        num_envs=1024,
        steps_per_update=32,
        settings=lambda steps, robots: {"n_steps": steps, "batch_size": _batch_size(steps, robots)},
        network={"log_std_init": -0.5},
        tunable={"n_epochs": 4, "gae_lambda": 0.95, "clip_range": 0.2, "ent_coef": 0.0, "vf_coef": 0.5,
                 "max_grad_norm": 0.5},
    ),
    "sac": Algorithm(
        model=stable_baselines3.SAC,
        buffer="replay_buffer",
        buffer_class=MaskedReplayBuffer,
        num_envs=64,
        steps_per_update=1,
        learning_rate=1e-3,
        # Little entropy from the beginning: what is paid for at first stays in the values for long.
        settings=lambda steps, robots: {"ent_coef": "auto_0.05", "learning_starts": 50 * robots, "train_freq": steps},
        tunable={"batch_size": 256, "gradient_steps": 4, "tau": 0.02, "buffer_size": 300_000},
    ),
})  # fmt: skip
"""By their policies' names."""


def network_of(header: Mapping[str, Any], model: BaseAlgorithm, normalization: VecNormalize) -> Network:
    """The deterministic policy of a PPO or SAC model with fully connected layers, and its normalisation.

    ``header`` are fields of :class:`~d4orm_planners.rl.network.Header` that the model does not tell.
    """
    arrays = {name: parameter.detach().numpy() for name, parameter in _parameters(model).items()}
    arrays["reward_variance"] = normalization.ret_rms.var
    if (sets := _set_extractor(model)) is None:
        seen = _seen(normalization)
        arrays |= {"observation_mean": seen.mean, "observation_variance": seen.var}
    actor = _actor(model)
    full = Header(
        format=FORMAT,
        activation="relu" if any(isinstance(layer, nn.ReLU) for layer in actor) else "tanh",
        squashed=_squashed(model),
        layers=sum(isinstance(layer, nn.Linear) for layer in actor),
        encoder=None if sets is None else "sets",
        **header,
    )
    return Network(full, {name: np.array(value, np.float32) for name, value in arrays.items()})


def set_network(model: BaseAlgorithm, normalization: VecNormalize, network: Network) -> None:
    """Have a model act as a network does, in its own normalisation; what it thinks of states is left as it is.

    Another kind of network is a ValueError that says which is wanted.
    """
    arrays, parameters, sets = network.arrays, _parameters(model), _set_extractor(model)
    theirs_kind, mine_kind = network.header.encoder or "flat", "flat" if sets is None else "sets"
    if theirs_kind != mine_kind:
        raise ValueError(
            f"the policy to start from is a {theirs_kind} network, and a {mine_kind} one is wanted; give "
            f"network={theirs_kind!r}, or another policy"
        )
    if network.header.squashed != _squashed(model):
        raise ValueError(
            f"the policy to start from was trained by {network.header.algorithm}, whose networks differ; give one that "
            "was trained by the same algorithm"
        )
    mine = {name: tuple(parameter.shape) for name, parameter in parameters.items()}
    theirs = {name: array.shape for name, array in arrays.items() if not name.endswith(("_mean", "_variance"))}
    if mine != theirs:
        raise ValueError(
            f"the policy to start from is a network with layers {theirs}, and {mine} are wanted; give one that was "
            f"trained with the same settings: it saw {network.header.num_neighbors} robots and "
            f"{network.header.num_obstacles} obstacles"
        )
    with torch.no_grad():
        for name, parameter in parameters.items():
            parameter.copy_(torch.as_tensor(arrays[name]))
    if sets is None:
        seen = _seen(normalization)
        seen.mean, seen.var = (arrays[f"observation_{part}"].astype(np.float64) for part in ("mean", "variance"))
        seen.count = START_COUNT


def _seen(normalization: VecNormalize) -> RunningMeanStd:
    assert not isinstance(normalization.obs_rms, dict)
    return normalization.obs_rms


def _squashed(model: BaseAlgorithm) -> bool:
    return hasattr(model.policy, "actor")


def _actor(model: BaseAlgorithm) -> list[nn.Module]:
    """Return the layers that a model acts by, in order."""
    policy: Any = model.policy
    if _squashed(model):
        return [*policy.actor.latent_pi, policy.actor.mu]
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def _set_extractor(model: BaseAlgorithm) -> SetExtractor | None:
    policy: Any = model.policy
    extractor = (policy.actor if _squashed(model) else policy).features_extractor
    return extractor if isinstance(extractor, SetExtractor) else None


def _parameters(model: BaseAlgorithm) -> dict[str, torch.Tensor]:
    """Parameters of what a model acts by, by the names that policy files have for them."""
    named: dict[str, torch.Tensor] = {}
    for index, layer in enumerate(layer for layer in _actor(model) if isinstance(layer, nn.Linear)):
        named |= {f"weight_{index}": layer.weight, f"bias_{index}": layer.bias}
    sets = _set_extractor(model)
    return named if sets is None else named | sets.arrays()
