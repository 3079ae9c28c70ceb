"""How much the noise schedule of D4orm matters: first and last variance of the diffusion (the paper's appendix C).

    python examples/noise_schedule.py --seeds 10
    python examples/noise_schedule.py --seeds 10 --preset paper

Robots on the circle, double integrators and differential drives. ``beta_1`` sets the noise of a run's last steps,
``beta_T`` that of its first ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from outputs import argument_parser, count, plt, save_figure, save_table

from d4orm_env import Problem, make_problem
from d4orm_planners import Plan, make_planner

MODELS = {"holonomic2d": "double integrators", "differential_drive": "differential drives"}
BETA_1 = (1e-5, 1e-4, 1e-3)
BETA_T = (1e-2, 2e-2, 5e-2)
MARKERS = ("o", "s", "^")


def solve(problem: Problem, seeds: int, **settings: Any) -> list[Plan]:
    """Plans with seeds from zero on."""
    planner = make_planner("d4orm", **settings)
    return [planner.solve(problem, seed=seed, max_iterations=20) for seed in range(seeds)]


def draw(rows: list[dict[str, Any]], out: Any) -> None:
    """Iterations to the first solution against ``beta_T``, a line per ``beta_1``, a panel per model."""
    models = list(dict.fromkeys(row["model"] for row in rows))
    figure, axes = plt.subplots(1, len(models), figsize=(3.6 * len(models), 3), sharey=True, layout="constrained")
    for ax, model in zip(np.atleast_1d(axes), models):
        for beta_1, marker in zip(BETA_1, MARKERS):
            line = [row for row in rows if (row["model"], row["beta_1"]) == (model, f"{beta_1:g}")]
            if line:
                places = [float(row["beta_T"]) for row in line]
                iterations = [float(row["iterations, mean"]) for row in line]
                ax.plot(places, iterations, marker=marker, label=f"$\\beta_1$ = {beta_1:g}")
        ax.set(title=MODELS[model], xlabel="$\\beta_T$", xscale="log")
        ax.set_xticks(BETA_T, [f"{beta:g}" for beta in BETA_T])
        ax.minorticks_off()
    np.atleast_1d(axes)[0].set_ylabel("iterations to the first solution")
    np.atleast_1d(axes)[0].set_ylim(bottom=0)
    np.atleast_1d(axes)[0].legend()
    save_figure(figure, out / "noise_schedule.png")


def main() -> None:
    """Run every schedule, and write the table and the plot."""
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=count, default=5, help="plans per row")
    parser.add_argument("--robots", type=count, default=8)
    parser.add_argument("--preset", default=None, help='"paper" for the paper\'s other parameters')
    arguments = parser.parse_args()
    seeds, robots, first, last = arguments.seeds, arguments.robots, BETA_1, BETA_T
    if arguments.quick:
        seeds, robots, first, last = 1, 4, BETA_1[1:2], BETA_T[::2]
    rows = []
    for model in MODELS:
        problem = make_problem("circle", num_robots=robots, model=model)
        for beta_1 in first:
            for beta_t in last:
                plans = solve(problem, seeds, preset=arguments.preset, beta_start=beta_1, beta_end=beta_t)
                rows.append(
                    {
                        "model": model,
                        "beta_1": f"{beta_1:g}",
                        "beta_T": f"{beta_t:g}",
                        "solved": f"{sum(plan.solved for plan in plans)} of {seeds}",
                        "iterations, mean": f"{np.mean([plan.iterations for plan in plans]):.1f}",
                        "seconds, median": f"{np.median([plan.wall_time for plan in plans]):.2f}",
                        "travel time [s]": f"{np.mean([plan.metrics['travel_time'] for plan in plans]):.2f}",
                    }
                )
                print(rows[-1], flush=True)
    save_table(rows, arguments.out / "noise_schedule.csv")
    draw(rows, arguments.out)


if __name__ == "__main__":
    main()
