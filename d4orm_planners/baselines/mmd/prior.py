"""The trained diffusion model: a small network that predicts the clean motion in a noisy one, in a fixed order.

The network is a residual multilayer perceptron over the modes of a motion, whitened by their deviation among the
examples. Its sums run in the order in which they are written, so that a seed has the same plan on every processor.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.portable import cos
from d4orm_env.core.problem import Problem
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS
from d4orm_env.engine.sample_noise import draw_normals, draw_uniforms
from d4orm_env.paths.spaces import Space
from d4orm_planners.baselines.mmd.motions import PathSurroundings, TrackedMotions, guide, motion_kernel
from d4orm_planners.baselines.mmd.path_frame import FEATURES, MODES, PathFrame, sine_table

if TYPE_CHECKING:
    from d4orm_planners.baselines.mmd.planner import MMDConfig

WEIGHTS = Path(__file__).with_name("weights.npz")  #: See their card in `docs/background/planners/rivals.md`
SIZE = 2 * MODES  #: Numbers of a motion: modes along the path's line, then across
LEVELS = 9  #: Numbers by which the network is told how noisy a motion is
CLIP = np.float32(4.0)  #: Deviations from the mean beyond which the network is not believed
_END = 0.98  #: End of the cosine schedule, short of pure noise


class Prior(NamedTuple):
    """The network's weights, all float32, and what whitens motions."""

    deviation: FloatArray  #: ``(SIZE,)`` of the modes among the examples, in lengths of the path
    features_mean: FloatArray  #: ``(FEATURES,)``
    features_deviation: FloatArray  #: ``(FEATURES,)``
    into: FloatArray  #: ``(SIZE + LEVELS, W)`` from motion and noise level to the first layer
    context: FloatArray  #: ``(FEATURES, W)`` from the features to the first layer
    into_bias: FloatArray  #: ``(W,)``
    hidden: FloatArray  #: ``(L, W, W)``
    hidden_bias: FloatArray  #: ``(L, W)``
    out: FloatArray  #: ``(W, SIZE)``
    out_bias: FloatArray  #: ``(SIZE,)``


