"""Imitation of a planner: a network learns what D4orm-C2F does, first by cloning, then by DAgger, then by PPO.

    python -m examples.studies imitate_expert --seeds 3
    python -m examples.studies imitate_expert --trials examples/studies/data/imitate_expert.parquet

The clone sees what the expert's own drives led to, and on its own comes into states that the expert never was in.
DAgger lets the network drive and asks the expert there. PPO goes on from that by reward, and is compared with PPO from
nothing. Success is that in 100 random instances that nothing learns from. All of it is in policy files of "ppo". Broken
off, the same command goes on; some ten minutes a seed. With ``--trials`` nothing is trained, and the table is made of a
file that it wrote before. The same from the command line: ``d4orm train imitation`` and ``d4orm train ppo
--start-from``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from examples.common import grouped, mean_text, require, save_table, study_parser, study_rows, success_of_seeds

require("rl", "stable_baselines3", "tensorboard")

from d4orm_planners.rl.checkpoints import Evaluation
from d4orm_planners.rl.imitation import ImitationSettings, imitate
from d4orm_planners.rl.training import TrainingSettings, train

IMITATION = ImitationSettings(num_robots=4)
REINFORCEMENT = TrainingSettings(num_robots=4, steps=1_000_000, stages=10)
Rows = Sequence[Mapping[str, Any]]


def measure(seeds: int, out: Path, quick: bool) -> list[dict[str, Any]]:
    """A row per seed, way of learning, and point of its curve."""
    imitation, reinforcement, rows = IMITATION, REINFORCEMENT, []
    if quick:
        imitation = replace(imitation, num_robots=2, episodes=20, rounds=2)
        reinforcement = replace(reinforcement, num_robots=2, steps=50_000, stages=2)
    for seed in range(seeds):
        learned = imitate(replace(imitation, seed=seed), out / f"imitation-{seed}", progress=report)
        rows += [_row("cloning" if not index else "DAgger", seed, point) for index, point in enumerate(learned.curve)]
        for name, start in (("PPO from there", str(learned.policy_path)), ("PPO from nothing", None)):
            settings = replace(reinforcement, seed=seed, start_from=start)
            curve = train(settings, out / f"{name.replace(' ', '-').lower()}-{seed}", progress=report).curve
            rows += [_row(name, seed, point) for point in curve]
    return rows


def _row(way: str, seed: int, point: Evaluation) -> dict[str, Any]:
    return {
        "way": way,
        "seed": seed,
        "steps": point.steps,
        "success": point.success_rate,
        "travel_time": point.travel_time,
        "imitation_error": point.imitation_error,
        "seconds": point.seconds,
    }


def report(what: str, done: int, total: int) -> None:
    """Say now and then how far it is."""
    if done % max(total // 10, 1) == 0:
        print(f"{done / total:4.0%}  {what}", flush=True)


def summary(rows: Rows) -> list[dict[str, object]]:
    """Summarise all seeds: after each round of the imitation, and after the first and the last stage of PPO.

    A round learns from so many moments of robots as its episodes happen to have, which differ from seed to seed.
    """
    table = []
    for (way,), own in grouped(rows, "way").items():
        points = list(zip(*grouped(own, "seed").values(), strict=True))
        shown = points if way == "DAgger" or len(points) == 1 else [points[0], points[-1]]
        table += [_point(way, point) for point in shown]
    return table


def _point(way: str, point: Rows) -> dict[str, object]:
    ends = [100 * row["success"] for row in point]
    errors = [row["imitation_error"] for row in point if row["imitation_error"] is not None]
    return {
        "learned by": way,
        "moments or robot-steps": f"{np.mean([row['steps'] for row in point]):,.0f}",
        "seeds": len(point),
        **success_of_seeds(ends),
        "travel time [s]": f"{np.mean([row['travel_time'] for row in point]):.2f}",
        "imitation error": mean_text(errors, none=""),
    }


def main() -> None:
    arguments = study_parser(__doc__, seeds=3).parse_args()
    seeds, quick, out = (1 if arguments.quick else arguments.seeds), arguments.quick, arguments.out / "imitation"
    rows = study_rows(arguments, "imitate_expert", lambda: measure(seeds, out, quick))
    save_table(summary(rows), arguments.out / "imitate_expert.csv")
