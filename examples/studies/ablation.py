"""Ablation of D4orm-C2F's measures against disturbances: each left out by itself, and all of them left out.

    python -m examples.studies ablation --seeds 30 --out ablation

Eight robots on the circle, at random positions and in rooms, each measure under the disturbance that it is there for.
The table has how many trials succeeded and in how many there was a contact, with all measures and without, how
likely it is that both are equally good (McNemar, paired by seed), and how much longer robots travel without where both
succeed (mean, and Wilcoxon's test).
`--go-on-from FILE` takes trials from a Parquet file, such as those with all measures in
`examples/studies/data/disturbance_study.parquet`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

from examples.common import mean_text, save_table, study_trials, trials_parser
from examples.studies import AS_IN_THE_PAPER, FIRST_SEED
from examples.studies.disturbance_study import (
    DISTURBANCES,
    NOTHING,
    ROBOTS,
    SCENARIOS,
    name_of,
    names_by_text,
    successes,
)

from d4orm_planners.evaluation.comparison import in_common, paired
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.study import Study

ALL, WITHOUT_ALL = "d4orm-c2f", "all of them"
MEASURES: dict[str, dict[str, Any]] = {
    "delay": {"delay": 0},
    "filter_states": {"filter_states": False},
    "learn_limits": {"learn_limits": False},
    "expect_losses": {"expect_losses": False},
    "stalls": {"stalls": False},
    "last_resort": {"last_resort": False},
    "direct_final_approach": {"direct_final_approach": False},
}
MEANT_FOR = {
    "delay of 2 steps": "delay",
    "states 2 cm, 5 cm/s": "filter_states",
    "limits 20% weaker": "learn_limits",
    "dropout 30%": "expect_losses",
    "one robot stalls": "stalls",
    "pushes 0.2/s, 0.3 m/s": "last_resort",
    NOTHING: "direct_final_approach",
}
"""Measure that is tried under each disturbance."""
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    ALL: {},
    **MEASURES,
    WITHOUT_ALL: {name: value for measure in MEASURES.values() for name, value in measure.items()},
}

Cells = dict[tuple[str, str], dict[str, list[Trial]]]
"""Trials by scenario and disturbance, and by what is left out."""


def studies(scenarios: Sequence[str], disturbances: Sequence[str], seeds: int) -> list[Study]:
    """One for every disturbance."""
    return [
        Study(
            policies={
                label: {"policy": ALL, "refine": "sync", **SETTINGS[label]}
                for label in (ALL, MEANT_FOR[name], WITHOUT_ALL)
            },
            scenarios=scenarios, num_robots=ROBOTS, seeds=range(FIRST_SEED, FIRST_SEED + seeds),
            scenario_settings=AS_IN_THE_PAPER,
            disturbances={name: [[] if name == NOTHING else [DISTURBANCES[name]]]},
        )
        for name in disturbances
    ]  # fmt: skip


def by_cell(trials: Sequence[Trial]) -> Cells:
    """The table's cells, in its order."""
    named = names_by_text()
    cells: Cells = {(scenario, name): {} for name in MEANT_FOR for scenario in SCENARIOS}
    for trial in trials:
        cell = cells[name_of(trial), named.get(trial.disturbances, NOTHING)]
        cell.setdefault(trial.label, []).append(trial)
    return {key: cell for key, cell in cells.items() if cell}


def rows_of(cells: Cells) -> list[dict[str, Any]]:
    """A row for every scenario, disturbance and what is left out."""
    rows = []
    for (scenario, disturbance), cell in cells.items():
        for label in (MEANT_FOR[disturbance], WITHOUT_ALL):
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


def main() -> None:
    """Run the study and write the table."""
    arguments = trials_parser(__doc__, seeds=30).parse_args()
    size = (SCENARIOS, tuple(MEANT_FOR), arguments.seeds)
    if arguments.quick:
        size = (SCENARIOS[:1], tuple(MEANT_FOR)[:1], 1)
    trials = study_trials(arguments, "ablation", studies(*size))
    save_table(rows_of(by_cell(trials)), arguments.out / "ablation.csv")
