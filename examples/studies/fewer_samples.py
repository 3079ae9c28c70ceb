"""Cost of D4orm's first solution with fewer steps, fewer samples, or fewer of these while the noise is small.

    python -m examples.studies.fewer_samples --seeds 50 --out fewer_samples

8 and 16 robots on the circle, at most 8 iterations. The table has success with its 95% interval (Wilson), the samples
drawn until the first solution (median and quartiles; a trial without one counts twice the budget), the mean travel time
of the solutions, and how likely it is that a row and the defaults need equally many (Wilcoxon, paired by seed).
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from examples.outputs import save_table, study_trials, trials_parser
from examples.studies import AS_IN_THE_PAPER

from d4orm_planners.evaluation.comparison import is_solved, paired, penalised_steps
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.study import Study
from d4orm_planners.evaluation.summary import wilson_interval

TEAMS, ITERATIONS = (8, 16), 8
FIRST_SEED = 1000
"""No default was chosen by the seeds from here on."""
DEFAULT = "100 x 256, the last 70% with 128 (default)"
ALIKE: dict[str, Any] = {"late_samples": 1.0}
SETTINGS: dict[str, dict[str, Any]] = {
    "100 x 1024": {**ALIKE, "num_samples": 1024},
    "100 x 256": ALIKE,
    "100 x 128": {**ALIKE, "num_samples": 128},
    "70 x 256": {**ALIKE, "num_steps": 70},
    "50 x 256": {**ALIKE, "num_steps": 50},
    "50 x 512": {**ALIKE, "num_steps": 50, "num_samples": 512},
    "100 x 256, the last 40% with 128": {"late_steps": 0.4},
    "100 x 256, the last 40% with 64": {"late_steps": 0.4, "late_samples": 0.25},
    DEFAULT: {},
    "100 x 256, the last 70% with 64": {"late_samples": 0.25},
}


def samples_per_step(trial: Trial) -> float:
    """Return the samples of every step, on average."""
    config = json.loads(trial.config)
    return float(config["num_samples"] * (1 - config["late_steps"] * (1 - config["late_samples"])))


def cost(trial: Trial) -> float:
    """Samples until the first solution, twice the budget without one."""
    return penalised_steps(trial) * samples_per_step(trial)


def rows_of(num_robots: int, groups: dict[str, list[Trial]]) -> list[dict[str, Any]]:
    """A row per setting."""
    rows = []
    for label, trials in groups.items():
        solved = sum(map(is_solved, trials))
        lower, upper = wilson_interval(solved, len(trials))
        quartiles = np.percentile([cost(trial) for trial in trials], (25, 50, 75)) / 1000
        travel = [trial.travel_time for trial in trials if is_solved(trial) and trial.travel_time is not None]
        rows.append(
            {"robots": num_robots, "steps x samples": label, "solved": f"{solved} of {len(trials)}",
             "interval": f"{lower:.0%} to {upper:.0%}", "1000 samples": f"{quartiles[1]:.0f}",
             "quartiles": f"{quartiles[0]:.0f}-{quartiles[2]:.0f}",
             "travel time [s]": f"{np.mean(travel):.2f}" if travel else "-",
             "p (samples)": f"{paired(trials, groups[DEFAULT], cost).cost_p:.2g}"}
        )  # fmt: skip
    return rows


def study(teams: Sequence[int], seeds: int, own: dict[str, Any]) -> Study:
    """Every setting with every team."""
    policies = {
        label: {"policy": "d4orm", "engine": "cpu", "max_iterations": ITERATIONS, **settings, **own}
        for label, settings in SETTINGS.items()
    }
    return Study(
        policies=policies,
        scenarios=("circle",),
        num_robots=teams,
        seeds=range(FIRST_SEED, FIRST_SEED + seeds),
        scenario_settings=AS_IN_THE_PAPER,
    )


def main() -> int:
    """Run every setting with every team, and write the table."""
    arguments = trials_parser(__doc__, seeds=50).parse_args()
    tiny: tuple[Any, ...] = ((2,), 1, {"max_iterations": 1})
    size = tiny if arguments.quick else (TEAMS, arguments.seeds, {})
    trials = study_trials(arguments, "fewer_samples", [study(*size)])
    rows = []
    for num_robots in sorted({trial.num_robots for trial in trials}):
        team = [trial for trial in trials if trial.num_robots == num_robots]
        rows += rows_of(num_robots, {label: [one for one in team if one.label == label] for label in SETTINGS})
    save_table(rows, arguments.out / "fewer_samples.csv")
    return 0


if __name__ == "__main__":
    sys.exit(main())
