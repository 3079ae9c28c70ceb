"""Behaviour cloning: a network learns what an expert does by least squares."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecNormalize

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.rl.network import Network

BATCH = 128
LEARNING_RATE = 1e-3
"""At the beginning of a round; it falls linearly to nothing."""


def normalize(env: VecNormalize, inputs: FloatArray) -> None:
    """Have an environment normalise observations as these features ``(N, F)`` want it."""
    seen: Any = env.obs_rms
    seen.mean, seen.var = inputs.mean(axis=0, dtype=np.float64), inputs.var(axis=0, dtype=np.float64)
    seen.count = float(len(inputs))


def clone(
    model: Any,
    env: VecNormalize,
    inputs: FloatArray,
    targets: FloatArray,
    *,
    epochs: int,
    random: np.random.Generator,
    report: Callable[[int], object],
) -> None:
    """Have the mean of a PPO model's actions follow an expert's, by Adam on the mean squared difference.

    Args:
        model: The model.
        env: Normalises its observations.
        inputs: ``(N, F)`` features.
        targets: ``(N, m)`` the expert's actions in ``[-1, 1]``.
        epochs: Number of times that each sample is looked at.
        random: In which order.
        report: Called with the number of epochs done.
    """
    policy = model.policy
    seen, wanted = torch.as_tensor(env.normalize_obs(inputs)), torch.as_tensor(targets)
    policy.set_training_mode(True)
    batches = max(len(inputs) // BATCH, 1)
    for epoch in range(epochs):
        report(epoch)
        for number, part in enumerate(np.array_split(random.permutation(len(inputs)), batches)):
            left = 1 - (epoch + number / batches) / epochs
            for group in policy.optimizer.param_groups:
                group["lr"] = LEARNING_RATE * left
            loss = torch.nn.functional.mse_loss(policy.get_distribution(seen[part]).distribution.mean, wanted[part])
            policy.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            policy.optimizer.step()
    report(epochs)


def imitation_error(network: Network, inputs: FloatArray, targets: FloatArray) -> float:
    """Root mean square of a network's actions ``(N, m)`` less the expert's, in units of the limits."""
    return float(np.sqrt(np.mean((network(inputs) - targets) ** 2)))
