"""Rules that turn the rewards of samples into weights: pure, over the last axis, for NumPy and JAX arrays alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from d4orm_planners.engine.weighting import softmax_weights

Array: TypeAlias = Any  #: An array of NumPy or JAX, whichever ``xp`` is; the two have no common type


@dataclass(frozen=True)
class SoftmaxWeights:
    """``exp(normalised reward / temperature)``, normalised to sum to one (paper, Eq. for the Monte Carlo estimate).

    Rewards are normalised to mean zero and standard deviation one over the samples (paper, section III-C).
    """

    temperature: float  #: ``lambda``; smaller values follow the best samples more closely
    cutoff: float = 0.0  #: Weights below this share of the largest are dropped: they add less than the sampling error

    def __call__(self, rewards: Array, xp: ModuleType, log_ratio: Array | None = None) -> Array:
        """Weights of ``rewards`` ``(..., M)``, times ``exp(log_ratio)`` if given; none for minus infinity."""
        if xp is np:
            return softmax_weights(rewards, self.temperature, self.cutoff, log_ratio)
        usable = rewards > -xp.inf
        count = xp.maximum(usable.sum(-1, keepdims=True), 1).astype(rewards.dtype)
        mean = xp.where(usable, rewards, 0).sum(-1, keepdims=True) / count
        deviation = xp.where(usable, rewards - mean, 0)
        # Below this spread all samples are as good as equal, and amplifying rounding would be noise.
        spread = xp.maximum(xp.sqrt((deviation * deviation).sum(-1, keepdims=True) / count), 1e-6)
        best = rewards.max(-1, keepdims=True)
        logarithm = (rewards - xp.where(best > -xp.inf, best, 0)) * (1 / (self.temperature * spread))
        if log_ratio is not None:
            logarithm = xp.where(usable, logarithm + log_ratio, -xp.inf)
            best = logarithm.max(-1, keepdims=True)
            logarithm = logarithm - xp.where(best > -xp.inf, best, 0)
        weight = xp.exp(logarithm)
        if self.cutoff > 0:
            weight = xp.where(weight >= self.cutoff, weight, 0)
        return weight * (1 / xp.maximum(weight.sum(-1, keepdims=True), 1e-30))


@dataclass(frozen=True)
class GroupWeights:
    """Weights of each robot's part of a sample by what the robot's group gained by it."""

    rule: Callable[..., Array]  #: Function that makes weights of rewards
    groups: tuple[tuple[int, ...], ...]  #: Disjoint groups of robots, all robots together

    def __call__(self, rewards: Array, xp: ModuleType, log_ratio: Array | None = None) -> Array:
        """Weights ``(K, M)`` of the robots' own ``rewards`` ``(K, M)``; see :class:`SoftmaxWeights`."""
        shared = self._summed(rewards, xp)
        return self.rule(shared, xp) if log_ratio is None else self.rule(shared, xp, self._summed(log_ratio, xp))

    def _summed(self, rows: Array, xp: ModuleType) -> Array:
        """``(K, M)`` the sum over each robot's group."""
        group_of = {robot: group for group in self.groups for robot in group}
        sums = {group: rows[np.array(group)].sum(axis=0) for group in self.groups}
        return xp.stack([sums[group_of[robot]] for robot in range(len(rows))])


@dataclass(frozen=True)
class EliteWeights:
    """Equal weights for the best samples, none for the rest (the cross-entropy method)."""

    fraction: float  #: Share of samples that are elite

    def __call__(self, rewards: Array, xp: ModuleType) -> Array:
        """Weights of ``rewards`` ``(..., M)``; a sample at minus infinity is never elite."""
        count = max(1, round(self.fraction * rewards.shape[-1]))
        threshold = xp.sort(rewards, axis=-1)[..., -count][..., None]
        elite = (rewards >= threshold) & (rewards > -xp.inf)
        return elite / xp.maximum(elite.sum(-1, keepdims=True), 1)
