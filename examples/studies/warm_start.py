"""Warm start by a learned policy: what the team does by it is where the search of a planner begins.

    python -m examples.studies warm_start --seeds 20

Every instance is planned for twice by each planner, with nothing to begin with and from an episode of the policy "ppo"
that comes with the package, whose time is counted. Then D4orm-C2F drives, its first coarse plan made from nothing and
from such an episode.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from examples.common import grouped, mean_text, save_table, study_parser, study_rows
from examples.denoising import denoising_columns, denoising_of

from d4orm_env import Problem, make_problem, navigation_v0
from d4orm_planners import make_planner, make_policy, run_episode

CASES = (("random", 8), ("random", 16), ("circle", 8), ("circle", 16))
PLANNERS = ("hybrid", "d4orm", "d4orm-c2f")
GUESSES = (None, "ppo")
LIMIT = 5.0
"""Time limit of planning [s]."""


def solve(planner: str, problem: Problem, seed: int, guess: str | None) -> dict[str, Any]:
    """Plan, from an episode of a policy if there is one."""
    begin, initial = time.perf_counter(), None
    if guess is not None:
        initial = run_episode(navigation_v0.parallel_env(problem=problem), guess, seed=seed).controls
    plan = make_planner(planner).solve(problem, seed=seed, time_limit=LIMIT, initial_controls=initial)
    seconds, travel = time.perf_counter() - begin, float(plan.metrics["travel_time"])
    outcome = {"solved": plan.solved, "iterations": plan.iterations, "seconds": seconds, "travel": travel}
    return outcome | denoising_of(plan.history)


def drive(problem: Problem, seed: int, guess: str | None) -> dict[str, Any]:
    """Drive under D4orm-C2F, whose first coarse plan begins with an episode of a policy if there is one."""
    policy: Any = make_policy("d4orm-c2f", refine="sync", warm_start=guess)
    metrics = run_episode(navigation_v0.parallel_env(problem=problem), policy, seed=seed).metrics
    travel = float(metrics["travel_time"])
    return {"solved": bool(metrics["success"]), "iterations": None, "seconds": policy.coarse_time, "travel": travel,
            "denoising_steps": None, "denoising_time_share": None}  # fmt: skip


def measure(planners: Sequence[str], cases: Sequence[tuple[str, int]], seeds: int) -> list[dict[str, Any]]:
    """A row per plan or drive; the same instance with either beginning in turn."""
    rows = []
    for planner in planners:
        run = drive if planner == "d4orm-c2f" else partial(solve, planner)
        for scenario, num_robots in cases:
            team = f"{scenario}, {num_robots} robots"
            for guess in GUESSES:  # both are compiled before anything is timed
                run(make_problem(scenario, num_robots, 0), 0, guess)
            for seed in range(seeds):
                problem = make_problem(scenario, num_robots, seed)
                rows += [
                    {"planner": planner, "team": team, "from": guess or "nothing", "seed": seed}
                    | run(problem, seed, guess)
                    for guess in GUESSES
                ]
            print(planner, team, flush=True)
    return rows


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row of the table per planner, team and beginning."""
    table = []
    columns = ("planner", "team", "from")
    for key, runs in grouped(rows, *columns).items():
        times, iterations = [row["travel"] for row in runs if row["solved"]], [row["iterations"] for row in runs]
        table.append(
            {
                **dict(zip(columns, key, strict=True)),
                "solved": f"{len(times)} of {len(runs)}",
                "iterations, median": "" if None in iterations else f"{np.median(iterations):g}",
                **denoising_columns(runs),
                "seconds, median": f"{np.median([row['seconds'] for row in runs]):.3f}",
                "travel time [s]": mean_text(times, none=""),
            }
        )
    return table


def main() -> None:
    arguments = study_parser(__doc__, seeds=20).parse_args()
    chosen: tuple[Any, ...] = PLANNERS, CASES, arguments.seeds
    if arguments.quick:
        chosen = ("hybrid", "d4orm-c2f"), (("random", 4),), 2
    rows = study_rows(arguments, "warm_start", partial(measure, *chosen))
    save_table(summary(rows), arguments.out / "warm_start.csv")
