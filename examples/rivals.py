"""D4orm against MPPI, CEM, i-MBD and MBD on the same problems, engine and number of sampled trajectories.

    python examples/rivals.py --seeds 20

Every method has the paper's settings (1024 samples, 100 steps an iteration, team weights); ``d4orm (default)`` has this
project's. All keep improving after their first solution until the same number of trajectories is sampled, so one run
gives the first solution, the success within every budget, and the reward against steps. MBD has one run for all of it.
Steps are counted in units of 1024 samples. Times are wall times, compilation not counted.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from outputs import COLOURS, argument_parser, count, plt, save_figure, save_table

from d4orm_env import Problem, make_problem, verify
from d4orm_planners import make_planner

PAPER_STEPS, PAPER_SAMPLES = 100, 1024

METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "d4orm": ("d4orm", {"preset": "paper"}),
    "d4orm (default)": ("d4orm", {}),
    "mppi": ("mppi", {"preset": "paper"}),
    "cem": ("cem", {"preset": "paper"}),
    "i-mbd": ("i-mbd", {"preset": "paper"}),
    "mbd": ("mbd", {"preset": "paper"}),
}
"""Label: planner and settings."""

COLOUR = {**COLOURS, "d4orm (default)": COLOURS["default"], "mbd": "#7F7F7F"}

TEAMS: dict[str, tuple[dict[str, Any], int]] = {
    "8 holonomic": ({"num_robots": 8}, 6),
    "16 holonomic": ({"num_robots": 16}, 10),
    "8 differential drive": ({"num_robots": 8, "model": "differential_drive"}, 6),
    "8 in space": ({"num_robots": 8, "model": "holonomic3d"}, 6),
}
"""Label: circle scenario's arguments, and how many of the paper's iterations every method may spend."""


class Run(NamedTuple):
    """One solve: after every iteration, the steps (of 1024 samples) so far, the candidate's reward, solved or not."""

    steps: np.ndarray
    rewards: np.ndarray
    solved: np.ndarray
    seconds: np.ndarray

    @property
    def first(self) -> int | None:
        """Index of the first iteration with a solution."""
        return int(self.solved.argmax()) if self.solved.any() else None


def solve(method: str, problem: Problem, seed: int, iterations: int, engine: str) -> Run:
    """Spend the budget of ``iterations`` of the paper's with one method."""
    name, settings = METHODS[method]
    if method == "mbd":
        planner = make_planner(name, **{**settings, "num_steps": iterations * PAPER_STEPS}, engine=engine)
    else:
        planner = make_planner(name, **settings, improve=True, engine=engine)
    config: Any = planner.config
    # A step of half the samples is half a step.
    saved = getattr(config, "late_steps", 0.0) * (1 - getattr(config, "late_samples", 1.0))
    share = config.num_samples * (1 - saved) / PAPER_SAMPLES
    limit = max(1, round(iterations * PAPER_STEPS / (config.num_steps * share)))
    plan = planner.solve(problem, seed=seed, max_iterations=limit)
    if plan.solved and not verify(problem, plan.controls).ok:
        raise RuntimeError(f"{method}, seed {seed}: the plan counts as solved, but verify() finds contact")
    return Run(
        np.array([record.denoising_steps for record in plan.history]) * share,
        np.array([record.reward for record in plan.history]),
        np.array([record.solved for record in plan.history]),
        np.array([record.wall_time for record in plan.history]),
    )


def median_or_none(values: list[float], solved: int, tries: int, digits: int) -> str:
    """Median over all tries, where those without a solution count as infinitely late."""
    if 2 * solved <= tries:
        return "> budget"
    return f"{np.median(values + [np.inf] * (tries - solved)):.{digits}f}"


def summary(team: str, method: str, runs: list[Run]) -> dict[str, Any]:
    """The table's row of one method on one team."""
    firsts = [(run, run.first) for run in runs if run.first is not None]
    steps = [float(run.steps[first]) for run, first in firsts]
    return {
        "team": team,
        "method": method,
        "solved": f"{len(firsts)} of {len(runs)}",
        "steps to first (median)": median_or_none(steps, len(firsts), len(runs), 0),
        "steps to first (most)": f"{max(steps):.0f}" if steps else "",
        "seconds to first (median)": median_or_none(
            [float(run.seconds[first]) for run, first in firsts], len(firsts), len(runs), 2
        ),
        "reward, first iteration": f"{np.mean([run.rewards[0] for run in runs]):.3f}",
        "reward, last iteration": f"{np.mean([run.rewards[-1] for run in runs]):.3f}",
    }


def draw(results: dict[str, dict[str, list[Run]]], out: Any) -> None:
    """Success (top) and reward (bottom) against steps, one column per team."""
    figure, axes = plt.subplots(
        2, len(results), figsize=(3.1 * len(results), 5), sharex="col", squeeze=False, layout="constrained"
    )
    for column, (team, by_method) in enumerate(results.items()):
        for method, runs in by_method.items():
            colour = COLOUR[method]
            marker = {"marker": "s", "linestyle": "none"} if method == "mbd" else {"marker": ".", "markersize": 5}
            steps = runs[0].steps
            success = np.mean([np.maximum.accumulate(run.solved) for run in runs], axis=0)
            reward = np.mean([run.rewards for run in runs], axis=0)
            axes[0, column].plot(steps, success, color=colour, label=method, **marker)
            axes[1, column].plot(steps, reward, color=colour, **marker)
        axes[0, column].set(title=team, ylim=(-0.04, 1.04))
        axes[1, column].set_xlabel("denoising steps of 1024 samples")
    axes[0, 0].set_ylabel("share solved so far")
    axes[1, 0].set_ylabel("reward of the iteration's result")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 2 * len(results)))
    save_figure(figure, out / "rivals.png")


def main() -> None:
    """Run every method on every team and seed, and write the table and the plot."""
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=count, default=20, help="seeds per team and method")
    parser.add_argument("--teams", nargs="+", choices=TEAMS, default=list(TEAMS))
    parser.add_argument("--engine", default="auto")
    arguments = parser.parse_args()
    teams, seeds = {team: TEAMS[team] for team in arguments.teams}, arguments.seeds
    if arguments.quick:
        teams, seeds = {"8 holonomic": ({"num_robots": 8}, 2)}, 2
    results: dict[str, dict[str, list[Run]]] = {}
    for team, (settings, iterations) in teams.items():
        problem = make_problem("circle", **settings)
        results[team] = {}
        for method in METHODS:
            results[team][method] = [
                solve(method, problem, seed, iterations, arguments.engine) for seed in range(seeds)
            ]
            print(summary(team, method, results[team][method]), flush=True)
        # After every team, so that stopping early leaves the teams done so far.
        rows = [summary(team, method, runs) for team, by in results.items() for method, runs in by.items()]
        save_table(rows, arguments.out / "rivals.csv")
        draw(results, arguments.out)


if __name__ == "__main__":
    main()
