"""Rivals of D4orm: MPPI, the cross-entropy method, and model-based diffusion of the whole team's controls."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType
from typing import ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.settings import Count, Positive, Share, ShareOrNone, Steps
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.sampling_types import SamplingRules
from d4orm_planners.sampling.loop import DenoisingPlanner, NextStep, SamplingPlanner, standard_normal
from d4orm_planners.sampling.settings import (
    PAPER,
    TUNED,
    Array,
    ContinuationSettings,
    DenoisingConfig,
    EliteWeights,
    SamplingConfig,
    SoftmaxSettings,
    constant,
)


class GaussianPlanner(SamplingPlanner):
    """A planner that samples around the last controls, with the same noise at every step."""

    config: MPPIConfig | CEMConfig

    def noise_scale(self) -> FloatArray:
        return constant(self.config.num_steps, self.config.sigma)

    def initial(self, search: SolveRun) -> tuple[FloatArray, FloatArray]:
        base = self.config.continued(search.current)
        return base, np.zeros_like(base)


@dataclass(frozen=True, kw_only=True)
class MPPIConfig(SoftmaxSettings, ContinuationSettings, SamplingConfig):
    """Settings of MPPI."""

    sigma: Positive = 1.0  #: Standard deviation of the samples, the same at every step
    #: Share, from 0 to 1, of the importance-sampling term: a sample weighs the less the more it adds to the controls
    #: that it was drawn around. In the high dimensions of a team the whole term leaves next to nothing of most samples
    #: (the paper calls it unstable and does without).
    importance: ShareOrNone = 0.0


class MPPI(GaussianPlanner):
    """Model predictive path integral control: softmax updates under a fixed covariance (paper, Eq. 11).

    The importance-sampling term is left out unless asked for, as in the paper's comparison.
    """

    name: ClassVar[str] = "mppi"
    config_class = MPPIConfig
    presets: ClassVar = {"paper": PAPER, "tuned": {**PAPER, **TUNED["mppi"]}}
    config: MPPIConfig

    def rules(self) -> SamplingRules:
        return SamplingRules(self.config.weights, importance=self.config.importance)


@dataclass(frozen=True, kw_only=True)
class CEMConfig(ContinuationSettings, SamplingConfig):
    """Settings of the cross-entropy method; ValueError if variance is to be carried over that is not adapted."""

    elite_fraction: Share = 0.05  #: Share of samples that are averaged
    sigma: Positive = 1.0  #: Standard deviation of the samples of an iteration's first step
    adapt_variance: bool = False  #: Let the variance follow that of the elite, as the method is usually written
    sigma_floor: Positive = 0.05  #: Smallest standard deviation that the adaptation may reach
    carry_variance: bool = False  #: An iteration begins with the last one's variance, as in the authors' published code

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.carry_variance and not self.adapt_variance:
            raise ValueError("carry_variance is True, but the variance stays as it is; set adapt_variance=True")


@dataclass(frozen=True)
class EliteDeviation:
    """Noise factors from the spread of the elite, relative to ``sigma`` and not below ``floor``."""

    sigma: float
    floor: float

    def __call__(self, mean_square_deviation: Array, xp: ModuleType) -> Array:
        """``(H, K, m)`` factors on the schedule."""
        return xp.maximum(xp.sqrt(xp.maximum(mean_square_deviation, 0)), self.floor) / self.sigma


class CEM(GaussianPlanner):
    """The cross-entropy method: the mean of the elite samples is the next mean (paper, appendix B)."""

    name: ClassVar[str] = "cem"
    config_class = CEMConfig
    presets: ClassVar = {
        "paper": PAPER,
        "authors": {
            **PAPER,
            "penalty_per_pair": True,
            "adapt_variance": True,
            "sigma_floor": 0.1,
            "carry_variance": True,
        },
        "tuned": {**PAPER, **TUNED["cem"]},
    }
    config: CEMConfig

    def rules(self) -> SamplingRules:
        config = self.config
        adapt = EliteDeviation(config.sigma, config.sigma_floor) if config.adapt_variance else None
        return SamplingRules(weights=EliteWeights(config.elite_fraction), adapt=adapt)

    def iterate(self, search: SolveRun, state: NextStep | None) -> tuple[NextStep, Iteration]:
        base, mean = self.initial(search)
        task = self.task(search, base)
        if self.config.carry_variance and state is not None:
            task = replace(task, noise_factor=state.noise_factor)
        iteration, following = self.sampled(search, task, self.credited(search), mean, self.stages(search))
        return following, iteration


class ControlDenoiser(DenoisingPlanner):
    """A planner that denoises the controls themselves, not a deformation."""

    def initial(self, search: SolveRun) -> tuple[FloatArray, FloatArray]:
        return np.zeros_like(search.current.controls), self.first_mean(self.noisy_controls(search))

    def noisy_controls(self, search: SolveRun) -> FloatArray:
        """``U_N`` of this iteration, ``(H, K, m)``."""
        return standard_normal(search, search.problem.team, search.problem.horizon)


@dataclass(frozen=True, kw_only=True)
class MBDConfig(DenoisingConfig):
    """Settings of model-based diffusion: one run of many steps."""

    num_steps: Steps = 10_000
    max_iterations: Count = 1
    check_every: Steps | None = None  #: Steps after which a run's controls are evaluated; ``None`` for all


@dataclass(frozen=True, eq=False)
class Part:
    """A run that is under way."""

    mean: FloatArray  #: ``(H, K, m)`` mean of the next step's samples
    done: int  #: Steps done


class MBD(ControlDenoiser):
    """Model-based diffusion: one denoising run of the controls, from pure noise (paper, Algorithm 1)."""

    name: ClassVar[str] = "mbd"
    config_class: ClassVar[type[DenoisingConfig]] = MBDConfig
    # The paper evaluates the trajectory every 100 steps.
    presets: ClassVar = {
        "paper": {**PAPER, "num_steps": 10_000, "check_every": 100, "max_iterations": 100},
        "tuned": {**PAPER, **TUNED["mbd"]},
    }
    config: MBDConfig

    def iterate(self, search: SolveRun, state: Part | None) -> tuple[Part, Iteration]:
        """See :meth:`Planner.iterate`: the next part of a run, or the first of another."""
        base, mean = self.initial(search)
        done = 0
        if state is not None and state.done < self.config.num_steps:
            mean, done = state.mean, state.done
        end = min(done + (self.config.check_every or self.config.num_steps), self.config.num_steps)
        stages = [(self.noise_scale()[done:end], self.config.num_samples)]
        iteration, following = self.sampled(search, self.task(search, base), self.credited(search), mean, stages)
        return Part(following.mean, end), iteration


@dataclass(frozen=True, kw_only=True)
class IterativeMBDConfig(ContinuationSettings, DenoisingConfig):
    """Settings of i-MBD."""


class IterativeMBD(ControlDenoiser):
    """i-MBD: model-based diffusion restarted from its last result as if that were noise (paper, section IV-A)."""

    name: ClassVar[str] = "i-mbd"
    config_class = IterativeMBDConfig
    presets: ClassVar = {"paper": PAPER, "tuned": {**PAPER, **TUNED["i-mbd"]}}
    config: IterativeMBDConfig

    def noisy_controls(self, search: SolveRun) -> FloatArray:
        """The last result, or noise in the first iteration."""
        return self.config.continued(search.current) if search.iteration else super().noisy_controls(search)
