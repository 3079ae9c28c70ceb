"""Samples that turn each other's noise, against samples drawn apart.

    python -m examples.studies independent_noise --seeds 20

The engines draw one sample of four, and turn its noise by 90, 180 and 270 degrees for the others; the paper draws all
apart. One run of D4orm's preset from zero controls on the paper's circle by either, with as many samples: the reward of
its result, and how likely such a difference is without a cause (Mann-Whitney, two-sided).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from examples.common import grouped, save_table, study_parser, study_rows
from scipy.stats import mannwhitneyu

from d4orm_env import Problem, make_problem, rollout
from d4orm_env.core.arrays import FloatArray
from d4orm_planners import make_planner
from d4orm_planners.engine.sampling_types import SamplingTask, get_sampling_engine
from d4orm_planners.evaluation.summary import mean_interval
from d4orm_planners.reference import denoise_around_rest
from d4orm_planners.sampling.loop import SamplingPlanner

Rows = list[dict[str, Any]]

TEAMS = ((8, 128), (8, 1024), (16, 128))
"""Robots and samples."""


def turned(problem: Problem, planner: SamplingPlanner, num_samples: int, seed: int) -> FloatArray:
    """Denoise with three of four samples turned."""
    zero = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    task, noise_scale = SamplingTask(problem, zero, credit="team"), planner.noise_scale()
    return get_sampling_engine("cpu").denoise(task, planner.rules(), zero, noise_scale, num_samples, seed).mean


def apart(problem: Problem, planner: SamplingPlanner, num_samples: int, seed: int) -> FloatArray:
    """Denoise with every sample drawn by itself."""
    return denoise_around_rest(problem, planner.noise_scale(), num_samples, planner.config.temperature, seed)


def measure(teams: Any, seeds: int, **settings: Any) -> Rows:
    """A row of every team, noise and seed."""
    rows, planner = [], make_planner("d4orm", preset="paper", **settings)
    for robots, samples in teams:
        problem = make_problem("paper_circle", num_robots=robots)
        for draw in (turned, apart):
            for seed in range(seeds):
                result = rollout(problem, draw(problem, planner, samples, seed), engine="cpu")
                rows.append(
                    {"robots": robots, "samples": samples, "noise": draw.__name__, "seed": seed,
                     "reward": float(result.rewards.mean()), "arrived": float(result.arrived[-1].mean())}
                )  # fmt: skip
            print(rows[-1], flush=True)
    return rows


def summary(rows: Rows) -> Rows:
    """A row per team."""
    table = []
    for (robots, samples), own in grouped(rows, "robots", "samples").items():
        rewards = {draw: [row["reward"] for row in drawn] for (draw,), drawn in grouped(own, "noise").items()}
        shown = {"robots": robots, "samples": samples, "seeds": len(rewards["turned"])}
        for draw, values in rewards.items():
            mean, lower, upper = mean_interval(values)
            shown[f"reward, {draw}"] = f"{mean:.3f}" + (f" ({lower:.3f} to {upper:.3f})" if lower is not None else "")
        table.append(shown | {"p": mannwhitneyu(rewards["turned"], rewards["apart"]).pvalue})
    return table


def main() -> None:
    arguments = study_parser(__doc__, seeds=20).parse_args()
    measured = partial(measure, TEAMS, arguments.seeds)
    if arguments.quick:
        measured = partial(measure, ((2, 64),), 1, num_steps=5)
    rows = study_rows(arguments, "independent_noise", measured)
    save_table(summary(rows), arguments.out / "independent_noise.csv")
