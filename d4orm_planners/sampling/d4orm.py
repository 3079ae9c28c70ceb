"""D4orm: iterative deformation of a team's controls by denoising (paper, section III-D, Algorithm 2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.team import Team
from d4orm_planners.base.settings import Positive, Samples, Share, ShareOrNone, Steps
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.sampling_types import SamplingTask
from d4orm_planners.sampling.loop import DenoisingPlanner, standard_normal
from d4orm_planners.sampling.settings import PAPER, TUNED, ContinuationSettings, Credit, DenoisingConfig

FALLBACK_PERIOD, FALLBACK_SAMPLE_FACTOR = 8, 4
"""Iterations without a solution after which ``"alternate"`` weights by the team's reward for as many, in turn, and the
factor of its number of samples meanwhile."""

PAPER_DEFORMATION = {**PAPER, "credit": "team", "penalty": 1.0, "late_samples": 1.0, "random_start": False}

AUTHORS_DEFORMATION = {**PAPER_DEFORMATION, "penalty_per_pair": True}
"""The same as in the code that the paper's authors published (proroklab/d4orm, 8ea43d73)."""


@dataclass(frozen=True, kw_only=True)
class DeformationConfig(ContinuationSettings, DenoisingConfig):
    """Settings of planners that deform controls. The defaults are meant for a first solution soon."""

    num_samples: Samples = 256
    num_steps: Steps = 100
    #: ``"group"`` by default: each robot's own reward at first, then that of those it is in conflict with.
    #: ``"alternate"`` goes on by the team's reward after its first iteration, and every other one.
    credit: Credit = "group"
    penalty: Positive = 2.0  #: 2 by default, for the two that touch
    #: True by default: with the default's credit that solves slightly sooner. The paper clips in the rollout only.
    clip_between_iterations: bool = True
    late_steps: ShareOrNone = 0.7  #: Share of the steps, the last, with so little noise that fewer samples do
    late_samples: Share = 0.5  #: Share of the samples that these steps draw
    #: Start every deformation from ``U_N ~ N(0, I)``, as Algorithm 1 is written, rather than from zero. The code that
    #: the paper's authors published starts from zero, and so does the preset: it solves more.
    random_start: bool = False


class DeformingPlanner(DenoisingPlanner):
    """A planner that denoises a change of the team's controls and adds it to them."""

    config: DeformationConfig

    def stages(self, search: SolveRun) -> list[tuple[FloatArray, int]]:
        noise_scale, num_samples = self.noise_scale(), self.num_samples(search)
        early = len(noise_scale) - round(self.config.late_steps * len(noise_scale))
        fewer = max(2, round(self.config.late_samples * num_samples))
        if fewer == num_samples:
            return [(noise_scale, num_samples)]
        parts = [(noise_scale[:early], num_samples), (noise_scale[early:], fewer)]
        return [(scale, samples) for scale, samples in parts if len(scale)]

    def initial(self, search: SolveRun) -> tuple[FloatArray, FloatArray]:
        base = self.config.continued(search.current)
        return base, self.start(search, base, search.problem.team)

    def start(self, search: SolveRun, base: FloatArray, team: Team, number: int = 0) -> FloatArray:
        """``U_N`` of a deformation of ``base``, a team's controls, as a mean to draw samples around, in its shape.

        ``number`` tells the deformations of one iteration apart.
        """
        if not self.config.random_start:
            return np.zeros_like(base)
        return self.first_mean(standard_normal(search, team, len(base), number))


@dataclass(frozen=True, kw_only=True)
class D4ormConfig(DeformationConfig):
    """Settings of D4orm; the preset ``"paper"`` has the paper's."""


class D4orm(DeformingPlanner):
    """Iterative deformation: denoise a change of the team's controls and add it to them, until everyone passes."""

    name: ClassVar[str] = "d4orm"
    config_class = D4ormConfig
    presets: ClassVar = {
        "paper": PAPER_DEFORMATION,
        "authors": AUTHORS_DEFORMATION,
        "tuned": {**PAPER_DEFORMATION, **TUNED["d4orm"]},
    }
    config: D4ormConfig

    def task(self, search: SolveRun, base: FloatArray) -> SamplingTask:
        task = super().task(search, base)
        return replace(task, credit="team") if self.in_fallback(search) else task

    def num_samples(self, search: SolveRun) -> int:
        samples = self.config.num_samples
        return FALLBACK_SAMPLE_FACTOR * samples if self.in_fallback(search) else samples

    def stages(self, search: SolveRun) -> list[tuple[FloatArray, int]]:
        if self.in_fallback(search):
            return [(self.noise_scale(), self.num_samples(search))]
        return super().stages(search)

    def in_fallback(self, search: SolveRun) -> bool:
        """True if ``"alternate"`` has stagnated, and draws more samples for the team's reward."""
        alternating = self.config.credit == "alternate"
        return alternating and search.iteration // FALLBACK_PERIOD % 2 == 1 and not search.best.solved
