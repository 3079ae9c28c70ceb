"""Success, time and quality of the planners on their problems: tables of the README and of the planners' pages.

    python -m examples.studies solve_rates --seeds 20
    python -m examples.studies solve_rates --seeds 5 --sets few --planner mmd
    python -m examples.studies solve_rates --seeds 20 --sets paper --planner d4orm --preset paper
    python -m examples.studies solve_rates --sets big --planner hybrid --improve 3

Random instances differ by seed; those of the AMSwarm comparison have their starts jittered by 5 mm. Every plan that
counts as solved has passed ``verify()``. Iterations and seconds are those to the first solution, compilation not
counted; with ``--improve`` the search goes on from there until so many seconds have passed in all. No plan takes
less time to travel than "least": that of robots which drive straight to their goals with nothing in the way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from examples.common import grouped, save_table, study_parser, study_rows
from examples.denoising import denoising_columns, denoising_of

from d4orm_env import Problem, make_problem, verify
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED
from d4orm_planners import make_planner


class Case(NamedTuple):
    """Instances of a scenario with these arguments, and what the tables call them."""

    label: str
    scenario: str
    settings: Mapping[str, Any]


class Cases(NamedTuple):
    """A table: who solves what, within so many iterations."""

    planners: tuple[str, ...]
    max_iterations: int
    cases: tuple[Case, ...]


SETS: Mapping[str, Cases] = {
    "paper": Cases(("d4orm",), 30, (
        *(Case(f"circle, {k} holonomic", "circle", {"num_robots": k}) for k in (4, 8, 12, 16)),
        Case("circle, 8 differential drives", "circle", {"num_robots": 8, "model": "differential_drive"}),
        Case("8 heterogeneous", "heterogeneous", {"num_robots": 8}),
        Case("circle in space, 8", "circle", {"num_robots": 8, "model": "holonomic3d"}),
        Case("circle in space, 12", "circle", {"num_robots": 12, "model": "holonomic3d"}),
    )),
    "big": Cases(("hybrid",), 200, (
        Case("circle, 16", "circle", {"num_robots": 16}),
        Case("four obstacles, 16", "four_obstacles", {"num_robots": 16}),
        Case("random, 64 on 8 x 8 m", "random", {"num_robots": 64, "size": 8.0}),
        Case("random, 64 on 10 x 10 m", "random", {"num_robots": 64, "size": 10.0}),
        *(Case(f"random, {k}", "random", {"num_robots": k}) for k in (100, 200, 500, 1000)),
        Case("circle of 18 m, 100", "circle", {"num_robots": 100, "diameter": 18.0}),
        Case("sphere, 64", "sphere", {"num_robots": 64}),
        *(Case(f"AMSwarm {i}, 10", f"amswarm_{i}", {"num_robots": 10}) for i in range(1, 6)),
    )),
    "canonical": Cases(("hybrid",), 60, (
        Case("circle, 16", "paper_circle", {"num_robots": 16}),
        Case("sphere, 16", "paper_sphere", {"num_robots": 16}),
        Case("heterogeneous, 16", "paper_heterogeneous", {"num_robots": 16}),
        Case("four obstacles, 16", "paper_obstacles", {"num_robots": 16, "num_obstacles": 4}),
        Case("random, 16", "paper_random", {"num_robots": 16}),
        Case("random, 64", "paper_random", {"num_robots": 64}),
    )),
    "walls": Cases(("hybrid",), 200, (
        *(Case(f"map of 32 x 32 cells, {k}", "map", {"num_robots": k, "cell": 0.6}) for k in (10, 40, 80)),
        *(Case(f"rooms, {k}", "rooms", {"num_robots": k}) for k in (10, 20, 40)),
        *(Case(f"maze, {k}", "maze", {"num_robots": k}) for k in (10, 20)),
        *(Case(f"warehouse, {k}", "warehouse", {"num_robots": k}) for k in (40, 100)),
        Case("corridor, 4 + 4", "corridor", {"num_robots": 8}),
        Case("doorway, 8", "doorway", {"num_robots": 8}),
        Case("forest in space, 16", "forest", {"num_robots": 16, "model": "holonomic3d"}),
        Case("forest, 16 differential drives", "forest", {"num_robots": 16, "model": "differential_drive"}),
    )),
    "few": Cases(("mmd", "hybrid", "mapf"), 60, (
        Case("circle, 8", "circle", {"num_robots": 8}),
        Case("random with 4 obstacles, 8", "random", {"num_robots": 8, "num_obstacles": 4}),
        Case("random with 4 obstacles, 16", "random", {"num_robots": 16, "num_obstacles": 4}),
        Case("forest, 8", "forest", {"num_robots": 8}),
        Case("warehouse, 8", "warehouse", {"num_robots": 8}),
        Case("warehouse, 16", "warehouse", {"num_robots": 16}),
        Case("rooms, 4", "rooms", {"num_robots": 4}),
        Case("rooms, 8", "rooms", {"num_robots": 8}),
    )),
    "mmd": Cases(("mmd", "hybrid", "mapf"), 300, tuple(
        Case(f"{name}, {k}", f"mmd_{name.replace(' ', '_')}", {"num_robots": k})
        for name in ("conveyor", "highways", "drop region") for k in (6, 12, 20)
    )),
}  # fmt: skip
README = {
    "paper": ("circle, 4 holonomic", "circle, 16 holonomic", "circle, 8 differential drives", "circle in space, 12"),
    "big": ("random, 1000",),
    "walls": ("warehouse, 100",),
}
"""Rows that the README shows."""
JITTER = 0.005
"""Jitter of starts in the AMSwarm comparison [m]."""


def instance(scenario: str, settings: Mapping[str, Any], seed: int) -> Problem:
    """The problem of that seed; of a map, one of 32 x 32 cells of which a fifth is blocked."""
    if scenario == "map":
        blocked = np.random.default_rng(seed).random((32, 32)) < 0.2
        rows = ["".join("@" if cell else "." for cell in row) for row in blocked]
        with TemporaryDirectory() as folder:
            path = Path(folder) / "cells.map"
            path.write_text("\n".join(["type octile", "height 32", "width 32", "map", *rows, ""]))
            return make_problem(scenario, **settings, map=path, seed=seed)
    problem = make_problem(scenario, **settings, seed=seed)
    if not scenario.startswith("amswarm"):
        return problem
    start = problem.start.copy()
    start[:, : problem.dimension] += np.random.default_rng(seed).uniform(-JITTER, JITTER, problem.goal.shape)
    return problem.replace(start=start)


def least_travel_time(problem: Problem) -> float:
    """A bound on the mean travel time of any plan [s]: straight to the edge of the goal, as fast as limits allow.

    The speed limit holds after a step: one that begins at the limit still goes ``acceleration * dt**2 / 2`` further.
    """
    limits, dt = problem.team.limits.astype(float), problem.dt
    distance = np.linalg.norm(problem.goal - problem.start[:, : problem.dimension], axis=1) - problem.goal_radius
    gain, times, steps = limits[:, ACCELERATION] * dt, np.where(distance > 0, np.inf, 0.0), 0
    while np.isinf(times).any():
        steps += 1
        done = np.arange(steps + 1)[:, None]
        fastest = np.minimum(np.minimum(gain * done, limits[:, SPEED]), problem.goal_speed + gain * done[::-1])
        change = np.diff(fastest, axis=0)
        far = ((fastest[:-1] + np.where(change < 0, change, gain) / 2) * dt).sum(axis=0)
        times[np.isinf(times) & (far >= distance)] = steps * dt
    return float(times.mean())


def measure(chosen: Mapping[str, Cases], seeds: int, preset: str | None, improve: float | None) -> list[dict[str, Any]]:
    """A row per plan."""
    rows = []
    for name, (planners, max_iterations, cases) in chosen.items():
        budget = {"max_iterations": max_iterations} if improve is None else {"time_limit": improve}
        for planner_name in planners:
            planner = make_planner(planner_name, preset=preset, improve=improve is not None)
            for case in cases:
                for seed in range(seeds):
                    problem = instance(case.scenario, case.settings, seed)
                    plan = planner.solve(problem, seed=seed, **budget)
                    first = next((record for record in plan.history if record.solved), plan.history[-1])
                    rows.append(
                        {
                            "set": name,
                            "team": case.label,
                            "planner": planner_name,
                            "seed": seed,
                            "solved": bool(plan.solved and verify(plan.problem, plan.controls).ok),
                            "iterations": first.iteration,
                            "seconds": first.wall_time,
                            "travel": float(plan.metrics["travel_time"]),
                            "makespan": float(plan.metrics["makespan"]),
                            "least": least_travel_time(problem),
                            **denoising_of(plan.history),
                        }
                    )
                print(name, planner_name, case.label, f"{sum(row['solved'] for row in rows[-seeds:])} of {seeds}")
    return rows


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row of the table per team and planner; travel times and makespans are those of plans that solve."""
    table = []
    for (team, planner), plans in grouped(rows, "team", "planner").items():
        solved = [row for row in plans if row["solved"]]
        iterations, seconds = ([row[name] for row in plans] for name in ("iterations", "seconds"))
        makespans = [row["makespan"] for row in solved] or [np.inf]
        table.append(
            {
                "team": team,
                "planner": planner,
                "solved": f"{len(solved)} of {len(plans)}",
                "iterations (median, most)": f"{np.median(iterations):g}, {max(iterations)}",
                **denoising_columns(plans),
                "first plan [s] (median, most)": f"{np.median(seconds):.2f}, {max(seconds):.2f}",
                "travel time [s]": f"{np.mean([row['travel'] for row in solved] or [np.inf]):.2f}",
                "least [s]": f"{np.mean([row['least'] for row in plans]):.2f}",
                "last arrival [s] (median, most)": f"{np.median(makespans):.2f}, {max(makespans):.2f}"
                if solved
                else "",
            }
        )
    return table


