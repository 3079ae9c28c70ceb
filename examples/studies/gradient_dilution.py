"""Dilution of each robot's signal in the team's common reward, and the effect of a reward of its own.

    python -m examples.studies gradient_dilution --seeds 20

One iteration of the paper's denoising (1024 samples, 100 steps) for teams of 1 to 64 robots that cross a circle. Robots
do not see each other, so every robot has the same easy task whatever the size of the team, and what differs is whose
reward weights a robot's part of the samples: the team's (the paper), that of a group of four, or its own.

Rewards are normalised over the samples before they become weights, so how unequal weights are does not depend on whose
rewards they are. What does is what they say about one robot. The reward of ``g`` robots, each of which fares
independently, has a correlation of ``1 / sqrt(g)`` with that of one of them; so a robot's own normalised reward,
averaged with the weights, is ``1 / sqrt(g)`` of that of all ``g``, which for rewards with a normal distribution depends
on the temperature and the number of samples alone. The table sets this theory beside what the first denoising step
measures, and tells what comes of it after all of them. With samples in proportion to the team, the team's reward gets
as much computing per robot as a robot would have alone, were all robots' samples drawn apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import numpy as np
from examples.common import COLOURS, grouped, plt, save_figure, save_table, study_parser, study_rows
from examples.studies import AS_IN_THE_PAPER

from d4orm_env import Problem, make_problem
from d4orm_planners.engine.sampling_types import SamplingRules, SamplingTask, get_sampling_engine
from d4orm_planners.evaluation.summary import mean_interval
from d4orm_planners.sampling.settings import annealed
from d4orm_planners.sampling.weights import GroupWeights, SoftmaxWeights

Rows = list[dict[str, Any]]

SIZES, NUM_SAMPLES, NUM_STEPS = (1, 2, 4, 8, 16, 32, 64), 1024, 100
TEMPERATURE = 0.3
GROUP = 4
MORE, MOST_WITH_MORE = "team, samples in proportion", 16
STYLES = {"team": "mppi", "group": "cem", "robot": "d4orm", MORE: "default"}
NAMES = {"group": f"groups of {GROUP}"}
LEAST = {"team": 2, "group": 2 * GROUP, "robot": 1, MORE: 2}
"""The smallest team in which weights by this reward differ from those of the rows before."""


def crossing(num_robots: int) -> Problem:
    """Robots on a circle of 5 m, small enough that 64 of them stand on it without touching."""
    return make_problem("circle", num_robots=num_robots, diameter=5.0, radius=0.02, margin=0.01, **AS_IN_THE_PAPER)


def robots_that_share(credit: str, num_robots: int) -> int:
    """Return the number of robots whose rewards weight one robot's part of the samples."""
    return {"group": min(GROUP, num_robots), "robot": 1}.get(credit, num_robots)


class Watched(GroupWeights):
    """Weights by group, which keep what the first step's were."""

    def __init__(self, num_robots: int, share: int) -> None:
        groups = tuple(tuple(range(first, first + share)) for first in range(0, num_robots, share))
        super().__init__(SoftmaxWeights(TEMPERATURE), groups)
        self.first: dict[str, float] = {}

    def __call__(self, rewards: Any, xp: Any, log_ratio: Any = None) -> Any:
        weights = super().__call__(rewards, xp, log_ratio)
        if not self.first:
            own, weight = np.asarray(rewards, np.float64), np.asarray(weights, np.float64)
            self.first = first_step(normalised(own), weight)
        return weights


def normalised(rewards: np.ndarray) -> np.ndarray:
    """Normalise to mean zero and standard deviation one over the last axis."""
    return (rewards - rewards.mean(axis=-1, keepdims=True)) / rewards.std(axis=-1, keepdims=True)


def first_step(rewards: np.ndarray, weights: np.ndarray) -> dict[str, float]:
    """Describe ``(K, M)`` normalised rewards and weights: how many samples count, and the weighted mean reward."""
    return {
        "effective_samples": float((1 / (weights**2).sum(axis=1)).mean()),
        "own_reward": float((weights * rewards).sum(axis=1).mean()),
    }


@cache
def normal_limit(num_samples: int, draws: int = 400) -> dict[str, float]:
    """Return :func:`first_step` for rewards that are normally distributed, such as the sum of very many robots'."""
    rewards = normalised(np.random.default_rng(0).standard_normal((draws, num_samples)))
    return first_step(rewards, np.asarray(SoftmaxWeights(TEMPERATURE)(rewards, np), np.float64))


