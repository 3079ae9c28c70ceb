"""Tune D4orm and its rivals, each with the same budget: where the preset "tuned" comes from.

    python -m examples.studies tune_rivals --candidates 27 --seeds 4 --out tuning

Every method has its preset "paper" and so many settings drawn at random from its own space. All of them meet four teams
with the same seeds; the better third meets twice as many, and a third of that four times as many (successive halving:
K. Jamieson and A. Talwalkar, AISTATS 2016). A trial has a budget of denoising steps of 1024 samples. What counts is the
mean number of steps to the first solution, a trial without one counting twice the budget (PAR-2). Seeds are 100 and up:
evaluations use those below. Trials are stored in the folder, and a call that was broken off goes on from there.
`--trials FILE` makes the tables, of all settings and of the best, of trials that are in a Parquet file, such as those
in `examples/studies/data/`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from examples.common import count, is_solved, save_table, study_parser
from examples.denoising import penalised_steps

from d4orm_planners import make_planner
from d4orm_planners.evaluation.evaluate import run_study
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.study import Study
from d4orm_planners.evaluation.tables import read_parquet, write_parquet

TEAMS = (("paper_circle", 8), ("paper_random", 16), ("paper_heterogeneous", 8), ("paper_obstacles", 8))
FIRST_SEED = 100
BUDGET, TINY = 1000, 20
"""Denoising steps of a trial, and of the small version's."""
KEPT, ROUNDS = 1 / 3, 3

Settings = dict[str, Any]


class Between(NamedTuple):
    """A number, the logarithm of which is uniform."""

    low: float
    high: float

    def draw(self, random: np.random.Generator) -> float:
        """Three digits of one."""
        return float(f"{np.exp(random.uniform(np.log(self.low), np.log(self.high))):.3g}")


class OneOf(NamedTuple):
    """One of some values, all alike."""

    values: tuple[Any, ...]

    def draw(self, random: np.random.Generator) -> Any:
        """One of them."""
        return self.values[random.integers(len(self.values))]


STEPS, CLIP = OneOf((25, 50, 100, 200)), OneOf((False, True))
DIFFUSION = {"temperature": Between(0.05, 1.0), "beta_start": Between(1e-5, 1e-3), "beta_end": Between(5e-3, 1e-1)}
SPACES: Mapping[str, Mapping[str, Between | OneOf]] = {
    "mppi": {"sigma": Between(0.1, 2.0), "temperature": Between(0.05, 1.0), "num_steps": STEPS,
             "clip_between_iterations": CLIP},
    "cem": {"sigma": Between(0.3, 2.0), "elite_fraction": Between(0.01, 0.2), "adapt_variance": OneOf((True, False)),
            "sigma_floor": Between(0.02, 0.3), "num_steps": STEPS, "clip_between_iterations": CLIP},
    "mbd": DIFFUSION,
    "i-mbd": {**DIFFUSION, "num_steps": STEPS, "clip_between_iterations": CLIP},
    "d4orm": {**DIFFUSION, "num_steps": STEPS, "clip_between_iterations": CLIP},
}  # fmt: skip


def candidates(method: str, number: int, space: Mapping[str, Between | OneOf]) -> list[Settings]:
    """Nothing but what the method has, and settings drawn from a space of its own."""
    random = np.random.default_rng([FIRST_SEED, *method.encode()])
    drawn = [{name: part.draw(random) for name, part in space.items()} for _ in range(number - 1)]
    return [{}, *drawn]


