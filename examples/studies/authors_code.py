"""D4orm as its authors published it in 2025, run from a checkout of theirs, beside this project's on the same circle.

    git clone https://github.com/proroklab/d4orm authors
    pip install flax tyro
    python -m examples.studies authors_code --checkout authors --seeds 20

Their program runs as it is, on its own circle, with 1024 samples as in the paper; only its warm-up is left out. It
draws with standard deviations ``1 / alpha_bar - 1``, where the paper has the root of that, so it runs a second time
with the root. "Solved" is the planner's own word, "verified" that of :func:`d4orm_env.verify` and the margin on its
controls; iterations, denoising steps and travel times are means over the solutions.
"""

from __future__ import annotations

import sys
from argparse import ArgumentTypeError
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from importlib import import_module
from io import StringIO
from pathlib import Path
from time import process_time
from typing import Any
from unittest.mock import patch

import numpy as np
from examples.common import each_row, grouped, mean_text, save_table, study_parser, study_rows

from d4orm_env import Problem, make_problem
from d4orm_env.engine.choice import get_engine
from d4orm_planners import make_planner
from d4orm_planners.base.candidate import evaluate_controls

Row = dict[str, Any]
Solver = Callable[[Problem, int, int], tuple[np.ndarray, bool, int]]
"""``(problem, seed, max_iterations) -> controls (H, K, m), whether solved, iterations``."""

TEAMS: tuple[int, ...] = (8, 12, 16)
MAX_ITERATIONS, NUM_SAMPLES = 30, 1024
STEPS = 100
"""Denoising steps of an iteration, by their code and by both presets."""
PRESETS = {"d4orm, authors": "authors", "d4orm, paper": "paper"}
"""Presets by the labels of their rows."""


def folder(text: str) -> Path:
    """A command-line path of a checkout."""
    if not (Path(text) / "d4orm" / "planners" / "multi_planner.py").is_file():
        raise ArgumentTypeError(f"{text} has no d4orm/planners/multi_planner.py; give a clone of proroklab/d4orm")
    return Path(text)


def published(checkout: Path, num_samples: int, root: bool) -> Solver:
    """Their program, by the standard deviations of its own, or by the roots of these."""
    with patch.object(sys, "path", [str(checkout), *sys.path]):
        code = import_module("d4orm.planners.multi_planner")
    plan, denoise = code.plan_joint_naive, code.make_reverse_once_naive
    outcome: list[Any] = []

    def planned(*given: Any, warm_up: bool = False, **named: Any) -> tuple[Any, ...]:
        if not warm_up:
            outcome[:] = plan(*given, **named)
        return tuple(outcome)

    def denoised(*given: Any, sigmas: Any, **named: Any) -> Any:
        return denoise(*given, sigmas=sigmas**0.5 if root else sigmas, **named)

    def solve(problem: Problem, seed: int, max_iterations: int) -> tuple[np.ndarray, bool, int]:
        check_instance(code, problem)
        args = code.Args(
            seed=seed, Nagent=problem.num_robots, Hsample=problem.horizon, Nsample=num_samples,
            Niteration=max_iterations,
        )  # fmt: skip
        changed = patch.multiple(code, plan_joint_naive=planned, make_reverse_once_naive=denoised)
        with changed, redirect_stdout(StringIO()):
            code.run_diffusion(args)
        controls, *_, solved, iterations = outcome
        return np.array(controls).reshape(problem.horizon, problem.num_robots, -1), bool(solved), int(iterations)

    return solve


def check_instance(code: Any, problem: Problem) -> None:
    """Make sure that their robots start and end where ours do."""
    env = code.d4orm.envs.get_env("multi2dholo", problem.num_robots)
    for theirs, ours in ((env.x0, problem.start), (env.xg, problem.goal)):
        positions = np.array(theirs).reshape(problem.num_robots, -1)[:, : problem.dimension]
        if not np.allclose(positions, ours[:, : problem.dimension], atol=1e-5):
            raise ValueError(f"its circle of {problem.num_robots} robots is not 'paper_circle'; is it proroklab/d4orm?")


def ours(preset: str, num_samples: int) -> Solver:
    """This project's D4orm by a preset."""
    planner = make_planner("d4orm", preset=preset, num_samples=num_samples, engine="cpu")

    def solve(problem: Problem, seed: int, max_iterations: int) -> tuple[np.ndarray, bool, int]:
        plan = planner.solve(problem, seed=seed, max_iterations=max_iterations)
        return plan.controls, plan.solved, plan.iterations

    return solve


def row_of(max_iterations: int, size: int, seed: int, labelled: tuple[str, Solver]) -> Row:
    """One solve of a team and what :func:`d4orm_env.verify` says of it."""
    (label, solver), problem = labelled, make_problem("paper_circle", num_robots=size)
    began = process_time()
    controls, solved, iterations = solver(problem, seed, max_iterations)
    spent, executed = process_time() - began, evaluate_controls(get_engine("cpu"), problem, controls.astype(np.float32))
    arrived = executed.trajectory.arrived
    return {
        "planner": label, "robots": problem.num_robots, "seed": seed, "solved": solved, "iterations": iterations,
        "verified": executed.solved, "processor_seconds": spent, "reward": executed.reward,
        "travel_time": float(arrived.argmax(axis=0).mean() * problem.dt) if arrived[-1].all() else None,
    }  # fmt: skip


def summary(rows: list[Row]) -> list[Row]:
    """A row per team and planner."""
    table = []
    for (size, label), own in grouped(rows, "robots", "planner").items():
        solved = [row for row in own if row["solved"]]
        table.append(
            {"robots": size, "planner": label, "solved": f"{len(solved)} of {len(own)}",
             "verified": f"{sum(row['verified'] for row in own)} of {len(own)}",
             "iterations": mean_text([row["iterations"] for row in solved], ".1f"),
             "denoising steps": mean_text([STEPS * row["iterations"] for row in solved], ".0f"),
             "least, most": f"{min(row['iterations'] for row in own)}, {max(row['iterations'] for row in own)}",
             "travel time [s]": mean_text([row["travel_time"] for row in solved if row["verified"]])}
        )  # fmt: skip
    return table


def main() -> None:
    parser = study_parser(__doc__, seeds=20)
    parser.add_argument("--checkout", type=folder, help="of proroklab/d4orm; needed without --trials")
    arguments = parser.parse_args()
    if arguments.trials is None and arguments.checkout is None:
        parser.error("give --checkout, a clone of https://github.com/proroklab/d4orm, or --trials")
    teams, seeds, iterations, samples = TEAMS, arguments.seeds, MAX_ITERATIONS, NUM_SAMPLES
    if arguments.quick:
        teams, seeds, iterations, samples = (2,), 1, 2, 64

    def solve_all() -> list[Row]:
        solvers = {
            "their code": published(arguments.checkout, samples, root=False),
            "their code, the paper's deviations": published(arguments.checkout, samples, root=True),
            **{label: ours(preset, samples) for label, preset in PRESETS.items()},
        }
        return each_row(partial(row_of, iterations), teams, range(seeds), solvers.items())

    save_table(summary(study_rows(arguments, "authors_code", solve_all)), arguments.out / "authors_code.csv")
