"""MPPI: model predictive path integral control of the whole team (paper, section IV-A, Eq. for the softmax update)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.base.settings import Positive, ShareOrNone
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.sampling_types import SamplingRules
from d4orm_planners.sampling.loop import SamplingPlanner
from d4orm_planners.sampling.settings import (
    PAPER,
    TUNED,
    ContinuationSettings,
    SamplingConfig,
    SoftmaxSettings,
    constant,
)


@dataclass(frozen=True, kw_only=True)
class MPPIConfig(SoftmaxSettings, ContinuationSettings, SamplingConfig):
    """Settings of MPPI."""

    sigma: Positive = 1.0  #: Standard deviation of the samples, the same at every step
    #: Share, from 0 to 1, of the importance-sampling term: a sample weighs the less the more it adds to the controls
    #: that it was drawn around. In the high dimensions of a team the whole term leaves next to nothing of most samples
    #: (the paper calls it unstable and does without).
    importance: ShareOrNone = 0.0


class MPPI(SamplingPlanner):
    """Model predictive path integral control: softmax updates under a fixed covariance (paper, Eq. 11).

    The importance-sampling term is left out unless asked for, as in the paper's comparison.
    """

    name: ClassVar[str] = "mppi"
    config_class = MPPIConfig
    presets: ClassVar = {"paper": PAPER, "tuned": {**PAPER, **TUNED["mppi"]}}
    config: MPPIConfig

    def rules(self) -> SamplingRules:
        return SamplingRules(self.config.weights, importance=self.config.importance)

    def noise_scale(self) -> FloatArray:
        return constant(self.config.num_steps, self.config.sigma)

    def initial(self, search: SolveRun) -> tuple[FloatArray, FloatArray]:
        base = self.config.continued(search.current)
        return base, np.zeros_like(base)
