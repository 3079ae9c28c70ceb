"""The loop that MPPI, CEM, MBD, i-MBD and D4orm share: propose, sample and score, weight, update (paper, Algorithm 1).

After every step the new mean is the weighted mean of the samples. For the denoising methods this is Algorithm 1
exactly: substituting the score estimate of line 5 into line 6 gives ``U_{i-1} = sqrt(alpha_bar_{i-1}) * U_bar``, and
line 3 of the next step samples around ``U_{i-1} / sqrt(alpha_bar_{i-1}) = U_bar``. A method is therefore a schedule of
standard deviations, a rule for the weights, and where an iteration starts.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.seeds import Stream
from d4orm_env.engine.base import SamplingRules, SamplingTask
from d4orm_planners.base import Iteration, Planner, PlannerConfig, Search
from d4orm_planners.sampling.weights import SoftmaxWeights
from d4orm_planners.settings import NotNegative, Positive, Samples, Steps, Variance, one_of

Credit = Annotated[str, one_of(("team", "robot", "alternate"))]
Cutoff = Annotated[NotNegative, Field(lt=1)]


@dataclass(frozen=True, kw_only=True)
class SamplingConfig(PlannerConfig):
    """Settings of the sampling planners.

    Attributes:
        num_samples: ``M``, trajectories per step.
        num_steps: ``N``, steps per iteration.
        temperature: ``lambda`` of the softmax over normalised rewards.
        weight_cutoff: Softmax weights below this share of the largest count as zero.
        beta_start: First variance of the diffusion schedule.
        beta_end: Last variance of the diffusion schedule.
        credit: ``"team"`` weights samples by the team's mean reward, as in the paper; ``"robot"`` weights each robot's
            part of a sample by the robot's own reward, which keeps the signal from diluting with the number of robots;
            ``"alternate"`` does the second in the first iteration, the first in the next, and so on.
        clip_between_iterations: Start the next iteration from the controls as executed, inside the limits, rather than
            as the last one left them. Either way they are zero once docked.
    """

    num_samples: Samples = 1024
    num_steps: Steps = 100
    temperature: Positive = 0.3
    weight_cutoff: Cutoff = 1e-3
    beta_start: Variance = 1e-4
    beta_end: Variance = 2e-2
    credit: Credit = "team"
    clip_between_iterations: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.beta_start > self.beta_end:
            raise ValueError(f"beta_start {self.beta_start:g} is above beta_end {self.beta_end:g}; swap them")


PAPER = {"num_samples": 1024, "num_steps": 100, "weight_cutoff": 0.0, "clip_between_iterations": False}
"""What the paper's experiments share (section IV-B)."""


class SamplingPlanner(Planner):
    """A planner whose iteration is one run of the sampling loop over the whole team."""

    config: Any

    @abstractmethod
    def noise_scale(self) -> FloatArray:
        """``(N,)`` standard deviation of the samples at every step of an iteration."""

    def rules(self) -> SamplingRules:
        """The method's weights, and how it adapts its noise: the softmax, unless a method says otherwise."""
        return SamplingRules(weights=SoftmaxWeights(self.config.temperature, self.config.weight_cutoff))

    @abstractmethod
    def initial(self, search: Search) -> tuple[FloatArray, FloatArray]:
        """``(base, mean)``, each ``(H, K, m)``: samples are drawn around ``mean`` on top of ``base``."""

    def base(self, search: Search) -> FloatArray:
        """``(H, K, m)`` controls of the last iteration for this one to start from."""
        current = search.current
        return current.controls if self.config.clip_between_iterations else current.planned

    def task(self, search: Search, base: FloatArray) -> SamplingTask:
        """What this iteration samples and scores."""
        credit = self.config.credit
        if credit == "alternate":
            credit = "team" if search.iteration % 2 else "robot"
        return SamplingTask(search.problem, base, credit=credit)

    def num_samples(self, search: Search) -> int:
        """``M`` of this iteration."""
        del search
        return int(self.config.num_samples)

    def stages(self, search: Search) -> list[tuple[FloatArray, int]]:
        """The steps of an iteration, in parts that each have their number of samples: ``(noise scale, M)``."""
        return [(self.noise_scale(), self.num_samples(search))]

    def iterate(self, search: Search) -> Iteration:
        """See :meth:`Planner.iterate`."""
        base, mean = self.initial(search)
        task, rules = self.task(search, base), self.rules()
        num_steps = excluded = 0
        for stage, (noise_scale, num_samples) in enumerate(self.stages(search)):
            seed = search.iteration_seed(Stream.SAMPLES, stage)
            result = search.denoise(task, rules, mean, noise_scale, num_samples, seed)
            mean, num_steps, excluded = result.mean, num_steps + len(result.rewards), excluded + result.excluded
        return Iteration(base + mean, num_steps, excluded)


def standard_normal(search: Search, shape: tuple[int, ...], number: int = 0) -> FloatArray:
    """Standard normal numbers in this shape for the start of a run of this iteration."""
    generator = np.random.default_rng(search.iteration_seed(Stream.DEFORMATION_START, number))
    return portable.standard_normal(generator, shape)
