"""``d4orm robustness``: ``d4orm evaluate`` at several levels of noise, with a picture of success against noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from d4orm_planners.commands.dataclass_options import takes
from d4orm_planners.commands.evaluate import Noise, Out, StudyOptions, require_trials
from d4orm_planners.commands.inputs import MOST_SEEDS


@dataclass(frozen=True, kw_only=True)
class RobustnessOptions(StudyOptions):
    """Those of ``d4orm robustness``."""

    noise: Noise = "0,0.05,0.1,0.2"
    out: Out = Path("robustness")
    trials: Annotated[
        int, typer.Option("--trials", "-n", max=MOST_SEEDS, help="Trials per policy and level of noise.")
    ] = 50


@takes(RobustnessOptions)
def robustness(options: RobustnessOptions) -> None:
    """Measure how often policies succeed when their controls are executed with noise."""
    from d4orm_env.core.arrays import whole_number
    from d4orm_planners.commands.progress import tell_results
    from d4orm_planners.evaluation.report import robustness_markdown, write_robustness

    rates = options.run(range(whole_number(options.trials, "trials", 1)))
    written = write_robustness(options.out, rates)
    if not options.quiet:
        tell_results(robustness_markdown(rates), written)
    require_trials(rates)
