"""The paper as written, its authors' published code and this project's defaults, on the same instances.

    python -m examples.studies.head_to_head --seeds 20 --out head_to_head

D4orm and D4orm-D by their presets `paper` and `authors` and by their defaults (ours), at most 20 iterations: 16 robots
on the paper's circle, and by D4orm-D 64 random ones (5 seeds) and 16 among its four obstacles (10). On the circle also
D4orm-D by the preset `authors` with one of its differences from the paper taken back at a time (10), and D4orm by the
preset `paper` with higher penalties (10, against penalty 1). Other tests are against the preset `authors`; see
:func:`examples.outputs.first_solutions` for the columns. Iterations are a mean over the successes.

With `--checkout FOLDER`, a checkout of proroklab/d4orm at 8ea43d73, that code itself is run too, on the instances of
the same seeds, and needs its own requirements; its rows are printed and not kept.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from examples.outputs import first_solutions, save_table, study_trials, trials_parser

from d4orm_planners.evaluation.comparison import is_solved
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.study import Study

ITERATIONS = 20
Settings = Mapping[str, dict[str, Any]]
PAPER, AUTHORS = {"preset": "paper"}, {"preset": "authors"}
D4ORM: Settings = {
    "d4orm, authors": {"policy": "d4orm", **AUTHORS},
    "d4orm, paper": {"policy": "d4orm", **PAPER},
    "d4orm, ours": {"policy": "d4orm"},
}
D4ORM_D: Settings = {
    "d4orm-d, authors": {"policy": "d4orm-d", **AUTHORS},
    "d4orm-d, paper": {"policy": "d4orm-d", **PAPER},
    "d4orm-d, ours": {"policy": "d4orm-d"},
}
PENALTIES: Settings = {
    f"d4orm, paper, penalty of {penalty:g}": {"policy": "d4orm", **PAPER, "penalty": penalty} for penalty in (2.0, 4.0)
}
"""Higher penalties with the team's credit, which the paper says do not help (section IV-C)."""
DIFFERENCES: Settings = {
    "authors, penalty once a step": {"penalty_per_pair": False},
    "authors, penalty of 1 throughout": {"penalty_rise": 0.0},
    "authors, controls of the probe kept": {"reset_after_probe": False},
    "authors, never clipped": {"clip_after": None},
    "authors, straight start": {"start": "straight"},
    "paper, penalty per pair": {**PAPER, "penalty_per_pair": True},
}
"""D4orm-D with one difference taken back, and the groups one after the other, as in the paper."""


class Comparison(NamedTuple):
    """Settings on one team, and the label of those that they are compared with there."""

    scenario: str
    num_robots: int
    settings: Settings
    reference: str = "d4orm-d, authors"
    seeds: int = 20


COMPARISONS = (
    Comparison("paper_circle", 16, D4ORM, "d4orm, authors"),
    Comparison("paper_circle", 16, PENALTIES, "d4orm, paper", seeds=10),
    Comparison("paper_circle", 16, D4ORM_D),
    Comparison(
        "paper_circle",
        16,
        {label: {"policy": "d4orm-d", **AUTHORS, **own} for label, own in DIFFERENCES.items()},
        seeds=10,
    ),
    Comparison("paper_random", 64, D4ORM_D, seeds=5),
    Comparison("paper_obstacles", 16, D4ORM_D, seeds=10),
)
THEIR_ENVIRONMENTS = {
    "paper_circle": "multi2dholo", "paper_obstacles": "multi2dholo_obs4", "paper_random": "multi2dholo_random",
}  # fmt: skip
"""The code's own names of these scenarios."""


def studies(seeds: int, own: dict[str, Any], robots: int | None = None) -> list[Study]:
    """Every comparison with so many seeds at most, of so many ``robots`` if that is given."""
    return [
        Study(
            policies={
                label: {"engine": "cpu", "max_iterations": ITERATIONS, **settings, **own}
                for label, settings in compared.settings.items()
            },
            scenarios=(compared.scenario,),
            num_robots=(robots or compared.num_robots,),
            seeds=range(min(seeds, compared.seeds)),
        )
        for compared in COMPARISONS
    ]


def mean_iterations(trials: Sequence[Trial]) -> str:
    """Mean of the solved trials."""
    solved = [trial.iterations for trial in trials if is_solved(trial) and trial.iterations is not None]
    return f"{np.mean(solved):.1f}" if solved else "-"


def runs_of(checkout: Path, scenario: str, num_robots: int, seeds: int) -> Iterator[dict[str, Any]]:
    """A row for each planner of the authors' code: how often it solves this team, and in how many iterations."""
    sys.path.insert(0, str(checkout))
    jax, envs = import_module("jax"), import_module("d4orm.envs")
    core, diffusion, decoupled = (
        import_module(f"d4orm.planners.{name}") for name in ("core", "diffusion", "decoupled")
    )
    for kind in (diffusion.D4ORMPlanner, decoupled.D4ORMDPlanner):
        results = []
        for seed in range(seeds):
            environment = envs.get_env(THEIR_ENVIRONMENTS[scenario], num_robots, seed=seed)
            planner = kind(core.Rollout(environment), core.PlannerConfig(max_iterations=ITERATIONS))
            key, start = jax.random.split(jax.random.PRNGKey(seed))
            results.append(planner.plan(key, environment.reset(start), environment.xg))
        solved = [result.iterations for result in results if result.success]
        iterations = f"{np.mean(solved):.1f}" if solved else "-"
        yield {
            "team": f"{scenario}, {num_robots} robots", "their planner": kind.__name__,
            "solved": f"{len(solved)} of {seeds}", "iterations": iterations,
        }  # fmt: skip


def main() -> int:
    """Run everything, and write the table."""
    parser = trials_parser(__doc__, seeds=20)
    parser.add_argument("--checkout", type=Path, help="folder of the authors' code, to run it too")
    arguments = parser.parse_args()
    tiny = (1, {"max_iterations": 2, "num_steps": 10, "num_samples": 64}, 2)
    trials = study_trials(
        arguments, "head_to_head", studies(*tiny) if arguments.quick else studies(arguments.seeds, {})
    )
    rows = []
    for compared in COMPARISONS:
        there = {
            label: [trial for trial in trials if (trial.scenario, trial.label) == (compared.scenario, label)]
            for label in (compared.reference, *compared.settings)
        }
        groups = {label: group for label, group in there.items() if group}
        (num_robots,) = {trial.num_robots for group in groups.values() for trial in group}
        solutions = first_solutions(f"{compared.scenario}, {num_robots} robots", "planner", groups, compared.reference)
        rows += [
            {**dict(list(row.items())[:4]), "iterations": mean_iterations(groups[row["planner"]]), **row}
            for row in solutions
            if row["planner"] in compared.settings
        ]
    save_table(rows, arguments.out / "head_to_head.csv")
    if arguments.checkout is not None:
        for scenario, num_robots in dict.fromkeys((compared.scenario, compared.num_robots) for compared in COMPARISONS):
            for row in runs_of(arguments.checkout, scenario, num_robots, arguments.seeds):
                print(row, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
