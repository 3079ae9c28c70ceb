"""``d4orm robustness``: ``d4orm evaluate`` at several levels of every disturbance, or of those that are named."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from d4orm_planners.cli.dataclass_options import takes
from d4orm_planners.cli.evaluate_command import NoiseLevels, Out, StudyOptions, report, require_trials
from d4orm_planners.evaluation.robustness import write_robustness

STANDARD = (
    "control_noise=0,0.1,0.2,0.3",
    "correlated_noise=0,0.1,0.2,0.3",
    "bias=0,0.05,0.1,0.2",
    "delay=0,1,2,4",
    "dropout=0,0.1,0.3,0.5",
    "gain=0,0.1,0.2,0.4",
    "state_noise=0,0.01,0.02,0.05",
    "state_delay=0,1,2,4",
    "push.speed=0,0.2,0.3,0.5",
    "stall=0,0.1,0.3",
    "intruder=0,1,2",
    "limit_mismatch=1,0.9,0.8,0.7",
)
"""Levels that are run where none are named, from harmless to bad; all robot models have these disturbances."""


@dataclass(frozen=True, kw_only=True)
class RobustnessOptions(StudyOptions):
    """Options of ``d4orm evaluate``; without levels of noise or disturbances :data:`STANDARD`."""

    control_noise_std: NoiseLevels = None
    out: Out = Path("robustness")


@takes(RobustnessOptions)
def robustness(options: RobustnessOptions) -> None:
    """Measure how often policies succeed when something goes wrong: noise, delays, pushes and others."""
    if options.control_noise_std is None and options.disturb is None:
        options = replace(options, disturb=list(STANDARD))
    rates, _ = report(options, write_robustness)
    require_trials(rates)
