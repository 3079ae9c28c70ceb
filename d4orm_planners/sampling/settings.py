"""Settings of the sampling planners, in the parts of which a planner takes those that mean something to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.base.planner import PlannerConfig
from d4orm_planners.base.settings import CheckedSettings, NotNegative, Positive, Samples, Steps, Variance, one_of
from d4orm_planners.sampling.schedule import annealed
from d4orm_planners.sampling.weights import SoftmaxWeights

Credit = Annotated[str, one_of(("team", "robot", "alternate", "group"))]
Cutoff = Annotated[NotNegative, Field(lt=1)]

PAPER = {
    "num_samples": 1024,
    "num_steps": 100,
    "weight_cutoff": 0.0,
    "clip_between_iterations": False,
    "short_paths": False,
    "final_approach": False,
}
"""Settings that the paper's experiments share (section IV-B)."""


@dataclass(frozen=True, kw_only=True)
class SamplingConfig(PlannerConfig):
    """Settings of every sampling planner.

    Attributes:
        num_samples: ``M``, trajectories per step.
        num_steps: ``N``, steps per iteration.
        credit: ``"team"`` weights samples by the team's mean reward, as in the paper; ``"robot"`` weights each robot's
            part of a sample by the robot's own reward, which keeps the signal from diluting with the number of robots;
            ``"alternate"`` does the second in the first iteration, the first in the next, and so on; ``"group"``
            weights by the reward of those that a robot was in conflict with, directly or by others, in the last plan.
        penalty: Factor of the problem's collision penalty, 1 in the paper. A robot's own reward does not tell what
            touching it costs the other, so that going through can be cheaper than making way; 2 makes up for that.
        penalty_per_pair: Whether it is taken for every robot that a robot is too close to, as in the authors' published
            code, rather than once, as in the paper. All obstacles together count once.
        short_paths: Whether robots whose paths are all short next to their size are sampled over the steps that evading
            each other takes, by rewards that make up for the shortness (:mod:`d4orm_planners.sampling.short_paths`).
            The paper always samples all steps.
        final_approach: Whether robots that must slow down to dock
            (:attr:`~d4orm_env.core.problem.Problem.goal_speed`) turn straight to their goals after an iteration, and
            brake there, where that makes nothing worse. Samples hardly ever stop anywhere. The paper's robots need not.
    """

    num_samples: Samples = 1024
    num_steps: Steps = 100
    credit: Credit = "team"
    penalty: Positive = 1.0
    penalty_per_pair: bool = False
    short_paths: bool = True
    final_approach: bool = True


@dataclass(frozen=True, kw_only=True)
class SoftmaxSettings(CheckedSettings):
    """Settings of methods that weight samples by a softmax.

    Attributes:
        temperature: ``lambda`` of the softmax over normalised rewards.
        weight_cutoff: Softmax weights below this share of the largest count as zero.
    """

    temperature: Positive = 0.3
    weight_cutoff: Cutoff = 1e-3

    @property
    def weights(self) -> SoftmaxWeights:
        """The rule."""
        return SoftmaxWeights(self.temperature, self.weight_cutoff)


@dataclass(frozen=True, kw_only=True)
class DiffusionSettings(CheckedSettings):
    """Settings of methods whose noise follows the diffusion schedule.

    Attributes:
        beta_start: First variance of the diffusion schedule.
        beta_end: Last variance of the diffusion schedule.

    Raises:
        ValueError: If the first is above the last.
    """

    beta_start: Variance = 1e-4
    beta_end: Variance = 2e-2

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.beta_start > self.beta_end:
            raise ValueError(f"beta_start {self.beta_start:g} is above beta_end {self.beta_end:g}; swap them")

    def noise_scale(self, num_steps: int) -> FloatArray:
        """``(num_steps,)`` standard deviations, from the first denoising step to the last."""
        return annealed(num_steps, self.beta_start, self.beta_end)


@dataclass(frozen=True, kw_only=True)
class ContinuationSettings(CheckedSettings):
    """Settings of methods whose iterations go on from the last one's controls.

    Attributes:
        clip_between_iterations: Start the next iteration from the controls as executed, inside the limits, rather than
            as the last one left them. Either way they are zero once docked.
    """

    clip_between_iterations: bool = False

    def continued(self, candidate: Candidate) -> FloatArray:
        """``(H, K, m)`` controls of the last iteration for the next one to start from."""
        return candidate.controls if self.clip_between_iterations else candidate.planned


@dataclass(frozen=True, kw_only=True)
class DenoisingConfig(SoftmaxSettings, DiffusionSettings, SamplingConfig):
    """Settings of the denoising methods: MBD, i-MBD and D4orm."""
