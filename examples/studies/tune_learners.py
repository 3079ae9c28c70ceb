"""PPO and SAC tuned with the same budget: how good the settings are that the package trains with.

    python -m examples.studies tune_learners --candidates 7

Both have the settings of `training_seeds.py` in crowds and so many drawn at random from a space of their own. Each is
trained for a first look, and the better third twice as long, from nothing and with another seed (successive halving:
K. Jamieson and A. Talwalkar, AISTATS 2016). What counts is the success in validation after the last step. A first look
is 150,000 robot-steps for SAC and a million for PPO, which takes about as long. Seeds are 100 and up: evaluations use
those below. Broken off, it goes on where it was; more than an hour of one core. With `--trials` it trains nothing,
and makes the table of a file that it wrote before.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from examples.common import count, grouped, save_table, study_parser, study_rows
from examples.studies.training_seeds import LEARNERS, QUICK
from examples.studies.tune_rivals import FIRST_SEED, KEPT, Between, OneOf, Settings, candidates

from d4orm_planners.rl.training import TrainingSettings, train

PPO, SAC = (LEARNERS[f"{name}, holonomic2d, crowds"] for name in ("PPO", "SAC"))
TRAININGS: Mapping[str, TrainingSettings] = {
    "ppo": replace(PPO, steps=1_000_000, stages=1),
    "sac": replace(SAC, steps=150_000, stages=1),
}
"""The first look of each."""
LONGER = (1, 2)
"""Factors by which a training of each round is longer."""
SPACES: Mapping[str, Mapping[str, Between | OneOf]] = {
    "ppo": {"learning_rate": Between(1e-4, 2e-3), "n_epochs": OneOf((2, 4, 8)), "clip_range": OneOf((0.1, 0.2, 0.3)),
            "ent_coef": OneOf((0.0, 1e-3, 1e-2)), "gae_lambda": OneOf((0.9, 0.95, 0.98))},
    "sac": {"learning_rate": Between(3e-4, 3e-3), "gradient_steps": OneOf((4, 8, 12, 16)),
            "batch_size": OneOf((128, 256, 512)), "tau": Between(5e-3, 5e-2)},
}  # fmt: skip


def with_settings(training: TrainingSettings, settings: Settings) -> TrainingSettings:
    """A training with other settings of its learner."""
    others = {name: value for name, value in settings.items() if name != "learning_rate"}
    return replace(
        training,
        learning_rate=settings.get("learning_rate", training.learning_rate),
        learner_settings={**training.learner_settings, **others},
    )


def tune(learner: str, number: int, quick: bool, out: Path) -> list[dict[str, Any]]:
    """A row per training."""
    training, chosen, rows = TRAININGS[learner], dict(enumerate(candidates(learner, number, SPACES[learner]))), []
    if quick:
        training = replace(training, **{**QUICK, "stages": 1}, mixture=("random 2", "circle 2"))
    for turn, longer in enumerate(LONGER):
        found = {}
        for index, settings in chosen.items():
            longest = replace(training, steps=longer * training.steps, seed=FIRST_SEED + turn)
            (end,) = train(with_settings(longest, settings), out / f"{learner}-round-{turn + 1}-{index}").curve
            found[index] = end.success_rate
            print(f"{learner}, round {turn + 1}, {settings or 'as it is'}: {end.success_rate:.0%}", flush=True)
            rows.append(
                {"learner": learner, "round": turn + 1, "candidate": index, "settings": json.dumps(settings),
                 "steps": end.steps, "success": end.success_rate, "travel_time": end.travel_time,
                 "seconds": end.seconds}
            )  # fmt: skip
        best = sorted(found, key=lambda index: -found[index])[: max(1, round(KEPT * len(found)))]
        chosen = {index: chosen[index] for index in best}
    return rows


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, object]]:
    """A row per learner and settings: those that came furthest first, and of these the best."""
    table: list[dict[str, object]] = []
    for (learner,), own in grouped(rows, "learner").items():
        by_candidate = grouped(own, "candidate")
        for trained in sorted(by_candidate.values(), key=lambda each: (-len(each), -each[-1]["success"])):
            settings = json.loads(trained[0]["settings"])
            successes = [f"{row['success']:.0%}" for row in trained]
            table.append(
                {"learner": learner, "success after a first look": successes[0],
                 "twice as long": successes[1] if len(successes) > 1 else "",
                 "settings": ", ".join(f"{name}={value}" for name, value in settings.items()) or "as they are"}
            )  # fmt: skip
    return table


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--candidates", type=count, default=7, help="settings tried per learner, its own included")
    parser.add_argument("--learner", action="append", choices=TRAININGS, help="only this one; repeatable")
    arguments = parser.parse_args()
    number = 3 if arguments.quick else arguments.candidates
    rows = study_rows(
        arguments,
        "tune_learners",
        lambda: [
            row
            for learner in arguments.learner or TRAININGS
            for row in tune(learner, number, arguments.quick, arguments.out)
        ],
    )
    save_table(summary(rows), arguments.out / "tune_learners.csv")
