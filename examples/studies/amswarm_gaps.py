"""D4orm-D in the fifth environment of AMSwarm, with gaps between its cylinders that robots fit through.

    python -m examples.studies.amswarm_gaps --seeds 10 --out amswarm_gaps

Its cylinders stand a metre apart, so that between their surfaces 0.6 m are left, and a robot with its margin needs
0.68 m. The paper does not say where they stand. Variants have the same cylinders further apart, smaller robots, or
no cylinders on the left, which make a trap of the row that the others are. The paper's preset, 50 iterations at most.
The table has the gap, what a robot needs, success with its 95% interval (Wilson), the median of iterations, and the
mean makespan of the solutions.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from examples.outputs import save_table, study_trials, trials_parser

from d4orm_env import Problem, make_problem
from d4orm_planners.evaluation.comparison import is_solved
from d4orm_planners.evaluation.study import Study
from d4orm_planners.evaluation.summary import wilson_interval

PAPER: Mapping[str, object] = {"preset": "paper"}
TINY: Mapping[str, object] = {**PAPER, "max_iterations": 1, "num_steps": 5, "num_samples": 64}


def apart(factor: float) -> Problem:
    """The environment with its cylinders ``factor`` times as far from the centre, and so from each other."""
    problem = make_problem("amswarm_5")
    cylinders = [(x * factor, y * factor, radius) for x, y, radius in problem.world.cylinders]
    return problem.replace(world=problem.world.replace(cylinders=cylinders))


def row_only() -> Problem:
    """The environment without the cylinders on the left."""
    problem = make_problem("amswarm_5")
    row = [cylinder for cylinder in problem.world.cylinders if cylinder[0] >= 0]
    return problem.replace(world=problem.world.replace(cylinders=row))


VARIANTS: Mapping[str, Callable[[], Problem]] = {
    "as it is": lambda: apart(1.0),
    "1.1 times as far apart": lambda: apart(1.1),
    "1.2 times as far apart": lambda: apart(1.2),
    "robots of 0.24 m": lambda: make_problem("amswarm_5", radius=0.24),
    "without those on the left": row_only,
}


def problems() -> dict[str, Problem]:
    """The environment and its variants, each under its own name."""
    return {name: variant().replace(name=name) for name, variant in VARIANTS.items()}


def gap(problem: Problem) -> tuple[float, float]:
    """Between the surfaces of the two cylinders in the row, and what a robot with its margin takes of it [m]."""
    centre, neighbour = problem.world.cylinders[:2]
    free = np.hypot(centre[0] - neighbour[0], centre[1] - neighbour[1]) - centre[2] - neighbour[2]
    return float(free), float(2 * (np.max(problem.team.radius) + problem.margin))


def main() -> int:
    """Run every variant, and write the table."""
    arguments = trials_parser(__doc__, seeds=10).parse_args()
    settings, seeds = (TINY, 1) if arguments.quick else (PAPER, arguments.seeds)
    there = problems()
    study = Study(policies={"d4orm-d": settings}, scenarios=tuple(there.values()), seeds=range(seeds))
    trials = study_trials(arguments, "amswarm_gaps", [study])
    rows: list[dict[str, Any]] = []
    for name, problem in there.items():
        mine = [trial for trial in trials if trial.scenario == name]
        solved = [trial for trial in mine if is_solved(trial)]
        lower, upper = wilson_interval(len(solved), len(mine))
        free, needed = gap(problem)
        makespans = [trial.makespan for trial in solved if trial.makespan is not None]
        rows.append(
            {"cylinders": name, "gap [m]": f"{free:.2f}", "a robot needs [m]": f"{needed:.2f}",
             "solved": f"{len(solved)} of {len(mine)}", "interval": f"{lower:.0%} to {upper:.0%}",
             "iterations": f"{np.median([trial.iterations for trial in mine if trial.iterations is not None]):g}",
             "makespan [s]": f"{np.mean(makespans):.2f}" if makespans else "-"}
        )  # fmt: skip
    save_table(rows, arguments.out / "amswarm_gaps.csv")
    return 0


if __name__ == "__main__":
    sys.exit(main())
