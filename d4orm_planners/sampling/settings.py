"""Settings and noise schedules of the sampling planners, of which each takes those that mean something to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated

import numpy as np
from pydantic import Field

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.base.planner import PlannerConfig
from d4orm_planners.base.settings import CheckedSettings, NotNegative, Positive, Samples, Steps, Variance, one_of
from d4orm_planners.sampling.weights import SoftmaxWeights

TUNED: Mapping[str, Mapping[str, object]] = MappingProxyType({
    "mppi": {},
    "cem": {"sigma": 0.352, "elite_fraction": 0.013, "adapt_variance": True, "sigma_floor": 0.0218, "num_steps": 50,
            "clip_between_iterations": True},
    "mbd": {"num_steps": 1000, "temperature": 0.323, "beta_start": 2.22e-4, "beta_end": 4.24e-2},
    "i-mbd": {"temperature": 0.31, "beta_start": 8.38e-4, "beta_end": 2.7e-2, "num_steps": 50,
              "clip_between_iterations": True},
    "d4orm": {"temperature": 0.495, "beta_start": 1.55e-5, "beta_end": 2.03e-2, "num_steps": 50,
              "clip_between_iterations": False},
})  # fmt: skip
"""Differences of the preset ``"tuned"`` from ``"paper"``, by planner.

From ``python -m examples.studies tune_rivals --candidates 27 --seeds 4``: 27 settings each, the preset ``"paper"``
among them, on four teams of 8 and 16 robots with seeds from 100 on. A third of the settings went on to twice the
seeds, and a third of these to four times as many. The trials are in
``examples/studies/data/tune_rivals.parquet``, the table in ``docs/tables/tuning.md``. A method
whose preset was best keeps it.
"""

REFERENCE_STEPS = 100
MOST_NOISE = 1e6  #: Largest standard deviation of noise, in shares of the limits


def alpha_bar(num_steps: int, beta_start: float, beta_end: float) -> np.ndarray:
    """``(num_steps,)`` cumulative products of ``1 - beta``, for steps ``i = 1`` to ``num_steps``.

    They are a property of the fraction of steps done: 100 variances ``beta`` rise linearly, and for another number of
    steps the cumulative product is interpolated (paper, section III-B and appendix, "Noise Schedule").
    """
    cumulative = np.cumprod(1 - np.linspace(beta_start, beta_end, REFERENCE_STEPS))
    values = np.concatenate([[1.0], cumulative, cumulative[-1:]])
    # Not numpy.interp, in which compilers may fuse a multiplication with an addition.
    whole, rest = np.divmod(np.arange(1, num_steps + 1) * REFERENCE_STEPS, num_steps)
    return values[whole] + (values[whole + 1] - values[whole]) * (rest / num_steps)


def annealed(num_steps: int, beta_start: float, beta_end: float) -> FloatArray:
    """``(num_steps,)`` deviations ``sqrt(1 / alpha_bar - 1)``, first step to last (paper, Algorithm 1, line 3)."""
    return np.sqrt(1 / alpha_bar(num_steps, beta_start, beta_end)[::-1] - 1).astype(np.float32)


def constant(num_steps: int, sigma: float) -> FloatArray:
    """``(num_steps,)`` equal standard deviations, as in MPPI."""
    return np.full(num_steps, sigma, np.float32)


Credit = Annotated[str, one_of(("team", "robot", "alternate", "group"))]
Cutoff = Annotated[NotNegative, Field(lt=1)]

PAPER = {
    "num_samples": 1024,
    "num_steps": 100,
    "weight_cutoff": 0.0,
    "clip_between_iterations": False,
    "short_paths": False,
    "final_approach": False,
}
"""Settings that the paper's experiments share (section IV-B)."""


@dataclass(frozen=True, kw_only=True)
class SamplingConfig(PlannerConfig):
    """Settings of every sampling planner."""

    num_samples: Samples = 1024  #: ``M``, trajectories per step
    num_steps: Steps = 100  #: ``N``, steps per iteration
    #: ``"team"`` weights samples by the team's mean reward, as in the paper; ``"robot"`` weights each robot's part of a
    #: sample by the robot's own reward, which keeps the signal from diluting with the number of robots; ``"alternate"``
    #: does the second in the first iteration, the first in the next, and so on; ``"group"`` weights by the reward of
    #: those that a robot was in conflict with, directly or by others, in the last plan
    credit: Credit = "team"
    #: Factor of the problem's collision penalty, 1 in the paper. A robot's own reward leaves out what contact costs the
    #: other, so that driving through can be cheaper than yielding; 2 makes up for that.
    penalty: Positive = 1.0
    #: Whether it is taken for every robot that a robot is too close to, as in the authors' published code, rather than
    #: once, as in the paper. All obstacles together count once.
    penalty_per_pair: bool = False
    #: Whether robots whose paths are all short next to their size are sampled over the steps that evading each other
    #: takes, by rewards that make up for the shortness (:func:`d4orm_planners.sampling.loop.on_short_paths`). The paper
    #: always samples all steps.
    short_paths: bool = True
    #: Whether robots that must slow down to dock (:attr:`~d4orm_env.core.problem.Problem.goal_speed`), or turn to goal
    #: headings, turn straight to their goals after an iteration, and brake there, where that makes nothing worse.
    #: Samples hardly ever stop anywhere. The paper's robots need not.
    final_approach: bool = True


@dataclass(frozen=True, kw_only=True)
class SoftmaxSettings(CheckedSettings):
    """Settings of methods that weight samples by a softmax."""

    temperature: Positive = 0.3  #: ``lambda`` of the softmax over normalised rewards
    weight_cutoff: Cutoff = 1e-3  #: Softmax weights below this share of the largest count as zero

    @property
    def weights(self) -> SoftmaxWeights:
        return SoftmaxWeights(self.temperature, self.weight_cutoff)


@dataclass(frozen=True, kw_only=True)
class DiffusionSettings(CheckedSettings):
    """Settings of methods whose noise follows the diffusion schedule; ValueError if the first is above the last."""

    beta_start: Variance = 1e-4  #: First variance of the diffusion schedule
    beta_end: Variance = 2e-2  #: Last variance of the diffusion schedule

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.beta_start > self.beta_end:
            raise ValueError(f"beta_start {self.beta_start:g} is above beta_end {self.beta_end:g}; swap them")
        if (most := float(annealed(REFERENCE_STEPS, self.beta_start, self.beta_end)[0])) > MOST_NOISE:
            raise ValueError(f"beta_end is {self.beta_end:g}, with noise of {most:.2g} times the limits; give less")

    def noise_scale(self, num_steps: int) -> FloatArray:
        """``(num_steps,)`` standard deviations, from the first denoising step to the last."""
        return annealed(num_steps, self.beta_start, self.beta_end)


@dataclass(frozen=True, kw_only=True)
class ContinuationSettings(CheckedSettings):
    """Settings of methods whose iterations go on from the last one's controls."""

    #: Start the next iteration from the controls as executed, inside the limits, rather than as the last one left them.
    #: Either way they are zero after arrival.
    clip_between_iterations: bool = False

    def continued(self, candidate: Candidate) -> FloatArray:
        """``(H, K, m)`` controls of the last iteration for the next one to start from."""
        return candidate.controls if self.clip_between_iterations else candidate.planned


@dataclass(frozen=True, kw_only=True)
class DenoisingConfig(SoftmaxSettings, DiffusionSettings, SamplingConfig):
    """Settings of the denoising methods: MBD, i-MBD and D4orm."""
