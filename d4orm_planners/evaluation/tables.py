"""Success rates as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from d4orm_planners.evaluation.report import table
from d4orm_planners.evaluation.summary import SuccessRate, SuccessWithin

HEADER = ("policy", "noise", "success", "95% interval", "verified", "contact", "not in time", "errors",
          "travel time, s", "planning, s", "computing per s of motion, s")  # fmt: skip


def markdown(rates: Sequence[SuccessRate]) -> str:
    """One table per scenario and team, with errors below. Intervals of means stand in brackets."""
    blocks = [
        table(f"{scenario}, {robots} robots, {model}", HEADER, [cells(rate) for rate in group])
        for (scenario, robots, model), group in panels(rates).items()
    ]
    return "\n\n".join([*blocks, *errors(rates)]) + "\n"


def cells(rate: SuccessRate) -> tuple[str, ...]:
    """A row under :data:`HEADER`."""
    return (
        rate.label,
        f"{rate.noise:g}",
        f"{rate.successes} of {rate.trials} ({rate.rate:.0%})",
        f"{rate.lower:.0%} to {rate.upper:.0%}",
        *(str(count) for count in (rate.verified, rate.contacts, rate.late, rate.errors)),
        interval(rate.travel_time, rate.travel_time_lower, rate.travel_time_upper, 2),
        "-" if rate.wall_time is None else f"{rate.wall_time:.2f}",
        interval(rate.compute, rate.compute_lower, rate.compute_upper, 3),
    )


def interval(mean: float | None, lower: float | None, upper: float | None, digits: int) -> str:
    """A mean with its interval in brackets; a dash where nothing was measured."""
    if mean is None:
        return "-"
    return f"{mean:.{digits}f}" + ("" if lower is None else f" ({lower:.{digits}f} to {upper:.{digits}f})")


def panels(rates: Iterable[SuccessRate]) -> dict[tuple[str, int, str], list[SuccessRate]]:
    """Rates by scenario, team size and models, in order of appearance."""
    groups: dict[tuple[str, int, str], list[SuccessRate]] = {}
    for rate in rates:
        groups.setdefault((rate.scenario, rate.robots, rate.model), []).append(rate)
    return groups


def errors(rates: Iterable[SuccessRate]) -> list[str]:
    """A list of the errors as the only block; no block without errors."""
    lines = dict.fromkeys(f"- `{rate.label}`: {rate.error}" for rate in rates if rate.error)
    return ["\n".join(["### Errors", "", *lines])] if lines else []


def deadline_table(title: str, rows: Iterable[tuple[str, Sequence[SuccessWithin]]]) -> str:
    """Success by deadline: one row per policy, one column per deadline."""
    listed = list(rows)
    header = ("policy", *(f"{within.deadline:g} s" for within in listed[0][1]))
    lines = [(label, *(f"{w.rate:.0%} ({w.lower:.0%} to {w.upper:.0%})" for w in line)) for label, line in listed]
    return table(title, header, lines)