def policy(method: str, settings: Settings, budget: int) -> Settings:
    """The settings as a study takes them, with as many iterations as the budget has room for."""
    chosen: Settings = {"policy": method, "preset": "paper", "engine": "cpu", **settings}
    if method == "mbd":
        chosen |= {"num_steps": budget, "check_every": None}
    chosen["num_steps"] = min(chosen.get("num_steps", 100), budget)
    return {**chosen, "max_iterations": budget // chosen["num_steps"]}


def run(method: str, chosen: Sequence[Settings], seeds: int, budget: int, out: Path) -> list[list[Trial]]:
    """The trials of each of these settings, of all teams and seeds."""
    policies = {f"{method} {index}": policy(method, settings, budget) for index, settings in enumerate(chosen)}
    found: dict[str, list[Trial]] = {label: [] for label in policies}
    for scenario, num_robots in TEAMS:
        study = Study(
            policies=policies, scenarios=(scenario,), num_robots=num_robots, seeds=range(FIRST_SEED, FIRST_SEED + seeds)
        )
        for label, trials, *_ in run_study(study, out, workers=1):
            found[label] += trials
    return list(found.values())


def tune(method: str, number: int, seeds: int, budget: int, out: Path) -> list[Trial]:
    """Run all rounds of a method; the trials of all settings, each of its last round, which has those before."""
    chosen = candidates(method, number, SPACES[method])
    trials: list[Trial] = []
    for turn in range(ROUNDS):
        found = run(method, chosen, seeds << turn, budget, out)
        needed = [float(np.mean([*map(penalised_steps, group)])) for group in found]
        order = np.argsort(needed, kind="stable")
        print(
            f"{method}, round {turn + 1}: {needed[order[0]]:g} steps with {chosen[order[0]] or 'the preset'}",
            flush=True,
        )
        kept = order[: max(1, round(KEPT * len(chosen)))] if turn < ROUNDS - 1 else []
        trials += [trial for index, group in enumerate(found) if index not in kept for trial in group]
        chosen = [chosen[index] for index in kept]
    return trials


def described(method: str, settings: Mapping[str, Any]) -> str:
    """Describe those of these settings that are tuned."""
    return ", ".join(f"{name}={settings[name]}" for name in SPACES[method])


def rows_of(trials: Iterable[Trial]) -> list[dict[str, Any]]:
    """A row per method and settings: those that came furthest first, and of these the best."""
    groups: dict[tuple[str, str], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.policy, trial.config), []).append(trial)
    rows = []
    for (method, config), group in groups.items():
        settings = json.loads(config)
        steps, restricted = (float(np.mean([penalised_steps(trial, factor) for trial in group])) for factor in (2, 1))
        solved = sum(map(is_solved, group))
        rows.append(
            {"method": method, "trials": len(group), "solved": solved, "steps": round(steps, 1),
             "restricted": round(restricted, 1), "settings": described(method, settings)}
        )  # fmt: skip
    order = list(SPACES)
    return sorted(rows, key=lambda row: (order.index(row["method"]), -row["trials"], row["steps"], row["settings"]))


def shortlist(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return every method's settings that came furthest, and the preset."""
    furthest: dict[str, int] = {}
    for row in rows:
        furthest[row["method"]] = max(row["trials"], furthest.get(row["method"], 0))
    presets = {name: described(name, make_planner(name, preset="paper").config.keywords()) for name in furthest}
    return [
        row for row in rows if row["trials"] == furthest[row["method"]] or row["settings"] == presets[row["method"]]
    ]


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--candidates", type=count, default=27, help="settings tried per method, the preset included")
    parser.add_argument("--seeds", type=count, default=4, help="seeds of the first round")
    parser.add_argument("--method", action="append", choices=SPACES, help="only this one; repeatable")
    arguments = parser.parse_args()
    if arguments.trials is None:
        number, seeds, budget = (2, 1, TINY) if arguments.quick else (arguments.candidates, arguments.seeds, BUDGET)
        methods = arguments.method or SPACES
        trials = [trial for method in methods for trial in tune(method, number, seeds, budget, arguments.out)]
        write_parquet(arguments.out / "tune_rivals.parquet", trials)
    else:
        trials = read_parquet(arguments.trials)
    rows = rows_of(trials)
    save_table(rows, arguments.out / "tuning.csv")
    save_table(shortlist(rows), arguments.out / "tuning_best.csv")
