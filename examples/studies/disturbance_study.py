"""Success of controllers with eight robots under ten disturbances, and in another physics.

    python -m examples.studies disturbance_study --seeds 50 --out disturbance_study

D4orm-C2F beside a plan of `hybrid` executed open loop, ORCA and PPO, each with the same seeds, on the circle, at random
positions and in rooms. Every disturbance is on by itself at one level, beside no disturbance at all; and on the circle
and at random positions the same robots are rigid bodies in MuJoCo, as pucks and on two wheels, where that is installed.
Written is for every policy, scenario and disturbance how many trials succeeded, with Wilson's 95% interval, in how many
there was a contact, and how many ended too late; an overview of these, and a heat map. Trials are stored in the
folder one by one, and a call that was broken off, or one with more seeds or scenarios, goes on from there.
`--trials FILE` makes table and heat map of trials that are in a Parquet file, such as those in `examples/studies/data`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from examples.common import mean_text, plt, save_figure, save_table, solved_columns, study_trials, trials_parser
from examples.denoising import loop_steps, steps_to_solution, text_of_told
from examples.studies import FIRST_SEED

from d4orm_env.disturbances import (
    Bias,
    ControlNoise,
    CorrelatedNoise,
    Delay,
    Disturbance,
    Dropout,
    Intruder,
    LimitMismatch,
    Push,
    Stall,
    StateNoise,
)
from d4orm_planners.evaluation.comparison import in_common, paired
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.study import Study
from d4orm_planners.evaluation.trials import Condition

ROBOTS = 8
SCENARIOS = ("circle", "random", "rooms")
POLICIES: dict[str, dict[str, Any]] = {"d4orm-c2f": {"refine": "sync"}, "hybrid": {}, "orca": {}, "ppo": {}}
DISTURBANCES: dict[str, Disturbance[Any]] = {
    "noise 0.3": ControlNoise(0.3),
    "correlated noise 0.2, 1 s": CorrelatedNoise(0.2, 1.0),
    "bias 0.1": Bias(0.1),
    "delay of 2 steps": Delay(2),
    "dropout 30%": Dropout(0.3),
    "states 2 cm, 5 cm/s": StateNoise(0.02, 0.05),
    "pushes 0.2/s, 0.3 m/s": Push(0.2, 0.3),
    "one robot stalls": Stall(1.0, robots=1),
    "an intruder, 0.5 m/s": Intruder(1, 0.5),
    "limits 20% weaker": LimitMismatch(0.8),
}
NOTHING = "none"
BODIES = {"MuJoCo, pucks": "holonomic2d", "MuJoCo, two wheels": "differential_drive"}
"""Physics in place of a disturbance, and the robots' model."""
COLUMNS = (NOTHING, *DISTURBANCES, *BODIES)

Cells = dict[tuple[str, str, str], list[Trial]]
"""Trials by scenario, policy and disturbance."""


def studies(scenarios: tuple[str, ...], policies: dict[str, dict[str, Any]], seeds: int) -> list[Study]:
    """Every policy under every disturbance and in MuJoCo."""
    study = Study(
        policies=policies,
        scenarios=scenarios,
        num_robots=ROBOTS,
        seeds=range(FIRST_SEED, FIRST_SEED + seeds),
        disturbances={NOTHING: [[]], **{name: [[one]] for name, one in DISTURBANCES.items()}},
    )
    inside = tuple(scenario for scenario in scenarios if scenario != "rooms")
    models = BODIES.values() if inside and find_spec("mujoco") else ()
    rigid = [replace(study, scenarios=inside, model=model, physics="mujoco", disturbances=None) for model in models]
    return [study, *rigid]


def names_by_text() -> dict[str, str]:
    """Names of the disturbances, by what stands in trials."""
    return {Condition(disturbances=(one,)).text: name for name, one in DISTURBANCES.items()}


def name_of(trial: Trial) -> str:
    """The name of its scenario, without settings."""
    return trial.scenario.partition(" (")[0]


