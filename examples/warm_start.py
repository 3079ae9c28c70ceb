"""A learned policy as a planner's first guess: what the team does by it is where the search begins.

    python examples/warm_start.py

Every instance is planned for twice by each planner, with nothing to begin with and from an episode of the policy "ppo"
that comes with the package. The time of the episode is counted.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from outputs import argument_parser, count, save_table

from d4orm_env import make_problem, navigation_v0
from d4orm_planners import make_planner, run_episode

CASES = (("random", 8), ("random", 16), ("circle", 8))
PLANNERS = ("d4orm-d", "d4orm")


class Outcome(NamedTuple):
    """One solve."""

    solved: bool
    iterations: int
    seconds: float
    travel_time: float


def solve(planner: str, problem: Any, seed: int, limit: float, policy: str | None) -> Outcome:
    """Plan, from an episode of a policy if there is one."""
    begin, initial = time.perf_counter(), None
    if policy is not None:
        initial = run_episode(navigation_v0.parallel_env(problem=problem), policy, seed=seed).controls
    plan = make_planner(planner).solve(problem, seed=seed, time_limit=limit, initial_controls=initial)
    return Outcome(plan.solved, plan.iterations, time.perf_counter() - begin, plan.metrics["travel_time"])


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=count, default=10, help="instances of each case")
    arguments = parser.parse_args()
    cases, planners, seeds = CASES, PLANNERS, arguments.seeds
    if arguments.quick:
        cases, planners, seeds = (("random", 4),), ("d4orm-d",), 2
    rows = []
    for planner in planners:
        for scenario, num_robots in cases:
            problems = [make_problem(scenario, num_robots, seed) for seed in range(seeds)]
            for policy in (None, "ppo"):  # both are compiled before anything is timed
                solve(planner, problems[0], 0, 1.0, policy)
            pairs = [
                [solve(planner, problem, seed, 5.0, policy) for policy in (None, "ppo")]
                for seed, problem in enumerate(problems)
            ]
            for name, outcomes in zip(("nothing", "ppo"), zip(*pairs, strict=True), strict=True):
                solved = [outcome for outcome in outcomes if outcome.solved]
                times = [outcome.travel_time for outcome in solved]
                rows.append(
                    {
                        "planner": planner,
                        "problem": f"{scenario}, {num_robots} robots",
                        "from": name,
                        "solved": f"{len(solved)} of {seeds}",
                        "iterations": f"{np.median([outcome.iterations for outcome in outcomes]):g}",
                        "time [s]": f"{np.median([outcome.seconds for outcome in outcomes]):.2f}",
                        "travel time [s]": f"{np.mean(times):.2f}" if times else "",
                    }
                )
    save_table(rows, arguments.out / "warm_start.csv")


if __name__ == "__main__":
    main()
