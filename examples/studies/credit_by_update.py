"""Factorial of credit and update, on four teams: who gets the credit, and how samples become an update.

    python -m examples.studies credit_by_update --seeds 50 --out factorial

Credit: samples are weighted by the reward of the team, of the group that a robot was in conflict with, of the robot, or
of robot and team in turn; and by that of the group with contacts that cost twice as much, as much as they cost the two
that touch. Update: MPPI, CEM with adaptive variance, MBD, i-MBD or D4orm, everything else being the
paper's. Every trial has the same budget of denoising steps of 1024 samples, which MBD spends in one iteration (so that
its credit by groups, or in turn, is credit by robot). The table has success with its 95% interval (Wilson), the mean
number of steps to the first solution, a trial without one counting twice the budget (PAR-2), and how likely it is that
the cell and D4orm with the same credit are equally good (McNemar on solutions, Wilcoxon on steps, paired by seed).
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from examples.common import is_solved, plt, save_figure, save_table, solved_columns, study_trials, trials_parser
from examples.denoising import penalised_steps, step_columns, steps_to_solution

from d4orm_planners.evaluation.comparison import paired, survival
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.study import Study

TEAMS = (("paper_circle", 8), ("paper_circle", 16), ("paper_random", 16), ("paper_heterogeneous", 8))
CREDITS: dict[str, dict[str, Any]] = {
    "team": {"credit": "team"},
    "group": {"credit": "group"},
    "robot": {"credit": "robot"},
    "in turn": {"credit": "alternate"},
    "group, penalty 2": {"credit": "group", "penalty": 2.0},
}
UPDATES: dict[str, dict[str, Any]] = {
    "mppi": {},
    "cem": {"adapt_variance": True},
    "mbd": {"max_iterations": 1, "check_every": None},
    "i-mbd": {},
    "d4orm": {},
}
REFERENCE = "d4orm"
BUDGET, TINY, ITERATION = 1000, 20, 100
"""Denoising steps of a trial, of the small version's, and of an iteration."""

Cells = dict[tuple[str, str], list[Trial]]


def policies(budget: int) -> dict[str, dict[str, Any]]:
    """Every credit with every update, each with so many steps."""
    steps = min(ITERATION, budget)
    return {
        f"{update}, {credit}": {
            "policy": update, "preset": "paper", "engine": "cpu", **scoring,
            "num_steps": budget if update == "mbd" else steps, "max_iterations": budget // steps, **settings,
        }
        for update, settings in UPDATES.items()
        for credit, scoring in CREDITS.items()
    }  # fmt: skip


def studies(teams: Iterable[tuple[str, int]], seeds: int, budget: int) -> list[Study]:
    """Every cell on every team."""
    chosen = policies(budget)
    return [
        Study(policies=chosen, scenarios=(scenario,), num_robots=num_robots, seeds=range(seeds))
        for scenario, num_robots in teams
    ]


def by_team(trials: Iterable[Trial]) -> dict[str, Cells]:
    """Trials by team, update and credit."""
    teams: dict[str, Cells] = {}
    for trial in trials:
        update, _, credit = trial.label.partition(", ")
        teams.setdefault(f"{trial.scenario}, {trial.num_robots}", {}).setdefault((update, credit), []).append(trial)
    return teams


def rows_of(team: str, cells: Cells) -> list[dict[str, Any]]:
    """A row per cell."""
    rows = []
    for update, credit in product(UPDATES, CREDITS):
        trials = cells[update, credit]
        reference = None if update == REFERENCE else cells[REFERENCE, credit]
        test = reference and paired(trials, reference, penalised_steps, is_solved)
        rows.append(
            {"team": team, "update": update, "credit": credit, **solved_columns(trials), **step_columns(trials),
             "p (solved)": test and test.success_p, "p (steps)": test and test.cost_p}
        )  # fmt: skip
    return rows


def draw(teams: dict[str, Cells], path: Path) -> None:
    """The share of seeds without a solution against the steps spent: a row per team, a column per credit."""
    figure, axes = plt.subplots(
        len(teams), len(CREDITS), figsize=(13, 2.4 * len(teams)), sharex=True, sharey=True, squeeze=False
    )
    for row, (team, cells) in zip(axes, teams.items(), strict=True):
        budget = max(penalised_steps(trial) for trials in cells.values() for trial in trials) / 2
        for axis, credit in zip(row, CREDITS, strict=True):
            for number, update in enumerate(UPDATES):
                curve = survival([steps_to_solution(trial) for trial in cells[update, credit]])
                steps = np.concatenate([[0], curve.costs, [budget]])
                left = np.concatenate([[1.0], curve.unsolved])
                axis.stairs(left, steps, baseline=None, label=update, color=f"C{number}")
            axis.set_ylim(-0.02, 1.02)
        row[0].set_ylabel(f"{team}\nunsolved")
    for axis in axes[-1]:
        axis.set_xlabel("denoising steps")
    for axis, credit in zip(axes[0], CREDITS, strict=True):
        axis.set_title(f"credit: {credit}")
    axes[0, 0].legend()
    figure.tight_layout()
    save_figure(figure, path)


def main() -> None:
    arguments = trials_parser(__doc__, seeds=50).parse_args()
    size = (TEAMS[:1], 1, TINY) if arguments.quick else (TEAMS, arguments.seeds, BUDGET)
    found = by_team(study_trials(arguments, "credit_by_update", studies(*size)))
    rows = [row for team, cells in found.items() for row in rows_of(team, cells)]
    save_table(rows, arguments.out / "credit_by_update.csv")
    draw(found, arguments.out / "credit_by_update.png")
