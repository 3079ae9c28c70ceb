"""Model-based diffusion of the whole team's controls, once and restarted (paper, sections III-C and IV-A)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.base import Search
from d4orm_planners.sampling.optimizer import PAPER, SamplingConfig, SamplingPlanner, standard_normal
from d4orm_planners.sampling.schedule import alpha_bar, annealed
from d4orm_planners.settings import Count, Steps


class _DirectDenoising(SamplingPlanner):
    """Denoising of the controls themselves, not of a deformation."""

    config_class = SamplingConfig

    def noise_scale(self) -> FloatArray:
        """See :meth:`SamplingPlanner.noise_scale`."""
        return annealed(self.config.num_steps, self.config.beta_start, self.config.beta_end)

    def initial(self, search: Search) -> tuple[FloatArray, FloatArray]:
        """See :meth:`SamplingPlanner.initial`."""
        final = alpha_bar(self.config.num_steps, self.config.beta_start, self.config.beta_end)[-1]
        return np.zeros_like(search.current.controls), self.noisy_controls(search) / np.float32(np.sqrt(final))

    def noisy_controls(self, search: Search) -> FloatArray:
        """``U_N`` of this iteration, ``(H, K, m)``."""
        return standard_normal(search, search.current.controls.shape)


@dataclass(frozen=True, kw_only=True)
class MBDConfig(SamplingConfig):
    """Settings of model-based diffusion: one run of many steps."""

    num_steps: Steps = 10_000
    max_iterations: Count = 1


class MBD(_DirectDenoising):
    """Model-based diffusion: one denoising run of the controls, from pure noise (paper, Algorithm 1)."""

    name: ClassVar[str] = "mbd"
    config_class = MBDConfig
    presets: ClassVar[dict[str, dict[str, Any]]] = {"paper": {**PAPER, "num_steps": 10_000}}


class IterativeMBD(_DirectDenoising):
    """i-MBD: model-based diffusion restarted from its last result as if that were noise (paper, section IV-A)."""

    name: ClassVar[str] = "i-mbd"
    presets: ClassVar[dict[str, dict[str, Any]]] = {"paper": PAPER}

    def noisy_controls(self, search: Search) -> FloatArray:
        """The last result, or noise in the first iteration."""
        return self.base(search) if search.iteration else super().noisy_controls(search)
