"""Report of a reproduced figure: numbers per policy and problem, as CSV and as tables beside the paper's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from examples.common import holm_by_family
from examples.denoising import steps_to_solution
from examples.studies.paper.figure import Figure, Group
from examples.studies.paper.numbers import METRICS, Measured, column, first_solution, is_time, measured
from examples.studies.paper.plots import draw

from d4orm_env.core.files import replaced_when_done
from d4orm_planners.evaluation.comparison import Paired, paired
from d4orm_planners.evaluation.leaderboard import origin
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.summary import SuccessWithin, success_by
from d4orm_planners.evaluation.tables import deadline_table, errors, table, write_csv

INTRODUCTION = """\
Success with its 95% interval (Wilson); runtime and denoising steps to the first solution: median and quartiles over
all trials, of which those without a solution count as never (∞), or mean ± standard deviation over the successes;
in restricted means those without a solution count all that they spent. The share of the time to the first solution
that denoising took is the mean of those trials that tell it, whose number stands behind it where that is not all.
Travel time, makespan and jerk are over the successes; the reward is that of the best plan in the end, over all
trials."""

PAIRS = """\
The same problems and seeds, trial by trial: how often only the one or the other succeeded, with McNemar's exact test;
the median difference in {cost}, with Wilcoxon's signed-rank test. A trial that failed counts twice the longest that
either needed. P values are corrected for all tests of this page by Holm's method, those of rows that say `ours` among
themselves."""
_COSTS = {
    "runtime": "seconds to the first solution",
    "travel_time": "travel time [s]",
    "first_steps": "denoising steps to the first solution",
    "iterations": "iterations",
}


def markdown(figure: Figure, groups: Sequence[Group]) -> str:
    """Title, one table per section with the paper's numbers below or beside ours, deadlines, remarks and origin."""
    rows = [measured(group) for group in groups]
    draw_table = _transposed if figure.across == "policy" else _across
    blocks = [f"# {figure.title}", f"The paper: {figure.source}. {INTRODUCTION}"]
    blocks.append("\n".join(f"- {remark}" for remark in (*figure.remarks, _seeds(groups))))
    sections = tuple(dict.fromkeys(row.section for row in rows))
    blocks.append("## What was measured")
    blocks += [draw_table(figure, title, [row for row in rows if row.section == title]) for title in sections]
    reference = _reference(figure, groups)
    if pairs := _pairs(figure, groups, reference):
        blocks += [f"## Compared with {reference}", PAIRS.format(cost=_COSTS[figure.compared_by]), *pairs]
    if figure.deadlines:
        blocks += _deadlines(figure, groups)
    blocks += errors((row.label, row.error) for row in rows)
    return "\n\n".join([*blocks, origin([trial for group in groups for trial in group.trials])]) + "\n"


def _seeds(groups: Sequence[Group]) -> str:
    """Return the seeds of the rows as a sentence; where labels differ, or panels of one, each has its own."""
    found: dict[str, dict[str, None]] = {}
    for group in groups:
        found.setdefault(group.label, {})[_ranges(sorted({trial.seed for trial in group.trials}))] = None
    labels: dict[str, list[str]] = {}
    for label, seeds in found.items():
        labels.setdefault(" or ".join(seeds), []).append(f"`{label}`")
    told = [f"{seeds} of {', '.join(own)}" for seeds, own in labels.items()] if len(labels) > 1 else list(labels)
    return f"Seeds: {'; '.join(told)}."


def _ranges(numbers: Sequence[int]) -> str:
    """Rising numbers as text, those that follow each other as ``0 to 49``."""
    firsts = [number for number in numbers if number - 1 not in numbers]
    lasts = [number for number in numbers if number + 1 not in numbers]
    return ", ".join(
        f"{first} to {last}" if last > first else f"{first}" for first, last in zip(firsts, lasts, strict=True)
    )


def _across(figure: Figure, title: str, rows: Sequence[Measured]) -> str:
    """Policies and metrics from top to bottom, what the figure varies from left to right; the paper's rows below."""
    columns = tuple(dict.fromkeys(column(figure, row) for row in rows))
    ours = {(row.label, column(figure, row)): row for row in rows}
    labels = dict.fromkeys(row.label for row in rows)
    lines = []
    for name in figure.metrics:
        said = {label: values for (section, label, metric), values in figure.paper.items()
                if (section, metric) == (title, name)}  # fmt: skip
        for label in dict.fromkeys([*labels, *said]):
            cells = [METRICS[name].text(ours[label, key]) if (label, key) in ours else "" for key in columns]
            if label in labels and any(cell not in ("", "-") for cell in cells):
                lines.append((METRICS[name].title, label, *cells))
            if label in said and any(key in said[label] for key in columns):
                lines.append(
                    (METRICS[name].title, f"{label} (the paper)", *(said[label].get(key, "") for key in columns))
                )
    return table(title, ("", figure.across, *columns), lines)


