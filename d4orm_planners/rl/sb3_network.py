"""Policies of Stable-Baselines3 as networks of this package, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from d4orm_planners.rl.network import FORMAT, Header, Network
from d4orm_planners.rl.sb3_sets import SetExtractor

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.running_mean_std import RunningMeanStd
    from stable_baselines3.common.vec_env import VecNormalize

START_COUNT = 1e6
"""Observations that a trained network's normalisation counts for: what it knows is not forgotten."""


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

    Args:
        model: As for :func:`network_of`.
        normalization: Likewise.
        network: Of the same algorithm and shapes.

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
