"""Motions of one robot from noise: the guided reverse process of the diffusion model, and drives along them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.engine.sample_noise import draw_normals, draw_uniforms
from d4orm_planners.baselines.mmd.guiding import PathSurroundings, guide
from d4orm_planners.baselines.mmd.path_frame import PathFrame, sine_table
from d4orm_planners.baselines.mmd.prior import (
    SIZE,
    Prior,
    condition,
    kept_signal,
    level_features,
    load_prior,
    posterior,
    predict,
)
from d4orm_planners.baselines.mmd.tracking import TrackedMotions, drive_motions

if TYPE_CHECKING:
    from d4orm_planners.baselines.mmd.planner import MMDConfig


@dataclass(frozen=True)
class Batch:
    """Motions of one robot that were denoised together.

    Attributes:
        motions: ``(B, SIZE)`` float32 whitened modes.
        durations: ``(B,)`` how long each takes [s].
        driven: Rollouts along them.
        steps: Denoising steps that it took.
    """

    motions: FloatArray
    durations: Floats
    driven: TrackedMotions
    steps: int


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
    ) -> Batch:
        """Motions of a robot that mind its surroundings, as well as guidance achieves it.

        Args:
            robot: Its number.
            frame: Its path.
            surroundings: Constraints on the motion.
            seed: Of the noise and the durations.
            before: ``(B, SIZE)`` motions to begin with, which get the noise of the last ``reuse_steps`` again; noise by
                default.
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
        return Batch(motions, durations, driven, done)

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
        numbers = np.empty((1, int(np.prod(shape))), np.float32)
        draw_normals(self._keys, np.zeros(1, np.int64), np.uint32(0), np.uint32(self._next()), numbers)
        return numbers.reshape(shape)

    def uniforms(self, count: int) -> FloatArray:
        numbers = np.empty((1, count), np.float32)
        draw_uniforms(self._keys, np.zeros(1, np.int64), np.uint32(0), np.uint32(self._next()), numbers)
        return numbers[0]

    def _next(self) -> int:
        self._call += 1
        return self._call
