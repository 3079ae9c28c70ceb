"""Model-based diffusion of the whole team's controls, once and restarted (paper, sections III-C and IV-A)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.base.settings import Count, Steps
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.sampling.loop import DenoisingPlanner, standard_normal
from d4orm_planners.sampling.settings import PAPER, ContinuationSettings, DenoisingConfig
from d4orm_planners.sampling.tuned import TUNED


@dataclass(frozen=True, kw_only=True)
class MBDConfig(DenoisingConfig):
    """Settings of model-based diffusion: one run of many steps."""

    num_steps: Steps = 10_000
    max_iterations: Count = 1


class MBD(DenoisingPlanner):
    """Model-based diffusion: one denoising run of the controls, from pure noise (paper, Algorithm 1)."""

    name: ClassVar[str] = "mbd"
    config_class: ClassVar[type[DenoisingConfig]] = MBDConfig
    presets: ClassVar = {"paper": {**PAPER, "num_steps": 10_000}, "tuned": {**PAPER, **TUNED["mbd"]}}

    def initial(self, search: SolveRun) -> tuple[FloatArray, FloatArray]:
        """See :meth:`SamplingPlanner.initial`: the controls themselves are denoised, not a deformation."""
        return np.zeros_like(search.current.controls), self.first_mean(self.noisy_controls(search))

    def noisy_controls(self, search: SolveRun) -> FloatArray:
        """``U_N`` of this iteration, ``(H, K, m)``."""
        return standard_normal(search, search.problem.team, search.problem.horizon)


@dataclass(frozen=True, kw_only=True)
class IterativeMBDConfig(ContinuationSettings, DenoisingConfig):
    """Settings of i-MBD."""


class IterativeMBD(MBD):
    """i-MBD: model-based diffusion restarted from its last result as if that were noise (paper, section IV-A)."""

    name: ClassVar[str] = "i-mbd"
    config_class = IterativeMBDConfig
    presets: ClassVar = {"paper": PAPER, "tuned": {**PAPER, **TUNED["i-mbd"]}}
    config: IterativeMBDConfig

    def noisy_controls(self, search: SolveRun) -> FloatArray:
        """The last result, or noise in the first iteration."""
        return self.config.continued(search.current) if search.iteration else super().noisy_controls(search)
