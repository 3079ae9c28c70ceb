"""Reinforcement learning with several seeds: curves of PPO and SAC with 95% intervals of the mean (Student's t).

    python -m examples.studies training_seeds --seeds 3
    python -m examples.studies training_seeds --trials examples/studies/data/training_seeds.parquet

Trains every learner with every seed, one after another: about three hours of one core. Broken off, it goes on where it
was. With ``--trials`` it trains nothing, and makes table and picture of a file that it wrote before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from examples.common import (
    COLOURS,
    grouped,
    plt,
    require,
    save_figure,
    save_table,
    study_parser,
    study_rows,
    success_of_seeds,
)

require("rl", "stable_baselines3", "tensorboard")

from d4orm_planners.evaluation.summary import mean_interval
from d4orm_planners.rl.training import TrainingSettings, train

CROWDS = TrainingSettings(
    network="sets", mixture=("crowds",), observed_robots=8, num_envs=1536, steps=6_000_000, stages=12,
    learning_rate=5e-4, validation_worlds=330,
)  # fmt: skip
LEARNERS: Mapping[str, TrainingSettings] = {
    "PPO, holonomic2d, crowds": replace(CROWDS, model="holonomic2d"),
    "PPO, differential_drive, crowds": replace(CROWDS, model="differential_drive"),
    "PPO, holonomic2d, walls": replace(
        CROWDS, mixture=("walls",), shortest_paths=True, stages=6, validation_worlds=210
    ),
    "SAC, holonomic2d, crowds": TrainingSettings(
        algorithm="sac",
        network="sets",
        mixture=("crowds",),
        observed_robots=6,
        num_envs=64,
        steps=1_500_000,
        stages=10,
        learner_settings={"gradient_steps": 12},
        validation_worlds=330,
    ),
    "SAC, holonomic2d, 4 random robots": TrainingSettings(
        algorithm="sac", num_robots=4, steps=400_000, stages=10, curriculum=True
    ),
}
QUICK = {"steps": 256, "stages": 2, "validation_worlds": 2, "num_envs": 16}
Rows = Sequence[Mapping[str, Any]]


def measure(seeds: int, out: Path, quick: bool) -> list[dict[str, Any]]:
    """A row per learner, seed and stage."""
    rows = []
    for learner, settings in LEARNERS.items():
        for seed in range(seeds):
            chosen = replace(settings, seed=seed)
            if quick:
                chosen = replace(chosen, **QUICK, mixture=("random 2", "circle 2") if chosen.mixture else ())
            folder = out / f"{learner.lower().replace(', ', '-').replace(' ', '-')}-{seed}"
            print(f"{learner}, seed {seed}", flush=True)
            rows += [
                {"learner": learner, "seed": seed, "steps": point.steps, "success": point.success_rate,
                 "travel_time": point.travel_time, "seconds": point.seconds, "env_share": point.env_share}
                for point in train(chosen, folder).curve
            ]  # fmt: skip
    return rows


def summary(rows: Rows) -> list[dict[str, object]]:
    """A row per learner: what its seeds came to in the end, and what they took."""
    table: list[dict[str, object]] = []
    for (learner,), every in grouped(rows, "learner").items():
        steps = max(row["steps"] for row in every)
        last = [row for row in every if row["steps"] == steps]
        ends = [100 * row["success"] for row in last]
        row = {
            "learner": learner,
            "seeds": len(last),
            "robot-steps": f"{steps / 1e6:.1f} million",
            **success_of_seeds(ends, "success in the end"),
            "travel time [s]": f"{np.mean([one['travel_time'] for one in last]):.2f}",
            "environment's share": f"{np.mean([one['env_share'] for one in every]):.0%}",
        }
        table.append(row)
    return table


def draw(rows: Rows, path: Path) -> None:
    """Every seed thin, their mean thick, and its interval."""
    found = grouped(rows, "learner")
    figure, axes = plt.subplots(1, len(found), figsize=(3.6 * len(found), 3), sharey=True, squeeze=False)
    for axis, ((learner,), own), colour in zip(axes[0], found.items(), COLOURS.values(), strict=False):
        stages = dict(sorted(grouped(own, "steps").items()))
        steps = np.array([number for (number,) in stages]) / 1e6
        seeds = np.array([[100 * row["success"] for row in stage] for stage in stages.values()])
        ends = [mean_interval(values) for values in seeds.tolist()]
        axis.plot(steps, seeds, color=colour, linewidth=0.7, alpha=0.6)
        axis.plot(steps, seeds.mean(axis=1), color=colour, linewidth=2)
        if all(lower is not None for _, lower, _ in ends):
            lower, upper = (np.array([end[side] for end in ends], float) for side in (1, 2))
            axis.fill_between(steps, lower, upper, color=colour, alpha=0.15, linewidth=0)
        axis.set(title=learner, xlabel="robot-steps [million]", ylim=(0, 100))
    axes[0, 0].set_ylabel("success on validation instances [%]")
    figure.tight_layout()
    save_figure(figure, path)


def main() -> None:
    arguments = study_parser(__doc__, seeds=3).parse_args()
    trainings = partial(measure, arguments.seeds, arguments.out, arguments.quick)
    rows = study_rows(arguments, "training_seeds", trainings)
    save_table(summary(rows), arguments.out / "training_seeds.csv")
    draw(rows, arguments.out / "training_seeds.png")
