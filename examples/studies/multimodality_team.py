"""Kinds of solution that planners find for a whole team on a circle (the paper's appendix A, its harder problem).

    python -m examples.studies multimodality_team --seeds 30

One solve per seed and planner. Robots that change places on a circle meet pairwise, and pass each other on one side or
the other: a plan's class is the sign of the angle that each robot sweeps around each other one, 28 signs with eight
robots. The table has how many seeds were solved, how many classes the solutions are of, how many pairs of solutions are
of the same class, and how far apart two solutions are (root mean square distance of the robots' places over time, mean
over all pairs). The plot has all solutions along the directions in which they differ most.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from examples.outputs import count, plt, save_figure, save_table, study_parser, study_rows
from examples.studies.multimodality import PLANNERS, Row, path_of, principal_components, solutions, solve, winding

from d4orm_env import make_problem


def signature(positions: np.ndarray) -> tuple[bool, ...]:
    """Return, for every pair of robots of a plan ``(T, K, 2)``, whether the one goes round the other anticlockwise."""
    pairs = combinations(range(positions.shape[1]), 2)
    return tuple(winding(positions[:, second] - positions[:, first]) > 0 for first, second in pairs)


def row_of(label: str, rows: Sequence[Row]) -> dict[str, Any]:
    """The table's row of a planner."""
    plans = solutions(rows, label)
    paths = [path_of(plan) for plan in plans]
    classes, pairs = [signature(path) for path in paths], list(combinations(range(len(plans)), 2))
    same = sum(classes[one] == classes[other] for one, other in pairs)
    apart = [np.sqrt(((paths[one] - paths[other]) ** 2).sum(axis=2).mean()) for one, other in pairs]
    times = [plan["travel_time"] for plan in plans]
    return {
        "planner": label,
        "solved": f"{len(plans)} of {sum(row['planner'] == label for row in rows)}",
        "classes": len(set(classes)),
        "pairs of one class": f"{same / len(pairs):.0%}" if pairs else "-",
        "distance [m]": f"{np.mean(apart):.2f}" if pairs else "-",
        "travel time [s]": f"{np.mean(times):.2f}" if times else "-",
    }


def draw(rows: Sequence[Row], out: Any) -> None:
    """All planners' solutions along the principal components of all of them together."""
    found = {label: solutions(rows, label) for label in PLANNERS}
    points, shares = principal_components([path_of(plan) for plans in found.values() for plan in plans])
    figure, axis = plt.subplots(figsize=(5.5, 4.5), layout="constrained")
    first = 0
    for marker, (label, plans) in zip("o^s", found.items(), strict=True):
        part = points[first : first + len(plans)]
        first += len(plans)
        axis.plot(*part.T, marker, label=label, alpha=0.7, markersize=5, markeredgewidth=0)
    axis.set(
        xlabel=f"first principal component [m], {shares[0]:.0%} of the variance",
        ylabel=f"second principal component [m], {shares[1]:.0%} of the variance",
    )
    axis.legend()
    save_figure(figure, out / "multimodality_team.png")


def main() -> None:
    """Solve with every planner and seed, count the classes, write the table and the plot."""
    parser = study_parser(__doc__, seeds=30)
    parser.add_argument("--num-robots", "--robots", type=count, default=8, help="size of the team")
    arguments = parser.parse_args()
    seeds, num_robots = (4, 3) if arguments.quick else (arguments.seeds, arguments.num_robots)
    problem = make_problem("paper_circle", num_robots=num_robots)
    plans = partial(solve, problem, seeds, max_iterations=20, time_limit=120)
    rows = study_rows(arguments, "multimodality_team", plans)
    save_table([row_of(label, rows) for label in PLANNERS], arguments.out / "multimodality_team.csv")
    draw(rows, arguments.out)
