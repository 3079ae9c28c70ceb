"""Policies of Stable-Baselines3 as networks of this package, and back; and the layers of those that pool sets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from d4orm_env.envs.features import Features
from d4orm_planners.rl.network import EPSILON, FORMAT, KINDS, SUM_SCALE, Header, Network

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

START_COUNT = 1e6
"""Observations that a trained network's normalisation counts for: what it knows is not forgotten."""


WIDTHS = (64, 32)
"""Widths of the layers that neighbours go through, and of those of obstacles."""


def network_of(header: Mapping[str, Any], model: BaseAlgorithm, normalization: VecNormalize) -> Network:
    """The deterministic policy of a Stable-Baselines3 model.

    Args:
        header: Fields of :class:`~d4orm_planners.rl.network.Header` that the model does not tell.
        model: A PPO or SAC model with fully connected layers.
        normalization: Its ``VecNormalize``.
    """
    layers, sets = _layers(model), _sets(model)
    arrays = {"reward_variance": normalization.ret_rms.var}
    if sets is None:
        seen = _seen(normalization)
        arrays |= {"observation_mean": seen.mean, "observation_variance": seen.var}
    else:
        arrays |= {name: array.detach().numpy() for name, array in sets.items()}
    for index, layer in enumerate(layers):
        arrays[f"weight_{index}"] = layer.weight.detach().numpy()
        arrays[f"bias_{index}"] = layer.bias.detach().numpy()
    activation = "relu" if any(isinstance(layer, torch.nn.ReLU) for layer in _actor(model)) else "tanh"
    full = Header(
        format=FORMAT, activation=activation, squashed=_squashed(model), layers=len(layers),
        encoder=None if sets is None else "sets", **header,
    )  # fmt: skip
    return Network(full, {name: np.array(value, np.float32) for name, value in arrays.items()})


def set_network(model: BaseAlgorithm, normalization: VecNormalize, network: Network) -> None:
    """Have a model act as a network does, in its own normalisation; what it thinks of states is left as it is.

    Raises:
        ValueError: If it is another kind of network; the message says which is wanted.
    """
    layers, arrays, sets = _layers(model), network.arrays, _sets(model) or {}
    if (network.header.encoder is None) != (not sets):
        theirs_kind, mine_kind = network.header.encoder or "flat", "sets" if sets else "flat"
        raise ValueError(
            f"the policy to start from is a {theirs_kind} network, and a {mine_kind} one is wanted; give "
            f"network={theirs_kind!r}, or another policy"
        )
    mine = [tuple(layer.weight.shape) for layer in layers]
    theirs = [arrays[f"weight_{index}"].shape for index in range(network.header.layers)]
    for name, parameter in sets.items():
        mine.append(tuple(parameter.shape))
        theirs.append(arrays[name].shape)
    if mine != theirs or network.header.squashed != _squashed(model):
        raise ValueError(
            f"the policy to start from is a network of {network.header.algorithm} with layers {theirs}, and {mine} are "
            "wanted; give one that was trained for the same robots by the same algorithm"
        )
    with torch.no_grad():
        for index, layer in enumerate(layers):
            layer.weight.copy_(torch.as_tensor(arrays[f"weight_{index}"]))
            layer.bias.copy_(torch.as_tensor(arrays[f"bias_{index}"]))
        for name, parameter in sets.items():
            parameter.copy_(torch.as_tensor(arrays[name]))
    if sets:
        return
    seen = _seen(normalization)
    seen.mean, seen.var = (arrays[f"observation_{part}"].astype(np.float64) for part in ("mean", "variance"))
    seen.count = START_COUNT


def _seen(normalization: VecNormalize) -> RunningMeanStd:
    """Mean and variance of the features, which are one array."""
    assert not isinstance(normalization.obs_rms, dict)
    return normalization.obs_rms


def _squashed(model: BaseAlgorithm) -> bool:
    return hasattr(model.policy, "actor")


def _actor(model: BaseAlgorithm) -> list[torch.nn.Module]:
    """Return the layers that a model acts by, in order."""
    policy: Any = model.policy
    if _squashed(model):
        return [*policy.actor.latent_pi, policy.actor.mu]
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def _layers(model: BaseAlgorithm) -> list[torch.nn.Linear]:
    return [layer for layer in _actor(model) if isinstance(layer, torch.nn.Linear)]


def _sets(model: BaseAlgorithm) -> dict[str, torch.Tensor] | None:
    """Parameters of a network of sets; ``None`` of another."""
    policy: Any = model.policy
    extractor = (policy.actor if _squashed(model) else policy).features_extractor
    return extractor.arrays() if isinstance(extractor, SetExtractor) else None


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
        named: dict[str, torch.Tensor] = {}
        for kind, part in zip(KINDS, self._sets, strict=True):
            named |= {
                f"{kind}_weight_0": part.first.weight,
                f"{kind}_own": part.own.weight,
                f"{kind}_bias_0": part.first.bias,
                f"{kind}_weight_1": part.second.weight,
                f"{kind}_bias_1": part.second.bias,
            }
        return named


def leave_as_they_are(env: VecNormalize) -> None:
    """Have features not normalised: every row of a set must be in the same units, and features are of order one."""
    fixed: Any = _Fixed(shape=env.observation_space.shape or ())
    fixed.var[:] = 1 - EPSILON
    env.obs_rms = fixed


class _Fixed(RunningMeanStd):
    def update(self, arr: Any) -> None:
        """Nothing is learned from what is seen."""
