"""D4orm and its rivals as the paper has them and tuned with the same effort, on seeds that no tuning has seen.

    python -m examples.studies.tuned_rivals --seeds 50 --out tuned_rivals

The four teams of `tune_rivals.py`, and 16 robots on the circle, on which nothing was tuned, with seeds from 0 on: the
presets `paper` and `tuned` of every sampling method where they differ, and D4orm's defaults. A trial has 2000 denoising
steps, of 1024 samples but for the defaults, which draw 256 and later 128; MBD has its one run, of as many steps as it
was tuned with (its preset, with 10 000, is in `examples.studies.paper team-size`). The table has success with its 95%
interval (Wilson), the mean number of denoising steps to the first solution, a trial without one counting twice the
budget (PAR-2), the mean travel time of the solutions, and how likely it is that a row and tuned D4orm are equally good
(McNemar on solutions, Wilcoxon on steps, paired by seed).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from examples.outputs import first_solutions, save_table, study_trials, trials_parser
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


def studies(teams: Sequence[tuple[str, int]], seeds: int, budget: int) -> list[Study]:
    """Every preset with every team."""
    return [
        Study(policies=policies(budget), scenarios=(scenario,), num_robots=num_robots, seeds=range(seeds))
        for scenario, num_robots in teams
    ]


def main() -> int:
    """Run every preset with every team, and write the table."""
    arguments = trials_parser(__doc__, seeds=50).parse_args()
    size = (TEAMS[:1], 1, TINY) if arguments.quick else (TEAMS, arguments.seeds, BUDGET)
    trials = study_trials(arguments, "tuned_rivals", studies(*size))
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