def by_cell(trials: Iterable[Trial]) -> Cells:
    named = names_by_text()
    cells: Cells = {}
    bodies = {model: name for name, model in BODIES.items()}
    for trial in trials:
        disturbance = bodies[trial.model] if trial.physics == "mujoco" else named.get(trial.disturbances, NOTHING)
        cells.setdefault((name_of(trial), trial.label, disturbance), []).append(trial)
    order = [SCENARIOS, tuple(POLICIES), COLUMNS]
    return dict(sorted(cells.items(), key=lambda cell: [known.index(one) for known, one in zip(order, cell[0])]))


def rows_of(cells: Cells) -> list[dict[str, Any]]:
    """A row per cell."""
    rows = []
    for (scenario, policy, disturbance), trials in cells.items():
        rows.append(
            {"scenario": scenario, "policy": policy, "disturbance": disturbance, "trials": len(trials),
             "denoising steps": denoising_steps(trials),
             "succeeded": sum(trial.success for trial in trials),
             "interval": solved_columns(trials, lambda trial: trial.success)["interval"],
             "touched": sum(trial.collided > 0 for trial in trials),
             "late": sum(not (trial.success or trial.collided or trial.error) for trial in trials),
             "errors": sum(bool(trial.error) for trial in trials)}
        )  # fmt: skip
    return rows


def denoising_steps(trials: Sequence[Trial]) -> str:
    """Median of the denoising steps of plans, or those of a controller in a loop."""
    in_loop = loop_steps(trials[0])
    if in_loop is None:
        return text_of_told([steps_to_solution(trial) for trial in trials], lambda told: f"{np.median(told):g}")
    return f"{in_loop} a loop" if in_loop else "0"


def successes(trials: Sequence[Trial]) -> str:
    """Return the number of successes, and of trials with a contact."""
    return f"{sum(trial.success for trial in trials)}, {sum(trial.collided > 0 for trial in trials)}"


def overview(cells: Cells) -> list[dict[str, Any]]:
    """A row per scenario and policy: how many trials succeeded under each disturbance, and in how many was contact."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for (scenario, policy, disturbance), trials in cells.items():
        told = {"trials": len(trials), "denoising steps": denoising_steps(trials)}
        row = rows.setdefault((scenario, policy), {"scenario": scenario, "policy": policy, **told})
        row.update({name: row.get(name, "-") for name in COLUMNS})
        row[disturbance] = successes(trials)
    return list(rows.values())


def draw(cells: Cells, path: Path) -> None:
    """Success as a heat map: a panel per scenario, a row per policy, a column per disturbance."""
    scenarios = list(dict.fromkeys(scenario for scenario, _, _ in cells))
    figure, axes = plt.subplots(len(scenarios), 1, figsize=(9, 1.2 + 1.7 * len(scenarios)), sharex=True, squeeze=False)
    for axis, scenario in zip(axes[:, 0], scenarios, strict=True):
        policies = list(dict.fromkeys(policy for where, policy, _ in cells if where == scenario))
        shares = np.full((len(policies), len(COLUMNS)), np.nan)
        for (where, policy, disturbance), trials in cells.items():
            if where == scenario:
                shares[policies.index(policy), COLUMNS.index(disturbance)] = np.mean([one.success for one in trials])
        axis.imshow(shares, vmin=0, vmax=1, cmap="viridis", aspect="auto")
        for (row, column), share in np.ndenumerate(shares):
            if not np.isnan(share):
                colour = "black" if share > 0.6 else "white"
                axis.text(column, row, f"{100 * share:.0f}", ha="center", va="center", color=colour)
        axis.set_title(f"{scenario}, {ROBOTS} robots: trials that succeed [%]", loc="left")
        axis.set_yticks(range(len(policies)), policies)
        axis.grid(False)
    axes[-1, 0].set_xticks(range(len(COLUMNS)), COLUMNS, rotation=30, ha="right")
    figure.tight_layout()
    save_figure(figure, path)


def main() -> None:
    parser = trials_parser(__doc__, seeds=50)
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, default=SCENARIOS)
    arguments = parser.parse_args()
    size = (tuple(arguments.scenarios), POLICIES, arguments.seeds)
    if arguments.quick:
        size = (SCENARIOS[:1], {"orca": {}}, 1)
    trials = study_trials(arguments, "disturbance_study", studies(*size))
    cells = by_cell(trials)
    save_table(overview(cells), arguments.out / "disturbance_overview.csv")
    save_table(rows_of(cells), arguments.out / "disturbance_study.csv")
    draw(cells, arguments.out / "disturbance_study.png")


ABLATION = """\
Ablation of D4orm-C2F's measures against disturbances: each left out by itself, and all of them left out.

    python -m examples.studies ablation --seeds 30 --out ablation

