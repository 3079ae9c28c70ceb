"""Effect of each difference between the paper's D4orm and this project's defaults, one at a time.

    python -m examples.studies.paper_differences --seeds 50 --out paper_differences

16 robots on the paper's circle and 12 among its four obstacles, at most 20 iterations: the preset `paper` with one
setting of the defaults in turn, or with what the paper leaves open decided otherwise, and the defaults with one setting
of the preset in turn. The table has success with its 95% interval (Wilson), the mean number of denoising steps to the
first solution, a trial without one counting twice the budget (PAR-2), the mean travel time of the solutions, and how
likely it is that a row and the first of its kind are equally good (McNemar on solutions, Wilcoxon on steps, paired by
seed).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from examples.outputs import first_solutions, save_table, study_trials, trials_parser

from d4orm_planners.evaluation.study import Study

TEAMS: Mapping[str, Sequence[int]] = {"paper_circle": (16,), "paper_obstacles": (12,)}
ITERATIONS = 20
FIRST_SEED = 1000
"""No default was chosen by the seeds from here on."""
PAPER: dict[str, Any] = {"preset": "paper"}
GROUPS: dict[str, Any] = {"credit": "group", "penalty": 2.0}
SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "preset paper": {
        "preset paper": PAPER,
        "preset, clipped between iterations": {**PAPER, "clip_between_iterations": True},
        "preset, random start": {**PAPER, "random_start": True},
        "preset, 256 samples": {**PAPER, "num_samples": 256},
        "preset, small weights dropped": {**PAPER, "weight_cutoff": 1e-3},
        "preset, by groups with contacts that cost both": {**PAPER, **GROUPS},
    },
    "defaults": {
        "defaults": {},
        "defaults, not clipped between iterations": {"clip_between_iterations": False},
        "defaults, random start": {"random_start": True},
        "defaults, 1024 samples throughout": {"num_samples": 1024, "late_samples": 1.0},
        "defaults, all weights kept": {"weight_cutoff": 0.0},
        "defaults, by the team's reward": {"credit": "team", "penalty": 1.0},
    },
}
"""Settings by what they are compared with."""


def studies(sizes: Mapping[str, Sequence[int]], seeds: int, own: dict[str, Any]) -> list[Study]:
    """Every setting with every team."""
    policies = {
        label: {"policy": "d4orm", "engine": "cpu", "max_iterations": ITERATIONS, **settings, **own}
        for kind in SETTINGS.values()
        for label, settings in kind.items()
    }
    return [
        Study(
            policies=policies,
            scenarios=(scenario,),
            num_robots=num_robots,
            seeds=range(FIRST_SEED, FIRST_SEED + seeds),
        )
        for scenario, num_robots in sizes.items()
    ]


def main() -> int:
    """Run every setting with every team, and write the table."""
    arguments = trials_parser(__doc__, seeds=50).parse_args()
    tiny = (dict.fromkeys(TEAMS, (2,)), 1, {"max_iterations": 1, "num_steps": 20})
    size = tiny if arguments.quick else (TEAMS, arguments.seeds, {})
    trials = study_trials(arguments, "paper_differences", studies(*size))
    rows = []
    for scenario in TEAMS:
        for reference, settings in SETTINGS.items():
            groups = {
                label: [trial for trial in trials if trial.scenario == scenario and trial.label == label]
                for label in settings
            }
            (num_robots,) = {trial.num_robots for trial in groups[reference]}
            rows += first_solutions(f"{scenario}, {num_robots} robots", "settings", groups, reference)
    save_table(rows, arguments.out / "paper_differences.csv")
    return 0


if __name__ == "__main__":
    sys.exit(main())
