"""Which matters more, who gets the credit or how samples become an update: a factorial of both, on four teams.

    python examples/credit_by_update.py --seeds 50 --out factorial

Credit: samples are weighted by the reward of the team, of the group that a robot was in conflict with, of the robot, or
of robot and team in turn. Update: MPPI, CEM with adaptive variance, MBD, i-MBD or D4orm, everything else being the
paper's. Every trial has the same budget of denoising steps of 1024 samples, which MBD spends in one iteration (so that
its credit by groups, or in turn, is credit by robot). The table has success with its 95% interval (Wilson), the mean
number of steps to the first solution, a trial without one counting twice the budget (PAR-2), and how likely it is that
the cell and D4orm with the same credit are equally good (McNemar on successes, Wilcoxon on steps, paired by seed).
Trials are stored in the folder, and a call that was broken off goes on from there.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from outputs import argument_parser, count, plt, save_figure, save_table

from d4orm_planners.evaluation.comparison import paired, survival
from d4orm_planners.evaluation.evaluate import run_study
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.study import Study
from d4orm_planners.evaluation.summary import wilson_interval

TEAMS = (("paper_circle", 8), ("paper_circle", 16), ("paper_random", 16), ("paper_heterogeneous", 8))
CREDITS = {"team": "team", "group": "group", "robot": "robot", "in turn": "alternate"}
UPDATES: dict[str, dict[str, Any]] = {
    "mppi": {},
    "cem": {"adapt_variance": True},
    "mbd": {"max_iterations": 1},
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
            "policy": update, "preset": "paper", "engine": "cpu", "credit": value,
            "num_steps": budget if update == "mbd" else steps, "max_iterations": budget // steps, **settings,
        }
        for update, settings in UPDATES.items()
        for credit, value in CREDITS.items()
    }  # fmt: skip


def steps_of(trial: Trial, budget: int) -> int | None:
    """Denoising steps to the first solution; ``None`` without one."""
    if trial.status != "solved" or not trial.iterations:
        return None
    return budget if trial.policy == "mbd" else trial.iterations * min(ITERATION, budget)


def run_team(scenario: str, num_robots: int, seeds: int, budget: int, out: Path) -> Cells:
    """Trials by update and credit."""
    study = Study(policies=policies(budget), scenarios=(scenario,), num_robots=num_robots, seeds=range(seeds))
    cells: Cells = {}
    for label, trials in run_study(study, out, workers=1):
        update, _, credit = label.partition(", ")
        cells[update, credit] = trials
    return cells


def rows_of(team: str, cells: Cells, budget: int) -> list[dict[str, Any]]:
    """A row per cell."""

    def cost(trial: Trial) -> float:
        return steps_of(trial, budget) or 2 * budget

    rows = []
    for (update, credit), trials in cells.items():
        solved = sum(steps_of(trial, budget) is not None for trial in trials)
        lower, upper = wilson_interval(solved, len(trials))
        test = paired(trials, cells[REFERENCE, credit], cost)
        rows.append(
            {"team": team, "update": update, "credit": credit, "solved": f"{solved} of {len(trials)}",
             "interval": f"{lower:.0%} to {upper:.0%}", "steps": round(float(np.mean([cost(t) for t in trials]))),
             "p (solved)": f"{test.success_p:.2g}", "p (steps)": f"{test.cost_p:.2g}"}
        )  # fmt: skip
    return rows


def draw(teams: Sequence[tuple[str, Cells]], budget: int, path: Path) -> None:
    """The share of seeds without a solution against the steps spent: a row per team, a column per credit."""
    figure, axes = plt.subplots(
        len(teams), len(CREDITS), figsize=(11, 2.4 * len(teams)), sharex=True, sharey=True, squeeze=False
    )
    for row, (team, cells) in zip(axes, teams, strict=True):
        for axis, credit in zip(row, CREDITS, strict=True):
            for number, update in enumerate(UPDATES):
                curve = survival([steps_of(trial, budget) for trial in cells[update, credit]])
                steps = np.concatenate([[0], curve.costs, [budget]])
                left = np.concatenate([[1.0], curve.unsolved])
                axis.stairs(left, steps, baseline=None, label=update, color=f"C{number}")
            axis.set(title=f"{team}, credit: {credit}", ylim=(-0.02, 1.02))
    for axis in axes[-1]:
        axis.set_xlabel("denoising steps")
    for axis in axes[:, 0]:
        axis.set_ylabel("unsolved")
    axes[0, 0].legend()
    figure.tight_layout()
    save_figure(figure, path)


def main() -> int:
    """Run every cell on every team, write the table and draw the curves."""
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=count, default=50)
    arguments = parser.parse_args()
    teams, seeds, budget = (TEAMS[:1], 1, TINY) if arguments.quick else (TEAMS, arguments.seeds, BUDGET)
    rows, found = [], []
    for scenario, num_robots in teams:
        team = f"{scenario}, {num_robots}"
        cells = run_team(scenario, num_robots, seeds, budget, arguments.out)
        rows += rows_of(team, cells, budget)
        found.append((team, cells))
    save_table(rows, arguments.out / "credit_by_update.csv")
    draw(found, budget, arguments.out / "credit_by_update.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