def _transposed(figure: Figure, title: str, rows: Sequence[Measured]) -> str:
    """Policies from top to bottom, metrics from left to right, each with the paper's beside it if there is one."""
    # One scenario and team size: every policy is a row.
    known = {name for name in figure.metrics if any(_said(figure, row, name) for row in rows)}
    header, lines = ["policy"], []
    for name in figure.metrics:
        header += [METRICS[name].title] + [f"{METRICS[name].title} (the paper)"] * (name in known)
    for row in rows:
        line = [row.label]
        for name in figure.metrics:
            line += [METRICS[name].text(row)] + [_said(figure, row, name)] * (name in known)
        lines.append(line)
    return table(f"{title}, {rows[0].num_robots} robots", header, lines)


def _said(figure: Figure, row: Measured, metric: str) -> str:
    """The paper's number, empty if it gives none."""
    return figure.paper.get((row.section, row.label, metric), {}).get(column(figure, row), "")


def _reference(figure: Figure, groups: Sequence[Group]) -> str | None:
    """Label of the policy that others are compared with: of variants of one method the first, where it is not there."""
    is_there = figure.across != "policy" or any(group.label == figure.reference for group in groups)
    return figure.reference if is_there else groups[0].label


def _pairs(figure: Figure, groups: Sequence[Group], reference: str | None) -> list[str]:
    """A table per section of the other policies beside the reference; none without it."""
    by_cell = {(group.section, column(figure, row), group.label): group.trials
              for group in groups for row in [measured(group)]}  # fmt: skip
    one_column = figure.across == "policy"
    tests: dict[tuple[str, str, str], Paired] = {}
    for (section, where, label), trials in by_cell.items():
        others = by_cell.get((section, str(reference) if one_column else where, str(reference)))
        if others is None or label == reference:
            continue
        cost = _cost(figure, [*trials, *others])
        tests[section, where, label] = paired(trials, others, cost, lambda one: first_solution(one) is not None)
    p_values = holm_by_family(
        {
            (*key, what): (key[-1], p)
            for key, test in tests.items()
            for what, p in (("success", test.success_p), ("cost", test.cost_p))
        }
    )
    blocks: dict[str, list[tuple[str, ...]]] = {}
    for (section, where, label), test in tests.items():
        counts = (str(count) for count in (test.pairs, test.only_first, test.only_second))
        blocks.setdefault(section, []).append(
            (label, *[where] * (not one_column), *counts, f"{p_values[section, where, label, 'success']:.2g}",
             f"{test.difference:+.2f}", f"{p_values[section, where, label, 'cost']:.2g}")
        )  # fmt: skip
    header = ("policy", *[figure.across] * (not one_column), "pairs", "only it", f"only {reference}", "p",
              "difference", "p")  # fmt: skip
    return [table(section, header, lines) for section, lines in blocks.items()]


def _cost(figure: Figure, trials: Sequence[Trial]) -> Callable[[Trial], float]:
    """Return the function that gives a trial's cost, for trials that are compared."""

    def known(trial: Trial) -> float | None:
        if figure.compared_by == "first_steps":
            return steps_to_solution(trial)
        seconds = first_solution(trial)
        if figure.compared_by == "iterations":
            return None if seconds is None else trial.iterations
        return seconds if figure.compared_by == "runtime" or seconds is None else trial.travel_time

    worst = max((found for trial in trials if (found := known(trial)) is not None), default=1.0)

    def cost(trial: Trial) -> float:
        found = known(trial)
        return 2 * worst if found is None else found

    return cost


def _deadlines(figure: Figure, groups: Sequence[Group]) -> list[str]:
    blocks: dict[str, list[tuple[str, list[SuccessWithin]]]] = {}
    for group in groups:
        first = group.trials[0]
        title = f"{group.section}, {first.num_robots} robots: success within a deadline for planning"
        blocks.setdefault(title, []).append((group.label, [success_by(group.trials, s) for s in figure.deadlines]))
    return [deadline_table(title, lines) for title, lines in blocks.items()]


def _is_told(figure: Figure, name: str) -> bool:
    """Check whether a table of numbers has an attribute of :class:`Measured`."""
    if name.startswith("first_steps"):
        return "first_steps" in figure.metrics
    if name.startswith("denoising_time"):
        return "denoising_time_share" in figure.metrics
    return figure.timed or not is_time(name)


def write_figure(folder: Path, figure: Figure, groups: Sequence[Group]) -> list[Path]:
    """Write ``NAME.csv``, ``NAME.md`` and ``NAME.png`` for the figure into a folder, and return their paths.

    Raises:
        OSError: If the folder does not exist or cannot be written to.
    """
    rows = [measured(group) for group in groups]
    paths = [folder / f"{figure.name}.{kind}" for kind in ("csv", "md", "png")]
    said = [{f"paper_{metric}": _said(figure, row, metric) for metric in figure.metrics} for row in rows]
    columns = [{name: value for name, value in vars(row).items() if _is_told(figure, name)} for row in rows]
    write_csv(paths[0], [{**shown, **papers} for shown, papers in zip(columns, said)])
    with replaced_when_done(paths[1]) as temporary:
        temporary.write_text(markdown(figure, groups), encoding="utf-8")
    with replaced_when_done(paths[2]) as temporary:
        draw(temporary, figure, groups, rows)
    return paths
