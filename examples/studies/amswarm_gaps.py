"""D4orm-D in the fifth environment of AMSwarm, with gaps between its cylinders that robots fit through.

    python -m examples.studies amswarm_gaps --seeds 10 --out amswarm_gaps

Its cylinders stand a metre apart, so that between their surfaces 0.6 m are left, and a robot with its margin needs
0.68 m. The paper does not say where they stand. Variants have the same cylinders further apart, smaller robots, or
no cylinders on the left, which make a trap of the row that the others are. The paper's preset, 50 iterations at most.
The table has the gap, what a robot needs, success with its 95% interval (Wilson), the median of iterations, and the
mean makespan of the solutions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from examples.common import is_solved, mean_text, save_table, solved_columns, study_trials, trials_parser
from examples.denoising import steps_to_solution

from d4orm_env import Problem, make_problem
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.study import Study

PAPER: Mapping[str, object] = {"preset": "paper"}
TINY: Mapping[str, object] = {**PAPER, "max_iterations": 1, "num_steps": 5, "num_samples": 64}


def problems() -> dict[str, Problem]:
    """The environment and its variants, each under its own name."""
    original = make_problem("amswarm_5")
    cylinders = original.world.cylinders

    def among(rows: list[tuple[float, ...]]) -> Problem:
        return original.replace(world=original.world.replace(cylinders=rows))

    def apart(factor: float) -> Problem:
        return among([(x * factor, y * factor, radius) for x, y, radius in cylinders])

    variants = {
        "as it is": original,
        "1.1 times as far apart": apart(1.1),
        "1.2 times as far apart": apart(1.2),
        "robots of 0.24 m": make_problem("amswarm_5", radius=0.24),
        "without those on the left": among([cylinder for cylinder in cylinders if cylinder[0] >= 0]),
    }
    return {name: variant.replace(name=name) for name, variant in variants.items()}


def gap(problem: Problem) -> tuple[float, float]:
    """Between the surfaces of the two cylinders in the row, and what a robot with its margin takes of it [m]."""
    centre, neighbour = problem.world.cylinders[:2]
    free = np.hypot(centre[0] - neighbour[0], centre[1] - neighbour[1]) - centre[2] - neighbour[2]
    return float(free), float(2 * (np.max(problem.team.radius) + problem.margin))


def median_steps(trials: Sequence[Trial]) -> str:
    """Median of the denoising steps to the first solution, of which there are never enough where there is none."""
    steps = [np.inf if (found := steps_to_solution(trial)) is None else found for trial in trials]
    return f"{np.median(steps):g}".replace("inf", "never")


def main() -> None:
    arguments = trials_parser(__doc__, seeds=10).parse_args()
    settings, seeds = (TINY, 1) if arguments.quick else (PAPER, arguments.seeds)
    variants = problems()
    study = Study(policies={"d4orm-d": settings}, scenarios=tuple(variants.values()), seeds=range(seeds))
    trials = study_trials(arguments, "amswarm_gaps", [study])
    rows: list[dict[str, Any]] = []
    for name, problem in variants.items():
        mine = [trial for trial in trials if trial.scenario == name]
        free, needed = gap(problem)
        makespans = [trial.makespan for trial in mine if is_solved(trial) and trial.makespan is not None]
        rows.append(
            {"cylinders": name, "gap [m]": f"{free:.2f}", "a robot needs [m]": f"{needed:.2f}",
             **solved_columns(mine),
             "iterations": f"{np.median([trial.iterations for trial in mine if trial.iterations is not None]):g}",
             "denoising steps": median_steps(mine),
             "makespan [s]": mean_text(makespans)}
        )  # fmt: skip
    save_table(rows, arguments.out / "amswarm_gaps.csv")
