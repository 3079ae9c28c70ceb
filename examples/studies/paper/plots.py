"""A reproduced figure as a picture: one column per section, as in the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

import numpy as np
from examples.denoising import steps_spent, steps_to_solution
from examples.studies.paper.figure import Figure, Group
from examples.studies.paper.numbers import Measured, column, first_solution

from d4orm_env.render import own_style
from d4orm_planners.evaluation.comparison import survival
from d4orm_planners.evaluation.store import BestSoFar, Trial

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas
    from matplotlib.legend import Legend

NUMERIC: Mapping[str, str] = MappingProxyType(
    {"num_robots": "robots", "nodes": "nodes", "control_noise_std": "standard deviation of the noise"}
)
"""Attributes that may vary from left to right as a number, and their labels."""
INSTANTS = 200
"""Points of an anytime curve."""


@own_style()
def draw(path: Path, figure: Figure, groups: Sequence[Group], rows: Sequence[Measured]) -> None:
    """Write a figure with at least one plot as PNG, from its trials and their numbers, a row per group."""
    # Made without pyplot, which would keep state and want a display.
    from matplotlib.figure import Figure as Canvas

    titles = tuple(dict.fromkeys(row.section for row in rows))
    wide = 2 if figure.across == "policy" else 1
    size = (max(3.2 * wide * len(titles), 5.0), (3.4 if wide == 2 else 2.6) * len(figure.plots) + 0.8)
    canvas = Canvas(figsize=size, layout="constrained")
    # Some have time from left to right.
    sharex: Literal["col"] | bool = False if {"anytime", "survival"} & set(figure.plots) else "col"
    axes = canvas.subplots(len(figure.plots), len(titles), squeeze=False, sharex=sharex, sharey="row")
    for i, title in enumerate(titles):
        axes[0, i].set_title(title)
        shown = [(group, row) for group, row in zip(groups, rows) if row.section == title]
        for ax, plot in zip(axes[:, i], figure.plots):
            PLOTS[plot](ax, figure, shown)
            ax.grid(alpha=0.3)
            ax.yaxis.label.set_visible(i == 0)
            if sharex:
                ax.label_outer()
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if len(labels) > 1:
        add_legend(canvas, handles, labels, most=2 + 2 * len(titles))
    canvas.savefig(path, dpi=130)


def add_legend(canvas: Canvas, handles: Sequence[Artist], labels: Sequence[str], most: int) -> Legend:
    """A legend below the plots, with as many columns as there are labels, the figure is wide, and ``most`` allows."""
    columns = min(len(labels), most)
    legend = canvas.legend(handles, labels, loc="outside lower center", ncols=columns)
    while columns > 1 and legend.get_window_extent().width > canvas.bbox.width:
        legend.remove()
        columns -= 1
        legend = canvas.legend(handles, labels, loc="outside lower center", ncols=columns)
    return legend


Shown = Sequence[tuple[Group, Measured]]


def _lines(figure: Figure, shown: Shown) -> dict[str, list[Measured]]:
    """Rows by line of a plot: one per policy, or a single one where policies go from left to right."""
    lines: dict[str, list[Measured]] = {}
    for _, row in shown:
        lines.setdefault("" if figure.across == "policy" else row.label, []).append(row)
    return lines


def _metric(ax: Axes, figure: Figure, shown: Shown, *, value: str, ends: tuple[str, str] | None, label: str,
            log: bool = False) -> None:  # fmt: skip
    """A number against what the figure varies, with a band; markers are crosses where trials failed."""
    columns = list(dict.fromkeys(column(figure, row) for _, row in shown))
    numeric = figure.across in NUMERIC
    for i, (name, rows) in enumerate(_lines(figure, shown).items()):
        known = [row for row in rows if getattr(row, value) is not None]
        positions = [float(column(figure, row)) if numeric else columns.index(column(figure, row)) for row in known]
        values, line = [getattr(row, value) for row in known], "-" if numeric else "none"
        ax.plot(positions, values, label=name, marker="o", markersize=4, linestyle=line, color=f"C{i}")
        failed = [
            (position, getattr(row, value)) for position, row in zip(positions, known) if row.successes < row.trials
        ]
        if failed and value != "rate":
            ax.plot(*zip(*failed), marker="x", markersize=8, linestyle="none", color=f"C{i}")
        if ends:
            # What is never has no band.
            low, high = (np.array([getattr(row, end) for row in known], np.float64) for end in ends)
            if numeric:
                ax.fill_between(positions, low, high, color=f"C{i}", alpha=0.1, linewidth=0)
            else:
                ax.vlines(positions, low, high, color=f"C{i}", alpha=0.5)
    if not numeric:
        ax.set_xticks(range(len(columns)), columns, rotation=60 if figure.across == "policy" else 20, ha="right")
    elif figure.across != "control_noise_std":
        ax.set_xticks([int(name) for name in columns])
    ax.set_xlabel(NUMERIC.get(figure.across, ""))
    ax.set_ylabel(label)
    if log and any(getattr(row, value) for _, row in shown):
        ax.set_yscale("log")


def _success(ax: Axes, figure: Figure, shown: Shown) -> None:
    """Success rates with their confidence bands."""
    _metric(ax, figure, shown, value="rate", ends=("lower", "upper"), label="success rate")
    ax.set_ylim(-0.03, 1.03)


def _survival(ax: Axes, figure: Figure, shown: Shown) -> None:
    """The share of all trials that are not solved yet against time or steps, with its band, for the largest team."""
    counted = figure.compared_by == "first_steps"
    largest = max(row.num_robots for _, row in shown)
    for i, (group, row) in enumerate((group, row) for group, row in shown if row.num_robots == largest):
        curve = survival([(steps_to_solution if counted else first_solution)(trial) for trial in group.trials])
        spent = [(steps_spent(trial) if counted else trial.wall_time) or 0.0 for trial in group.trials]
        end = 1.05 * max([*curve.costs, *spent]) or 1.0
        edges = [min([*curve.costs, end]) / 2, *curve.costs, end]
        lower, upper = [1.0, *curve.lower], [1.0, *curve.upper]
        ax.stairs([1.0, *curve.unsolved], edges, baseline=None, color=f"C{i}", label=row.label)
        ax.stairs(upper, edges, baseline=lower, fill=True, color=f"C{i}", alpha=0.1)
    ax.tick_params(axis="x", which="minor", labelbottom=False)
    ax.set(xlabel=_effort(figure, largest), ylabel="not solved", xscale="log", ylim=(-0.03, 1.03))


def _effort(figure: Figure, num_robots: int) -> str:
    """Return the label for the effort of planning."""
    what = "denoising steps" if figure.compared_by == "first_steps" else "planning time, s"
    return f"{what} ({num_robots} robots)"


def _spent(best: BestSoFar, counted: bool) -> float:
    """Denoising steps, or seconds, until a plan was found."""
    return float(best.steps or 0) if counted else best.seconds


def best_reward(trial: Trial, spent: np.ndarray, counted: bool = False) -> np.ndarray:
    """Mean reward of the best plan so far.

    Args:
        trial: A trial of a planner.
        spent: ``(n,)`` times since the start of the solve [s], in ascending order.
        counted: Whether these are denoising steps instead.

    Returns:
        ``(n,)`` rewards; NaN before the first plan.
    """
    times = np.array([_spent(best, counted) for best in trial.progress])
    rewards = np.array([np.nan, *(best.reward for best in trial.progress)])
    return rewards[np.searchsorted(times, spent, side="right")]


def _anytime(ax: Axes, figure: Figure, shown: Shown) -> None:
    """Median best reward against time or steps with quartiles, for the largest team; a dot where half are solved.

    A curve begins when half of the trials have a plan.
    """
    counted = figure.compared_by == "first_steps"
    largest = max(row.num_robots for _, row in shown)
    for i, (group, row) in enumerate((group, row) for group, row in shown if row.num_robots == largest):
        times = [_spent(best, counted) for trial in group.trials for best in trial.progress]
        if not times:
            continue  # every trial raised an error, or the policy makes no plan
        spent = np.geomspace(max(min(times), 1e-3), 1.1 * max(*times, 1e-3), INSTANTS)
        rewards = np.array([best_reward(trial, spent, counted) for trial in group.trials])
        seen = 2 * np.isfinite(rewards).sum(axis=0) >= len(rewards)
        low, middle, high = np.nanpercentile(rewards[:, seen], (25, 50, 75), axis=0)
        ax.plot(spent[seen], middle, color=f"C{i}", label=row.label)
        ax.fill_between(spent[seen], low, high, color=f"C{i}", alpha=0.15, linewidth=0)
        solved = row.first_steps if counted else row.runtime
        if solved is not None and 2 * row.successes >= row.trials and seen.any():
            ax.plot(solved, np.interp(solved, spent[seen], middle), marker="o", color=f"C{i}")
    ax.tick_params(axis="x", which="minor", labelbottom=False)
    ax.set(xlabel=_effort(figure, largest), ylabel="best reward so far", xscale="log")


PLOTS: Mapping[str, Callable[[Axes, Figure, Shown], None]] = MappingProxyType({
    "runtime": partial(_metric, value="runtime", ends=("runtime_lower", "runtime_upper"), label="runtime, s", log=True),
    "first_steps": partial(
        _metric, value="first_steps", ends=("first_steps_lower", "first_steps_upper"), label="denoising steps", log=True
    ),
    "success": _success,
    "travel_time": partial(_metric, value="travel_time", ends=None, label="travel time, s"),
    "makespan": partial(_metric, value="makespan", ends=None, label="makespan, s"),
    "iterations": partial(_metric, value="iterations", ends=None, label="iterations", log=True),
    "waiting_share": partial(_metric, value="waiting_share", ends=None, label="share of time spent waiting"),
    "jerk": partial(_metric, value="jerk", ends=None, label="mean squared jerk"),
    "survival": _survival,
    "anytime": _anytime,
})  # fmt: skip
"""Plots by name."""