def main() -> None:
    parser = study_parser(__doc__, seeds=20)
    parser.add_argument("--sets", nargs="+", choices=SETS, default=[*SETS], help="tables to make")
    parser.add_argument("--planner", nargs="+", help="who plans, in place of those of the tables")
    parser.add_argument("--preset", default=None)
    parser.add_argument("--improve", type=float, default=None, help="seconds in all, solved or not")
    arguments = parser.parse_args()
    chosen, seeds = {name: SETS[name] for name in arguments.sets}, arguments.seeds
    if arguments.planner:
        chosen = {name: cases._replace(planners=tuple(arguments.planner)) for name, cases in chosen.items()}
    if arguments.quick:
        chosen, seeds = {name: cases._replace(cases=cases.cases[:1]) for name, cases in chosen.items()}, 1

    def plans() -> list[dict[str, Any]]:
        return measure(chosen, seeds, arguments.preset, arguments.improve)

    rows = study_rows(arguments, "solve_rates", plans)
    for (name,), own in grouped(rows, "set").items():
        save_table(summary(own), arguments.out / f"solve_rates_{name}.csv")
    shown = [row for row in rows if row["team"] in README.get(row["set"], ())]
    if shown:
        columns = ("team", "planner", "solved", "first plan [s] (median, most)", "travel time [s]", "least [s]")
        table = [{name: row[name] for name in columns} for row in summary(shown)]
        save_table(table, arguments.out / "solve_rates.csv")
