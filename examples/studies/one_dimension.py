"""MPPI against MBD in one dimension: what annealing the noise does (the paper's illustration, section IV-A).

    python -m examples.studies one_dimension

Both maximise the same function with many local maxima, with the same softmax over the same number of samples a step.
MPPI samples with one standard deviation throughout, small or large; MBD's falls along the diffusion schedule: it looks
around first and settles at the end. The schedule and the weights are the planners' own.

A second table is of a function that traps: how often MBD, with more and more steps, and D4orm, with more and more
iterations of MBD, end at its optimum.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from examples.common import COLOURS, argument_parser, count, plt, save_figure, save_table

from d4orm_planners.sampling.settings import annealed, constant
from d4orm_planners.sampling.weights import SoftmaxWeights

START = -2.5
Objective: TypeAlias = Callable[[Any], Any]


def reward(x: Any) -> Any:
    """A broad hill with ripples: about ten local maxima on [-4, 4], the highest near 1.6."""
    return -0.12 * (x - 1.5) ** 2 + 0.5 * np.cos(5 * x - 8) + 0.2 * np.cos(11 * x - 17.6)


def trap(x: Any) -> Any:
    """A broad hill where the search starts, and a higher, narrow one four on."""
    return np.exp(-((x - START) ** 2) / 2) + 1.5 * np.exp(-((x - START - 4) ** 2) / (2 * 0.15**2))


class Run(NamedTuple):
    """The mean before every step and after the last ``(N + 1,)``, and the samples of every step ``(N, M)``."""

    means: np.ndarray
    samples: np.ndarray


def optimise(noise_scale: np.ndarray, num_samples: int, seed: int, objective: Objective = reward) -> Run:
    """Sample, weight and average once per entry of the schedule."""
    random = np.random.default_rng(seed)
    weigh = SoftmaxWeights(temperature=0.3)
    means, samples = [START], []
    for sigma in noise_scale:
        x = means[-1] + sigma * random.standard_normal(num_samples)
        samples.append(x)
        means.append(float(weigh(objective(x), np) @ x))
    return Run(np.array(means), np.array(samples))


def trapped(steps: int, num_samples: int, seeds: int) -> list[dict[str, Any]]:
    """How often MBD and D4orm reach the top of the trap's higher hill, by their steps in all."""
    rows = []
    for times in (1, 2, 4, 8):
        scales = {"MBD": annealed(times * steps, 1e-4, 2e-2), "D4orm": np.tile(annealed(steps, 1e-4, 2e-2), times)}
        for name, scale in scales.items():
            final = np.array([optimise(scale, num_samples, seed, trap).means[-1] for seed in range(seeds)])
            share = f"{(abs(final - START - 4) < 0.1).mean():.0%}"
            iterations = times if name == "D4orm" else 1
            rows.append({"method": name, "steps": len(scale), "iterations": iterations, "at the optimum": share})
    return rows


def draw(runs: dict[str, Run], scales: dict[str, np.ndarray], best: float, out: Any) -> None:
    """Top: the function. Below, per method: the samples and the mean at every step."""
    figure, axes = plt.subplots(
        1 + len(runs), 1, figsize=(6, 1.6 + 1.7 * len(runs)), sharex=True, layout="constrained",
        height_ratios=[1] + [1.25] * len(runs),
    )  # fmt: skip
    x = np.linspace(-5, 5, 2000)
    axes[0].plot(x, reward(x), color="black", linewidth=1)
    axes[0].plot(best, reward(best), "*", color="#E69F00", markersize=10)
    axes[0].set(ylabel="reward", xlim=(-5, 5))
    for panel, (name, run) in zip(axes[1:], runs.items(), strict=True):
        colour = COLOURS["d4orm"] if name == "MBD" else COLOURS["mppi"]
        for step, samples in enumerate(run.samples):
            panel.plot(samples, np.full(len(samples), step), ".", color=colour, alpha=0.08, markersize=3)
        panel.plot(run.means, np.arange(len(run.means)), color="black", linewidth=1)
        panel.axvline(best, color="#E69F00", linewidth=1, linestyle="--")
        first, last = scales[name][[0, -1]]
        spread = f"standard deviation {first:g}" if first == last else f"standard deviation {first:.2f} to {last:.2f}"
        panel.set_title(f"{name}, {spread}", fontsize=9, loc="left")
        panel.set(ylabel="step")
        panel.invert_yaxis()
    axes[-1].set_xlabel("x    (samples in colour, their weighted mean in black, the optimum dashed)")
    save_figure(figure, out / "one_dimension.png")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=count, default=200)
    parser.add_argument("--steps", type=count, default=50)
    parser.add_argument("--samples", type=count, default=100)
    arguments = parser.parse_args()
    seeds = 20 if arguments.quick else arguments.seeds
    grid = np.linspace(-5, 5, 200_001)
    best = float(grid[reward(grid).argmax()])
    scales = {
        "MPPI, small noise": constant(arguments.steps, 0.15),
        "MPPI, large noise": constant(arguments.steps, 1.0),
        "MBD": annealed(arguments.steps, 1e-4, 2e-2),
    }
    rows, shown = [], {}
    for name, scale in scales.items():
        runs = [optimise(scale, arguments.samples, seed) for seed in range(seeds)]
        shown[name] = runs[0]
        final = np.array([run.means[-1] for run in runs])
        last_move = np.array([abs(run.means[-1] - run.means[-2]) for run in runs])
        rows.append(
            {
                "method": name,
                "within 0.1 of the optimum": f"{(abs(final - best) < 0.1).mean():.0%}",
                "short of the best reward": f"{reward(best) - reward(final).mean():.3f}",
                "movement in the last step": f"{last_move.mean():.4f}",
            }
        )
    save_table(rows, arguments.out / "one_dimension.csv")
    save_table(trapped(arguments.steps, arguments.samples, seeds), arguments.out / "one_dimension_trap.csv")
    draw(shown, scales, best, arguments.out)