def iteration(num_robots: int, credit: str, num_samples: int, num_steps: int, seed: int) -> dict[str, Any]:
    """Return the first step's weights, and the result of one iteration."""
    engine, problem = get_sampling_engine("cpu"), crossing(num_robots)
    base = np.zeros((problem.horizon, num_robots, problem.control_size), np.float32)
    task = SamplingTask(problem, base, collisions=False, credit="robot")
    rule = Watched(num_robots, robots_that_share(credit, num_robots))
    result = engine.denoise(task, SamplingRules(weights=rule), base, annealed(num_steps, 1e-4, 2e-2), num_samples, seed)
    trajectory = engine.rollout(problem, result.mean)
    distance = np.linalg.norm(trajectory.positions - problem.goal, axis=-1)
    return {
        "robots": num_robots, "credit": credit, "samples": num_samples, "steps": num_steps, "seed": seed, **rule.first,
        # Not trajectory.rewards, which count the collisions that this study leaves out.
        "reward": float((1 - distance[1:] / distance[0]).mean()),
        "arrived": float(trajectory.arrived[-1].mean()),
    }  # fmt: skip


def measure(sizes: Sequence[int], seeds: int, num_samples: int, num_steps: int) -> Rows:
    """A row per team size, credit and seed."""
    rows = []
    for size in sizes:
        for credit in STYLES:
            if size < LEAST[credit] or (credit == MORE and size > MOST_WITH_MORE):
                continue
            number = num_samples * size if credit == MORE else num_samples
            rows += [iteration(size, credit, number, num_steps, seed) for seed in range(seeds)]
            print(rows[-1], flush=True)
    return rows


def means(rows: Rows, size: int, credit: str, name: str) -> list[float]:
    """A value of every seed."""
    return [row[name] for row in rows if (row["robots"], row["credit"]) == (size, credit)]


def summary(rows: Rows) -> Rows:
    """A row per team size and credit; theory has normally distributed rewards."""
    table = []
    for size, credit in grouped(rows, "robots", "credit"):
        of = partial(means, rows, size, credit)
        limit = normal_limit(of("samples")[0])
        reward, lower, upper = mean_interval(of("reward"))
        table.append(
            {
                "robots": size,
                "weighted by": NAMES.get(credit, credit.partition(",")[0]),
                "samples": of("samples")[0],
                "effective samples": f"{np.mean(of('effective_samples')):.1f}",
                "theory": f"{limit['effective_samples']:.1f}",
                "own reward [SD]": f"{np.mean(of('own_reward')):.2f}",
                "its theory": f"{limit['own_reward'] / robots_that_share(credit, size) ** 0.5:.2f}",
                "reward in the end": f"{reward:.3f}",
                "95%": "" if lower is None or upper is None else f"{lower:.3f} to {upper:.3f}",
                "arrived": f"{np.mean(of('arrived')):.0%}",
            }
        )
    return table


def draw(rows: Rows, out: Any) -> None:
    """Against the number of robots: the first step's signal with its theory, and the reward in the end."""
    figure, (signal, ends) = plt.subplots(1, 2, figsize=(8.4, 3.4), layout="constrained")
    for credit, style in STYLES.items():
        sizes = sorted({row["robots"] for row in rows if row["credit"] == credit})
        if not sizes:
            continue
        rewards = [np.mean(means(rows, size, credit, "reward")) for size in sizes]
        ends.plot(sizes, rewards, "o-", color=COLOURS[style], label=NAMES.get(credit, credit))
        if credit != MORE:
            own = [np.mean(means(rows, size, credit, "own_reward")) for size in sizes]
            signal.plot(sizes, own, "o", color=COLOURS[style])
            samples = means(rows, sizes[0], credit, "samples")[0]
            shared = np.array([robots_that_share(credit, size) for size in sizes])
            signal.plot(sizes, normal_limit(samples)["own_reward"] / shared**0.5, color=COLOURS[style], linewidth=1)
    every = sorted({row["robots"] for row in rows})
    for axes in (signal, ends):
        axes.set_xscale("log", base=2)
        axes.set_xticks(every, [str(size) for size in every])
        axes.set_xlabel("robots")
    signal.set_yscale("log", base=2)
    signal.set_yticks([0.25, 0.5, 1, 2], ["0.25", "0.5", "1", "2"])
    signal.set_ylabel("own reward, weighted mean [SD]")
    signal.set_title("First step (lines: theory)", fontsize=9)
    ends.set_ylabel("reward")
    ends.set_title("After one iteration", fontsize=9)
    ends.legend(title="weighted by the reward of", loc="lower left")
    save_figure(figure, out / "gradient_dilution.png")


def main() -> None:
    arguments = study_parser(__doc__, seeds=20).parse_args()
    settings: tuple[Any, ...] = (SIZES, arguments.seeds, NUM_SAMPLES, NUM_STEPS)
    if arguments.quick:
        settings = ((1, 16), 1, 256, 20)
    rows = study_rows(arguments, "gradient_dilution", partial(measure, *settings))
    save_table(summary(rows), arguments.out / "gradient_dilution.csv")
    draw(rows, arguments.out)