Eight robots on the circle, at random positions and in rooms, each measure under the disturbance that it is there for.
The table has how many trials succeeded and in how many there was a contact, with all measures and without, how
likely it is that both are equally good (McNemar, paired by seed), and how much longer robots travel without where both
succeed (mean, and Wilcoxon's test).
`--go-on-from FILE` takes trials from a Parquet file, such as those with all measures in
`examples/studies/data/disturbance_study.parquet`."""
"""Description of the ablation."""
ALL, WITHOUT_ALL = "d4orm-c2f", "all of them"
LEFT_OUT: Mapping[str, tuple[str, Any]] = {
    "delay of 2 steps": ("delay", 0),
    "states 2 cm, 5 cm/s": ("filter_states", False),
    "limits 20% weaker": ("learn_limits", False),
    "dropout 30%": ("expect_losses", False),
    "one robot stalls": ("stalls", False),
    "pushes 0.2/s, 0.3 m/s": ("last_resort", False),
    NOTHING: ("direct_final_approach", False),
}
"""Measure that is tried under each disturbance, which is a setting, and its value without it."""


def ablations(scenarios: Sequence[str], disturbances: Sequence[str], seeds: int) -> list[Study]:
    """A study for every disturbance: with all measures, without the one against it, and without any."""
    studies = []
    for name in disturbances:
        measure, without = LEFT_OUT[name]
        settings = {ALL: {}, measure: {measure: without}, WITHOUT_ALL: dict(LEFT_OUT.values())}
        studies.append(
            Study(
                policies={label: {"policy": ALL, "refine": "sync", **own} for label, own in settings.items()},
                scenarios=scenarios,
                num_robots=ROBOTS,
                seeds=range(FIRST_SEED, FIRST_SEED + seeds),
                disturbances={name: [[] if name == NOTHING else [DISTURBANCES[name]]]},
            )
        )
    return studies


def ablation_rows(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """A row for every disturbance, scenario and what is left out."""
    named, rows = names_by_text(), []
    cells: dict[tuple[str, str], dict[str, list[Trial]]] = {}
    for trial in trials:
        cell = cells.setdefault((named.get(trial.disturbances, NOTHING), name_of(trial)), {})
        cell.setdefault(trial.label, []).append(trial)
    order = [tuple(LEFT_OUT), SCENARIOS]
    for disturbance, scenario in sorted(cells, key=lambda cell: [known.index(one) for known, one in zip(order, cell)]):
        cell = cells[disturbance, scenario]
        for label in (LEFT_OUT[disturbance][0], WITHOUT_ALL):
            pairs = in_common(cell[label], cell[ALL])
            both = [(one, other) for one, other in pairs if one.success and other.success]
            test = paired(cell[label], cell[ALL], lambda trial: float(not trial.success))
            longer = [one.travel_time - other.travel_time for one, other in both]
            cost = paired(*zip(*both, strict=True), cost=attrgetter("travel_time")) if both else None
            rows.append(
                {"disturbance": disturbance, "scenario": scenario, "left out": label, "trials": len(pairs),
                 "with": successes([other for _, other in pairs]), "without": successes([one for one, _ in pairs]),
                 "p (succeeded)": test.success_p,
                 "travel time without [s]": mean_text(longer, "+.2f"),
                 "p (travel time)": cost and cost.cost_p}
            )  # fmt: skip
    return rows


def ablation() -> None:
    """Run the ablation and write its table."""
    arguments = trials_parser(ABLATION, seeds=30).parse_args()
    size = (SCENARIOS, tuple(LEFT_OUT), arguments.seeds)
    if arguments.quick:
        size = (SCENARIOS[:1], tuple(LEFT_OUT)[:1], 1)
    trials = study_trials(arguments, "ablation", ablations(*size))
    save_table(ablation_rows(trials), arguments.out / "ablation.csv")
