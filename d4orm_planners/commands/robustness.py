"""``d4orm robustness``: ``d4orm evaluate`` at several levels of noise, with a picture of success against noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from d4orm_planners.commands.dataclass_options import takes
from d4orm_planners.commands.evaluate import NoiseLevels, Out, StudyOptions, require_trials


@dataclass(frozen=True, kw_only=True)
class RobustnessOptions(StudyOptions):
    """Those of ``d4orm evaluate``, with several levels of noise."""

    control_noise_std: NoiseLevels = "0,0.05,0.1,0.2"
    out: Out = Path("robustness")


@takes(RobustnessOptions)
def robustness(options: RobustnessOptions) -> None:
    """Measure how often policies succeed when their controls are executed with noise."""
    from d4orm_planners.commands.progress import tell_results
    from d4orm_planners.evaluation.report import markdown, write_robustness

    rates = options.run()
    written = write_robustness(options.out, rates)
    if not options.quiet:
        tell_results(markdown(rates), written)
    require_trials(rates)
