"""D4orm: iterative deformation of a team's controls by denoising (paper, section III-D, Algorithm 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.engine.base import SamplingRules
from d4orm_planners.base import Search
from d4orm_planners.sampling.optimizer import SamplingConfig, SamplingPlanner, standard_normal
from d4orm_planners.sampling.schedule import alpha_bar, annealed
from d4orm_planners.sampling.weights import SoftmaxWeights


@dataclass(frozen=True, kw_only=True)
class D4ormConfig(SamplingConfig):
    """Settings of D4orm.

    Attributes:
        credit: Per-robot weights by default; see :class:`SamplingConfig`.
        random_start: Start every deformation from ``U_N ~ N(0, I)``, as Algorithm 1 is written, rather than from zero.
    """

    credit: str = "robot"
    random_start: bool = False


class D4orm(SamplingPlanner):
    """Each iteration denoises a deformation of the current controls and adds it to them."""

    name: ClassVar[str] = "d4orm"
    config_class = D4ormConfig
    presets: ClassVar[dict[str, dict[str, Any]]] = {"paper": {"credit": "team", "random_start": True}}

    def noise_scale(self) -> FloatArray:
        """See :meth:`SamplingPlanner.noise_scale`."""
        return annealed(self.config.num_steps, self.config.beta_start, self.config.beta_end)

    def rules(self) -> SamplingRules:
        """See :meth:`SamplingPlanner.rules`."""
        return SamplingRules(weights=SoftmaxWeights(float(self.config.temperature)))

    def initial(self, search: Search) -> tuple[FloatArray, FloatArray]:
        """See :meth:`SamplingPlanner.initial`."""
        base = search.current.controls
        if not self.config.random_start:
            return base, np.zeros_like(base)
        final = alpha_bar(self.config.num_steps, self.config.beta_start, self.config.beta_end)[-1]
        return base, standard_normal(search, stream=1) / np.float32(np.sqrt(final))
