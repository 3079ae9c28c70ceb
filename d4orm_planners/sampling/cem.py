"""The cross-entropy method for the whole team (paper, appendix B)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType
from typing import ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.settings import Positive, Share
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.sampling_types import SamplingRules
from d4orm_planners.sampling.loop import NextStep, SamplingPlanner
from d4orm_planners.sampling.settings import PAPER, TUNED, ContinuationSettings, SamplingConfig, constant
from d4orm_planners.sampling.weights import Array, EliteWeights


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


class CEM(SamplingPlanner):
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

    def noise_scale(self) -> FloatArray:
        return constant(self.config.num_steps, self.config.sigma)

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

    def initial(self, search: SolveRun) -> tuple[FloatArray, FloatArray]:
        base = self.config.continued(search.current)
        return base, np.zeros_like(base)
