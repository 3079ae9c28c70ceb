"""The trained diffusion model: a small network that tells the clean motion in a noisy one, evaluated in a fixed order.

The network is a residual multilayer perceptron over the modes of a motion, whitened by their deviation among the
examples. Its sums run in the order in which they are written, so that a seed has the same plan on every processor.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.portable import cos
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS
from d4orm_planners.baselines.mmd.path_frame import FEATURES, MODES

WEIGHTS = Path(__file__).with_name("weights.npz")
"""Weights that come with the package; see `docs/planners/mmd.md` for their card."""
SIZE = 2 * MODES
"""Numbers of a motion: modes along the path's line, then across."""
LEVELS = 9
"""Numbers by which the network is told how noisy a motion is."""
CLIP = np.float32(4.0)
"""Deviations from the mean beyond which the network is not believed."""
_END = 0.98
"""End of the cosine schedule, short of pure noise."""


class Prior(NamedTuple):
    """The network's weights, all float32, and what whitens motions.

    Attributes:
        deviation: ``(SIZE,)`` of the modes among the examples, in lengths of the path.
        features_mean: ``(FEATURES,)``.
        features_deviation: ``(FEATURES,)``.
        into: ``(SIZE + LEVELS, W)`` from motion and noise level to the first layer.
        context: ``(FEATURES, W)`` from the features to the first layer.
        into_bias: ``(W,)``.
        hidden: ``(L, W, W)``.
        hidden_bias: ``(L, W)``.
        out: ``(W, SIZE)``.
        out_bias: ``(SIZE,)``.
    """

    deviation: FloatArray
    features_mean: FloatArray
    features_deviation: FloatArray
    into: FloatArray
    context: FloatArray
    into_bias: FloatArray
    hidden: FloatArray
    hidden_bias: FloatArray
    out: FloatArray
    out_bias: FloatArray


@cache
def load_prior(path: Path = WEIGHTS) -> Prior:
    """The model that was trained.

    Raises:
        ValueError: If the file does not hold one, or one of other sizes.
    """
    with np.load(path, allow_pickle=False) as file:
        missing = [name for name in Prior._fields if name not in file]
        if missing:
            raise ValueError(
                f"{path} has no {missing[0]}; train it anew: python -m d4orm_planners.baselines.mmd.prior_training"
            )
        prior = Prior(*(np.ascontiguousarray(file[name], np.float32) for name in Prior._fields))
    if prior.into.shape[0] != SIZE + LEVELS or prior.context.shape[0] != FEATURES:
        raise ValueError(
            f"{path} is a model of {prior.into.shape[0] - LEVELS} modes and {prior.context.shape[0]} features; it must "
            f"be of {SIZE} and {FEATURES}: train it anew: python -m d4orm_planners.baselines.mmd.prior_training"
        )
    return prior


def kept_signal(steps: int) -> Floats:
    """``(steps + 1,)`` share of the variance that is signal, ``alpha_bar``, from clean to noise: a cosine's square."""
    return cos(np.pi / 2 * _END * np.arange(steps + 1) / steps) ** 2


def level_features(signal: FloatArray | Floats) -> FloatArray:
    """``(..., LEVELS)`` hats over the noise's deviation, for ``alpha_bar`` of any shape."""
    noise = np.sqrt(1.0 - signal)[..., None]
    hats = np.maximum(0.0, 1.0 - np.abs((LEVELS - 1) * noise - np.arange(LEVELS)))
    return hats.astype(np.float32)


def posterior(now: float, then: float) -> tuple[float, float, float]:
    """Return the mean's shares of a clean and of a noisier motion in a less noisy one, and its deviation.

    Ho, Jain and Abbeel, *Denoising diffusion probabilistic models* (NeurIPS 2020), equations 6 and 7.

    Args:
        now: ``alpha_bar`` of the noisier motion.
        then: Of the less noisy one.
    """
    ratio = now / then
    of_clean = np.sqrt(then) * (1 - ratio) / (1 - now)
    of_noisy = np.sqrt(ratio) * (1 - then) / (1 - now)
    return float(of_clean), float(of_noisy), float(np.sqrt((1 - then) / (1 - now) * (1 - ratio)))


@cached_kernel(variant="condition", **OPTIONS)
def condition(prior: Prior, features: FloatArray, context: FloatArray) -> None:
    """Fill ``context`` ``(P, W)`` with what features ``(P, FEATURES)`` add to the first layer, its bias included."""
    for p in range(features.shape[0]):
        context[p] = prior.into_bias
        for i in range(features.shape[1]):
            value = (features[p, i] - prior.features_mean[i]) / prior.features_deviation[i]
            for j in range(context.shape[1]):
                context[p, j] += value * prior.context[i, j]


@cached_kernel(variant="predict", **OPTIONS)
def predict(
    prior: Prior, context: FloatArray, level: FloatArray, signal: FloatArray, noisy: FloatArray, clean: FloatArray
) -> None:
    """Fill ``clean`` ``(B, SIZE)`` with what the network takes noisy motions ``(B, SIZE)`` to be without their noise.

    Args:
        prior: The model.
        context: ``(P, W)`` of :func:`condition`; motion ``b`` is of direction ``b`` modulo ``P``.
        level: ``(LEVELS,)`` of :func:`level_features`.
        signal: ``(2,)`` float32 roots of ``alpha_bar`` and of ``1 - alpha_bar``.
        noisy: ``(B, SIZE)`` float32, whitened.
        clean: The same, output, within :data:`CLIP`.
    """
    width, size = context.shape[1], noisy.shape[1]
    layer, change = np.empty(width, np.float32), np.empty(width, np.float32)
    for b in range(noisy.shape[0]):
        layer[:] = context[b % context.shape[0]]
        for i in range(size + level.shape[0]):
            value = noisy[b, i] if i < size else level[i - size]
            for j in range(width):
                layer[j] += value * prior.into[i, j]
        for j in range(width):
            layer[j] = max(layer[j], np.float32(0))
        for number in range(prior.hidden.shape[0]):
            change[:] = prior.hidden_bias[number]
            for i in range(width):
                value = layer[i]
                for j in range(width):
                    change[j] += value * prior.hidden[number, i, j]
            for j in range(width):
                layer[j] += max(change[j], np.float32(0))
        clean[b] = prior.out_bias
        for i in range(width):
            value = layer[i]
            for j in range(size):
                clean[b, j] += value * prior.out[i, j]
        for j in range(size):
            value = signal[0] * noisy[b, j] + signal[1] * clean[b, j]
            clean[b, j] = min(max(value, -CLIP), CLIP)
