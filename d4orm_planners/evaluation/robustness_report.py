"""Success rates as CSV, as a Markdown table and as a picture."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from d4orm_env.core.files import replaced_when_done
from d4orm_planners.evaluation.exports import write_rates
from d4orm_planners.evaluation.report import table
from d4orm_planners.evaluation.summary import SuccessRate
from d4orm_planners.evaluation.tables import errors, panels


def write_robustness(folder: str | os.PathLike[str], rates: Sequence[SuccessRate]) -> tuple[Path, Path, Path]:
    """Write ``robustness.csv``, ``robustness.md`` and ``robustness.png``.

    Args:
        folder: Where to.
        rates: What :func:`~d4orm_planners.evaluation.robustness.robustness` returned.

    Returns:
        The three paths.

    Raises:
        OSError: If the folder does not exist or cannot be written to.
    """
    paths = Path(folder, "robustness.csv"), Path(folder, "robustness.md"), Path(folder, "robustness.png")
    write_rates(paths[0], rates)
    with replaced_when_done(paths[1]) as path:
        path.write_text(markdown(rates), encoding="utf-8")
    with replaced_when_done(paths[2]) as path:
        _draw(path, rates)
    return paths


def markdown(rates: Sequence[SuccessRate]) -> str:
    """One table per scenario and team, with errors below."""
    header = ("policy", "noise", "success", "95% interval", "contact", "not in time", "errors", "travel time, s",
              "planning, s")  # fmt: skip
    blocks = []
    for (scenario, robots, model), group in panels(rates).items():
        rows = [
            (
                rate.label,
                f"{rate.noise:g}",
                f"{rate.successes} of {rate.trials} ({rate.rate:.0%})",
                f"{rate.lower:.0%} to {rate.upper:.0%}",
                *(str(count) for count in (rate.contacts, rate.late, rate.errors)),
                *("-" if value is None else f"{value:.2f}" for value in (rate.travel_time, rate.wall_time)),
            )
            for rate in group
        ]
        blocks.append(table(f"{scenario}, {robots} robots, {model}", header, rows))
    return "\n\n".join([*blocks, *errors(rates)]) + "\n"


def _draw(path: Path, rates: Sequence[SuccessRate]) -> None:
    """Success against noise with confidence bands: one line per policy, one panel per scenario and team."""
    # The figure is made without pyplot, which would keep state and want a display.
    from matplotlib.figure import Figure

    groups = panels(rates)
    columns = min(len(groups), 3)
    rows = -(-len(groups) // columns)
    figure = Figure(figsize=(4.8 * columns, 3.6 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for ax in axes[len(groups) :]:
        ax.set_visible(False)
    for ax, ((scenario, robots, model), group) in zip(axes, groups.items()):
        for policy in dict.fromkeys(rate.label for rate in group):
            line = sorted((rate for rate in group if rate.label == policy), key=lambda rate: rate.noise)
            noise = [rate.noise for rate in line]
            (drawn,) = ax.plot(noise, [rate.rate for rate in line], marker="o", label=policy, clip_on=False)
            lower, upper = [rate.lower for rate in line], [rate.upper for rate in line]
            ax.fill_between(noise, lower, upper, color=drawn.get_color(), alpha=0.15, linewidth=0)
        ax.set(title=f"{scenario}, {robots} robots, {model}", ylim=(0, 1))
        ax.set(xlabel="standard deviation of the control noise", ylabel="success rate")
        ax.grid(alpha=0.3)
    axes[0].legend(loc="best")
    figure.savefig(path, dpi=150)
