"""Model-based diffusion of the whole team's controls, once and restarted (paper, sections III-C and IV-A)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.settings import Count, Steps
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.sampling.loop import DenoisingPlanner, standard_normal
from d4orm_planners.sampling.settings import PAPER, TUNED, ContinuationSettings, DenoisingConfig


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
