"""D4orm and its rivals as the paper has them and tuned with the same effort, on seeds that no tuning has seen.

    python -m examples.studies.tuned_rivals --seeds 50 --out tuned_rivals

The four teams of `tune_rivals.py`, and 16 robots on the circle, on which nothing was tuned, with seeds from 0 on: the
presets `paper` and `tuned` of every sampling method where they differ, and D4orm's defaults. A trial has 2000 denoising
steps, of 1024 samples but for the defaults, which draw 256 and later 128; MBD has its one run, of as many steps as it
was tuned with (its preset, with 10 000, is in `d4orm reproduce team-size`). The table has success with its 95% interval
(Wilson), the mean number of denoising steps to the first solution, a trial without one counting twice the budget
(PAR-2), the mean travel time of the solutions, and how likely it is that a row and tuned D4orm are equally good
(McNemar on solutions, Wilcoxon on steps, paired by seed). Trials are stored in the folder, and a call that was broken
off goes on from there. `--trials FILE` makes the table of trials that are in a Parquet file, such as those in `data/`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from examples.outputs import (
    argument_parser,
    count,
    first_solutions,
    measured_trials,
    save_table,
    trials_argument,
    trials_of,
)
from examples.studies.tune_rivals import TEAMS as TUNED_ON

from d4orm_planners import make_planner
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.study import Study
from d4orm_planners.sampling.tuned import TUNED

TEAMS: Sequence[tuple[str, int]] = (*TUNED_ON, ("paper_circle", 16))
BUDGET, TINY = 2000, 20
"""Denoising steps of a trial, and of the small version's."""
REFERENCE = "d4orm, tuned"


def policies(budget: int) -> dict[str, dict[str, Any]]:
    """Every preset by its label, with as many iterations as the budget has room for."""
    chosen: dict[str, dict[str, Any]] = {"d4orm, defaults": {"policy": "d4orm"}}
    for method, tuned in TUNED.items():
        for preset in ("paper", "tuned") if tuned else ("paper",):
            if (method, preset) != ("mbd", "paper"):
                chosen[f"{method}, {preset}"] = {"policy": method, "preset": preset}
    for settings in chosen.values():
        name, own = settings["policy"], {key: value for key, value in settings.items() if key != "policy"}
        num_steps = min(make_planner(name, **own).config.num_steps, budget)
        iterations = 1 if name == "mbd" else budget // num_steps
        settings |= {"engine": "cpu", "num_steps": num_steps, "max_iterations": iterations}
    return chosen


def run(teams: Sequence[tuple[str, int]], seeds: int, budget: int, out: Path) -> list[Trial]:
    """Trials of every preset with every team."""
    studies = (
        Study(policies=policies(budget), scenarios=(scenario,), num_robots=num_robots, seeds=range(seeds))
        for scenario, num_robots in teams
    )
    return trials_of(studies, out)


def main() -> int:
    """Run every preset with every team, and write the table."""
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=count, default=50)
    trials_argument(parser)
    arguments = parser.parse_args()
    size = (TEAMS[:1], 1, TINY) if arguments.quick else (TEAMS, arguments.seeds, BUDGET)
    trials = measured_trials(
        arguments.trials, lambda: run(*size, out=arguments.out), arguments.out / "tuned_rivals.parquet"
    )
    teams: dict[tuple[str, int], dict[str, list[Trial]]] = {}
    for trial in trials:
        teams.setdefault((trial.scenario, trial.num_robots), {}).setdefault(trial.label, []).append(trial)
    rows = [
        row
        for (scenario, num_robots), groups in teams.items()
        for row in first_solutions(f"{scenario}, {num_robots} robots", "method", groups, REFERENCE)
    ]
    save_table(rows, arguments.out / "tuned_rivals.csv")
    return 0


if __name__ == "__main__":
    sys.exit(main())
