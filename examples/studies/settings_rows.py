"""Rows of the tables that compare settings: what a team's trials say of each label, beside a reference."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from examples.common import first_solutions, is_solved, mean_text, solved_columns
from examples.denoising import penalised_steps

from d4orm_planners.evaluation.comparison import paired
from d4orm_planners.evaluation.store import Trial


def samples_needed(team: str, column: str, groups: dict[str, list[Trial]], reference: str) -> list[dict[str, Any]]:
    """A row per setting: the samples drawn until the first solution, where a trial without one counts twice."""

    def samples(trial: Trial) -> float:
        config = json.loads(trial.config)
        each = config["num_samples"] * (1 - config["late_steps"] * (1 - config["late_samples"]))
        return float(penalised_steps(trial) * each)

    rows = []
    for label, trials in groups.items():
        test = None if label == reference else paired(trials, groups[reference], samples)
        quartiles = np.percentile([samples(trial) for trial in trials], (25, 50, 75)) / 1000
        travel = [trial.travel_time for trial in trials if is_solved(trial) and trial.travel_time is not None]
        rows.append(
            {"robots": team, column: label, **solved_columns(trials), "1000 samples": f"{quartiles[1]:.0f}",
             "quartiles": f"{quartiles[0]:.0f}-{quartiles[2]:.0f}",
             "travel time [s]": mean_text(travel),
             "p (samples)": test and test.cost_p}
        )  # fmt: skip
    return rows


def with_iterations(team: str, column: str, groups: dict[str, list[Trial]], reference: str) -> list[dict[str, Any]]:
    """:func:`first_solutions`, and the mean number of iterations of the successes."""
    rows = []
    for row in first_solutions(team, column, groups, reference):
        solved = [trial.iterations for trial in groups[row[column]] if is_solved(trial)]
        rows.append(dict(list(row.items())[:4]) | {"iterations": mean_text(solved, ".1f")} | row)
    return rows


def with_jerk(team: str, column: str, groups: dict[str, list[Trial]], reference: str) -> list[dict[str, Any]]:
    """:func:`first_solutions` without the tests, and the mean squared norm of the solutions' jerk."""
    jerks = [trial.mean_squared_jerk for trial in groups[reference] if is_solved(trial)]
    shown = list(first_solutions(team, column, groups, reference)[0].items())[:-2]
    return [dict(shown) | {"jerk [m²/s⁶]": mean_text(jerks, ".3g")}]


def executed(team: str, column: str, groups: dict[str, list[Trial]], reference: str) -> list[dict[str, Any]]:
    """A row per controller: successes and their travel times, and a test, where a failure counts twice the longest."""
    times = [trial.travel_time or 0.0 for trials in groups.values() for trial in trials if trial.success]

    def cost(trial: Trial) -> float:
        return (trial.travel_time or 0.0) if trial.success else 2 * max(times, default=1.0)

    rows = []
    for label, trials in groups.items():
        test = None if label == reference else paired(trials, groups[reference], cost)
        done = [trial for trial in trials if trial.success]
        rows.append(
            {"team": team, column: label, **solved_columns(trials, lambda trial: trial.success),
             "travel time [s]": mean_text([trial.travel_time for trial in done]),
             "makespan [s]": mean_text([trial.makespan for trial in done]),
             "p (travel time)": test and test.cost_p}
        )  # fmt: skip
    return rows


def solver_iterations(team: str, column: str, groups: dict[str, list[Trial]], reference: str) -> list[dict[str, Any]]:
    """A row per start: solutions, IPOPT's own iterations, and a test, where a failure counts twice the most."""
    counts = {id(trial): trial.progress[-1].steps or 0 for trials in groups.values() for trial in trials}
    worst = max(counts.values())

    def cost(trial: Trial) -> float:
        return counts[id(trial)] if is_solved(trial) else 2 * worst

    rows = []
    for label, trials in groups.items():
        test = None if label == reference else paired(trials, groups[reference], cost)
        rows.append(
            {"team": team, column: label, **solved_columns(trials),
             "iterations": mean_text([counts[id(trial)] for trial in trials], ".0f"),
             "of the solved": mean_text([counts[id(trial)] for trial in trials if is_solved(trial)], ".0f"),
             "p (iterations)": test and test.cost_p}
        )  # fmt: skip
    return rows
