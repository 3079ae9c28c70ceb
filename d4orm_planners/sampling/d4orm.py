"""D4orm: iterative deformation of a team's controls by denoising (paper, section III-D, Algorithm 2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.base.planner import Iteration, State
from d4orm_planners.base.settings import Positive, Samples, Share, ShareOrNone, Steps, one_of
from d4orm_planners.base.solve import Search
from d4orm_planners.engine.sampling_types import SamplingTask
from d4orm_planners.mapf.improvement import refined_iteration
from d4orm_planners.mapf.planner import Guide, compile_roadmap, first_ways, guided_iteration, leads_round
from d4orm_planners.sampling.loop import DenoisingPlanner, standard_normal
from d4orm_planners.sampling.settings import PAPER, ContinuationSettings, Credit, DenoisingConfig
from d4orm_planners.sampling.tuned import TUNED

SPELL, PATIENT_SAMPLES = 8, 4
"""Iterations without a solution after which ``"alternate"`` weights by the team's reward for as many, in turn; and how
many times as many samples it draws meanwhile."""

PAPER_DEFORMATION = {
    **PAPER,
    "credit": "team",
    "penalty": 1.0,
    "late_samples": 1.0,
    "shorten": False,
    "start": "team",
    "random_start": False,
}
Start = Annotated[str, one_of(("auto", "team", "guided"))]


@dataclass(frozen=True, kw_only=True)
class D4ormConfig(ContinuationSettings, DenoisingConfig):
    """Settings of D4orm. The defaults are meant for a first solution soon; the preset ``"paper"`` has the paper's.

    Attributes:
        num_samples: ``M``.
        num_steps: ``N``.
        credit: ``"group"`` by default: each robot's own reward at first, then that of those it is in conflict with.
            ``"alternate"`` goes on by the team's reward after its first iteration, and every other one.
        penalty: 2 by default, what a contact costs the two that touch.
        clip_between_iterations: True by default: with the default's credit that solves slightly sooner. The paper clips
            in the rollout only.
        late_steps: Share of the steps, the last ones, at which the noise is small enough for fewer samples.
        late_samples: Share of the samples that these steps draw.
        shorten: Whether, once there is a solution, groups of robots look for faster ways around all others, rather than
            the whole team being deformed again (:mod:`d4orm_planners.mapf`).
        start: What the first iteration does without initial controls. ``"team"`` deforms standing still, as in the
            paper; ``"guided"`` drives on ways found on a roadmap (:mod:`d4orm_planners.mapf`), which later
            iterations deform; ``"auto"`` does the second where obstacles lead somebody far round.
        random_start: Start every deformation from ``U_N ~ N(0, I)``, as Algorithm 1 is written, rather than from zero.
            The code that the paper's authors published starts from zero, and so does the preset: it solves more.
    """

    num_samples: Samples = 256
    num_steps: Steps = 100
    credit: Credit = "group"
    penalty: Positive = 2.0
    clip_between_iterations: bool = True
    late_steps: ShareOrNone = 0.7
    late_samples: Share = 0.5
    shorten: bool = True
    start: Start = "auto"
    random_start: bool = False


class D4orm(DenoisingPlanner):
    """Iterative deformation: denoise a change of the team's controls and add it to them, until everyone passes."""

    name: ClassVar[str] = "d4orm"
    config_class = D4ormConfig
    presets: ClassVar = {"paper": PAPER_DEFORMATION, "tuned": {**PAPER_DEFORMATION, **TUNED["d4orm"]}}
    config: D4ormConfig

    def iterate(self, search: Search, state: State) -> tuple[State, Iteration]:
        """See :meth:`Planner.iterate`."""
        if search.iteration == 0 and self.is_guided(search):
            guide = first_ways(search)
            if isinstance(guide, Guide):
                return state, guided_iteration(search, guide)
        if self.config.shorten and search.best.solved:
            return state, refined_iteration(search)
        return super().iterate(search, state)

    def task(self, search: Search, base: FloatArray) -> SamplingTask:
        """See :meth:`SamplingPlanner.task`."""
        task = super().task(search, base)
        return replace(task, credit="team") if self.is_patient(search) else task

    def num_samples(self, search: Search) -> int:
        """See :meth:`SamplingPlanner.num_samples`."""
        samples = self.config.num_samples
        return PATIENT_SAMPLES * samples if self.is_patient(search) else samples

    def is_patient(self, search: Search) -> bool:
        """Whether it goes on with more patience: what finds its way soonest may never find it among many."""
        hasty = self.config.credit == "alternate"
        return hasty and search.iteration // SPELL % 2 == 1 and not search.best.solved

    def is_guided(self, search: Search) -> bool:
        """Whether the first iteration is to find ways on a roadmap."""
        if search.current.controls.any() or self.config.start not in ("auto", "guided"):
            return False
        if self.config.start == "guided":
            return True
        with search.watch.paused():
            compile_roadmap(search.problem)
        return leads_round(search.problem)

    def stages(self, search: Search) -> list[tuple[FloatArray, int]]:
        """See :meth:`SamplingPlanner.stages`."""
        noise_scale, num_samples = self.noise_scale(), self.num_samples(search)
        if self.is_patient(search):
            return [(noise_scale, num_samples)]
        early = len(noise_scale) - round(self.config.late_steps * len(noise_scale))
        fewer = max(2, round(self.config.late_samples * num_samples))
        if fewer == num_samples:
            return [(noise_scale, num_samples)]
        parts = [(noise_scale[:early], num_samples), (noise_scale[early:], fewer)]
        return [(scale, samples) for scale, samples in parts if len(scale)]

    def initial(self, search: Search) -> tuple[FloatArray, FloatArray]:
        """See :meth:`SamplingPlanner.initial`."""
        base = self.config.continued(search.current)
        return base, self.start(search, base)

    def start(self, search: Search, base: FloatArray, number: int = 0) -> FloatArray:
        """``U_N`` of a deformation of ``base``, as a mean to draw samples around, in the shape of ``base``.

        ``number`` tells the deformations of one iteration apart.
        """
        if not self.config.random_start:
            return np.zeros_like(base)
        return self.first_mean(standard_normal(search, base.shape, number))
