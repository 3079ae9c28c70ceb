"""How coarse the guidance of D4orm-C2F may be: larger time steps and sparser checks (the paper's appendix C).

    python examples/coarse_to_fine.py --seeds 5

16 robots among four obstacles. ``f`` is how many times longer the steps of the coarse plan are, and it is checked for
violations at every ``o``-th of them. Each is run without refinement, to see what the guidance itself is worth, and with
the default refinement in the background. The runtime is that of the first coarse plan.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from outputs import argument_parser, count, save_table

from d4orm_env import Problem, make_problem, navigation_v0
from d4orm_planners import make_policy, run_episode

COARSENESS = ((1, 1), (2, 1), (3, 1), (4, 1), (1, 5), (1, 10))
"""``(f, o)`` as in the paper's table."""

REFINEMENTS = ("off", "background")


def episodes(problem: Problem, seeds: int, **settings: Any) -> dict[str, Any]:
    """The part of a table's row that is measured: episodes with seeds from zero on."""
    policy: Any = make_policy("d4orm-c2f", **settings)
    env = navigation_v0.parallel_env(problem=problem)
    metrics, coarse = [], []
    for seed in range(seeds):
        metrics.append(run_episode(env, policy, seed=seed).metrics)
        coarse.append(policy.coarse_time)
    solved = [numbers for numbers in metrics if numbers["success"]]

    def mean(name: str) -> str:
        return f"{np.mean([numbers[name] for numbers in solved]):.2f}" if solved else ""

    return {
        "coarse plan, median [s]": f"{np.median(coarse):.2f}",
        "coarse plan, most [s]": f"{max(coarse):.2f}",
        "average travel time [s]": mean("travel_time"),
        "makespan [s]": mean("makespan"),
        "success": f"{len(solved)} of {seeds}",
    }


def main() -> None:
    """Run every coarseness, and write the table after each."""
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=count, default=2, help="episodes per row")
    parser.add_argument("--robots", type=count, default=16)
    arguments = parser.parse_args()
    num_robots, seeds, coarseness = arguments.robots, arguments.seeds, COARSENESS
    if arguments.quick:
        num_robots, seeds, coarseness = 4, 1, ((1, 1), (4, 1))
    problem = make_problem("four_obstacles", num_robots=num_robots)
    # Compile first, so that no row pays for it.
    episodes(problem, 1, coarse_factor=2)
    rows = []
    for factor, interval in coarseness:
        for refine in REFINEMENTS:
            measured = episodes(problem, seeds, coarse_factor=factor, check_interval=interval, refine=refine)
            rows.append({"f": factor, "o": interval, "refine": refine, **measured})
            print(rows[-1], flush=True)
    save_table(rows, arguments.out / "coarse_to_fine.csv")


if __name__ == "__main__":
    main()
