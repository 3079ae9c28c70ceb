"""MPPI: model predictive path integral control of the whole team (paper, section IV-A, Eq. for the softmax update)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray, positive_number
from d4orm_planners.base import Search
from d4orm_planners.sampling.optimizer import PAPER, SamplingConfig, SamplingPlanner
from d4orm_planners.sampling.schedule import constant


@dataclass(frozen=True, kw_only=True)
class MPPIConfig(SamplingConfig):
    """Settings of MPPI; the betas do not apply.

    Attributes:
        sigma: Standard deviation of the samples, the same at every step.
    """

    sigma: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        positive_number(self.sigma, "sigma")


class MPPI(SamplingPlanner):
    """Model predictive path integral control: softmax updates under a fixed covariance (paper, Eq. 11).

    The importance-sampling term is left out, as in the paper's comparison.
    """

    name: ClassVar[str] = "mppi"
    config_class = MPPIConfig
    presets: ClassVar[dict[str, dict[str, Any]]] = {"paper": PAPER}

    def noise_scale(self) -> FloatArray:
        """See :meth:`SamplingPlanner.noise_scale`."""
        return constant(self.config.num_steps, self.config.sigma)

    def initial(self, search: Search) -> tuple[FloatArray, FloatArray]:
        """See :meth:`SamplingPlanner.initial`."""
        return search.current.controls, np.zeros_like(search.current.controls)