@cache
def load_prior(path: Path = WEIGHTS) -> Prior:
    """The model that was trained. Raises ValueError if the file does not hold one, or one of other sizes."""
    with np.load(path, allow_pickle=False) as file:
        missing = [name for name in Prior._fields if name not in file]
        if missing:
            raise ValueError(f"{path} has no {missing[0]}; train it anew: python -m examples.studies mmd_prior")
        prior = Prior(*(np.ascontiguousarray(file[name], np.float32) for name in Prior._fields))
    if prior.into.shape[0] != SIZE + LEVELS or prior.context.shape[0] != FEATURES:
        raise ValueError(
            f"{path} is a model of {prior.into.shape[0] - LEVELS} modes and {prior.context.shape[0]} features; it must "
            f"be of {SIZE} and {FEATURES}: train it anew: python -m examples.studies mmd_prior"
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

    ``now`` and ``then`` are ``alpha_bar`` of the noisier one and of the less noisy one (Ho, Jain and Abbeel, *Denoising
    diffusion probabilistic models*, NeurIPS 2020, equations 6 and 7).
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


def drive_motions(
    problem: Problem,
    robot: int,
    frame: PathFrame,
    sines: Floats,
    deviation: Floats,
    space: Space,
    durations: Floats,
    motions: FloatArray,
) -> TrackedMotions:
    """Drive a robot along each of some motions, as if it were alone: by the clock, and then straight to its goal.

    ``deviation`` is ``(2 M,)`` of the modes, ``durations`` are ``(B,)`` [s], ``motions`` ``(B, 2 M)`` float32 whitened
    modes.
    """
    count, horizon = len(motions), problem.horizon
    driven = TrackedMotions(
        np.zeros((count, horizon, problem.control_size), np.float32),
        np.empty((count, horizon + 1, problem.state_size), np.float32),
        np.empty((count, horizon + 1, 3)),
        np.empty(count, np.int64),
        np.empty(count),
    )
    kernel = motion_kernel(problem.team.models[robot])
    kernel(problem.arrays, robot, frame, sines, deviation, space, durations, motions, driven)
    return driven


class Denoiser:
    """Denoiser of the motions of a team's robots, one robot at a time."""

    def __init__(self, problem: Problem, config: MMDConfig, should_stop: Callable[[], bool]) -> None:
        self._problem, self._config, self._should_stop = problem, config, should_stop
        self._prior: Prior = load_prior()
        self._sines, self._signal = sine_table(), kept_signal(config.num_steps)
        self._levels = level_features(self._signal)
        self._deviation = self._prior.deviation.astype(np.float64)

    def denoise(
        self, robot: int, frame: PathFrame, surroundings: PathSurroundings, seed: int, before: FloatArray | None = None
    ) -> tuple[FloatArray, TrackedMotions, int]:
        """Motions of a robot that mind its surroundings, as well as guidance achieves it; the seed is of noise and
        durations.

        They begin with noise, or with motions ``before`` ``(B, SIZE)``, which get the noise of the last ``reuse_steps``
        again. ``(B, SIZE)`` float32 whitened modes, rollouts along them, and the denoising steps that they took.
        """
        config, count = self._config, self._config.num_samples
        draw = _Draws(seed)
        first = config.num_steps if before is None else min(config.reuse_steps or config.num_steps, config.num_steps)
        noise = draw.normals((count, SIZE))
        kept = self._signal[first].astype(np.float32)
        motions = noise if before is None else np.sqrt(kept) * before + np.sqrt(1 - kept) * noise
        durations = self._durations(frame, draw)
        context = np.empty((len(frame.axes), len(self._prior.into_bias)), np.float32)
        condition(self._prior, frame.features, context)
        done, clean = 0, np.empty_like(motions)
        for step in range(first, 0, -1):
            if self._should_stop():
                break
            roots = np.sqrt([self._signal[step], 1 - self._signal[step]]).astype(np.float32)
            predict(self._prior, context, self._levels[step], roots, motions, clean)
            if step <= config.guide_from * config.num_steps:
                guide(frame, self._sines, self._deviation, surroundings, durations, config.guide_steps, clean)
            motions = self._less_noisy(step, motions, clean, draw)
            done += 1
        driven = drive_motions(
            self._problem, robot, frame, self._sines, self._deviation, surroundings.space, durations, motions
        )
        return motions, driven, done

    def _less_noisy(self, step: int, noisy: FloatArray, clean: FloatArray, draw: _Draws) -> FloatArray:
        """A draw from what a step's noisier motions say of the next step's: the posterior of DDPM, given clean ones."""
        if step == 1:
            return clean.copy()
        of_clean, of_noisy, deviation = posterior(self._signal[step], self._signal[step - 1])
        scale = np.float32(self._config.noise_scale * deviation)
        return np.float32(of_clean) * clean + np.float32(of_noisy) * noisy + scale * draw.normals(noisy.shape)

    def _durations(self, frame: PathFrame, draw: _Draws) -> Floats:
        """``(B,)`` between the quickest and the slowest that the settings allow, within the horizon [s]."""
        config = self._config
        slack = np.array(draw.uniforms(config.num_samples), np.float64)
        stretch = config.quickest + (config.slowest - config.quickest) * slack
        return np.minimum(frame.quickest * stretch, self._problem.duration)


class _Draws:
    """Random numbers from a seed and the number of the call, the same on every processor."""

    def __init__(self, seed: int) -> None:
        self._keys = np.array([[seed & 0xFFFFFFFF, seed >> 32 & 0xFFFFFFFF]], np.uint32)
        self._call = 0

    def normals(self, shape: tuple[int, ...]) -> FloatArray:
        return self._drawn(draw_normals, shape)

    def uniforms(self, count: int) -> FloatArray:
        return self._drawn(draw_uniforms, (count,))

    def _drawn(self, draw: Callable[..., None], shape: tuple[int, ...]) -> FloatArray:
        self._call += 1
        numbers = np.empty((1, int(np.prod(shape))), np.float32)
        draw(self._keys, np.zeros(1, np.int64), np.uint32(0), np.uint32(self._call), numbers)
        return numbers.reshape(shape)
