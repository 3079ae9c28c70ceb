"""Robustness of policies, as tables and pictures: to noise on the controls, and to every disturbance."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.lazy import LazyModule
from d4orm_env.render.style import own_style
from d4orm_planners.evaluation.comparison import PairedPolicies, compare_pairs
from d4orm_planners.evaluation.summary import THRESHOLD, SuccessRate, Tolerance, TrialGroup, success_rates, tolerances
from d4orm_planners.evaluation.tables import markdown, panels, table, target, write_csv, write_rates

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

figures: Any = LazyModule("matplotlib.figure")


def write_robustness(folder: str | os.PathLike[str], rates: Sequence[SuccessRate]) -> list[Path]:
    """Write ``robustness.csv``, ``robustness.md`` and, where nothing but noise went wrong, ``robustness.png``, success
    against it.

    Args:
        folder: Output folder.
        rates: Result of :func:`~d4orm_planners.evaluation.evaluate.evaluate`.

    Returns:
        The paths.

    Raises:
        OSError: If the folder does not exist or cannot be written to.
    """
    paths = [Path(folder, f"robustness.{kind}") for kind in ("csv", "md", "png")]
    write_rates(paths[0], rates)
    with target(paths[1]) as path:
        path.write_text(markdown(rates), encoding="utf-8")
    if any(rate.disturbance for rate in rates):
        return paths[:2]
    with target(paths[2]) as path:
        _draw_noise(path, rates)
    return paths


def write_disturbances(folder: str | os.PathLike[str], groups: Sequence[TrialGroup]) -> list[Path]:
    """Write ``disturbances.md``, ``tolerance.csv``, ``pairs.csv``, ``tolerance.png`` and a picture per disturbance.

    Args:
        folder: Output folder.
        groups: Result of :func:`~d4orm_planners.evaluation.evaluate.run_study` for a study with disturbances.

    Returns:
        The paths; ``pairs.csv`` is not among them, and not written, where there is one policy only.

    Raises:
        OSError: If the folder does not exist or cannot be written to.
    """
    rates = success_rates(groups)
    stood, pairs = tolerances(rates), compare_pairs(groups)
    paths = [Path(folder, name) for name in ("disturbances.md", "tolerance.csv", "tolerance.png")]
    with target(paths[0]) as path:
        path.write_text(_page(rates, stood, pairs), encoding="utf-8")
    write_csv(paths[1], [vars(one) for one in stood])
    with target(paths[2]) as path:
        _draw_map(path, rates)
    if pairs:
        paths.append(Path(folder, "pairs.csv"))
        write_csv(paths[-1], [vars(pair) for pair in pairs])
    for name in dict.fromkeys(one.disturbance for one in stood):
        file = re.sub(r"[^\w.-]", "_", name)
        paths.append(Path(folder, f"disturbance-{file}.png"))
        with target(paths[-1]) as path:
            _draw_disturbance(path, name, [rate for rate in rates if rate.disturbance == name])
    return paths


def _page(rates: Sequence[SuccessRate], stood: Sequence[Tolerance], pairs: Sequence[PairedPolicies]) -> str:
    titles = {(rate.scenario, rate.num_robots, rate.model): title for title, group in panels(rates).items()
              for rate in group}  # fmt: skip
    blocks = [f"## Level at which success falls below {stood[0].threshold:.0%}"]
    for place, title in titles.items():
        here = [one for one in stood if (one.scenario, one.num_robots, one.model) == place]
        for noise in dict.fromkeys(one.control_noise_std for one in here):
            cells = {(one.label, one.disturbance): one.text for one in here if one.control_noise_std == noise}
            blocks.append(_matrix(f"{title}, noise {noise:g}" if noise else title, cells))
    if pairs:
        blocks += ["## Policies compared trial by trial", _PAIRS, *_pair_tables(titles, pairs)]
    return "\n\n".join([*blocks, "## Success", markdown(rates)])


_PAIRS = """\
Trials with the same problem, seed and disturbance. *Only first* and *only second* count those in which one of the two
succeeded; p is that of McNemar's exact test. Differences have 95% intervals by a paired bootstrap."""


def _matrix(title: str, cells: Mapping[tuple[str, str], str]) -> str:
    columns = list(dict.fromkeys(name for _, name in cells))
    rows = [
        (label, *(cells.get((label, name), "-") for name in columns))
        for label in dict.fromkeys(label for label, _ in cells)
    ]
    return table(title, ("policy", *columns), rows)


def _pair_tables(titles: Mapping[tuple[str, int, str], str], pairs: Sequence[PairedPolicies]) -> list[str]:
    header = ("first", "second", "noise", "disturbance", "level", "trials", "only first", "only second", "p",
              "difference in success", "first slower by, s")  # fmt: skip
    blocks = []
    for place, title in titles.items():
        rows = [_pair_cells(pair) for pair in pairs if (pair.scenario, pair.num_robots, pair.model) == place]
        if rows:
            blocks.append(table(title, header, rows))
    return blocks


def _pair_cells(pair: PairedPolicies) -> tuple[str, ...]:
    slower = "-" if pair.slower is None else f"{pair.slower:.2f}"
    if pair.slower_lower is not None:
        slower += f" ({pair.slower_lower:.2f} to {pair.slower_upper:.2f})"
    return (
        pair.first,
        pair.second,
        f"{pair.control_noise_std:g}",
        pair.disturbance or "-",
        "-" if pair.level is None else f"{pair.level:g}",
        *(str(count) for count in (pair.trials, pair.only_first, pair.only_second)),
        f"{pair.p_value:.3g}",
        f"{pair.difference:+.0%} ({pair.lower:+.0%} to {pair.upper:+.0%})",
        slower,
    )


@own_style({"text.parse_math": False})  # no name is a formula
def _draw_noise(path: Path, rates: Sequence[SuccessRate]) -> None:
    """Success against the execution noise: one line per policy, one panel per scenario and team."""
    groups = panels(rates)
    figure, axes = _figure(len(groups), 4.8, 3.6)
    for ax, (title, group) in zip(axes, groups.items()):
        _draw_lines(ax, sorted(group, key=lambda rate: rate.control_noise_std), lambda rate: rate.control_noise_std)
        ax.set(title=title, xlabel="standard deviation of the control noise")
    axes[0].legend(loc="best")
    figure.savefig(path, dpi=150)


@own_style({"text.parse_math": False})  # no name is a formula
def _draw_disturbance(path: Path, name: str, rates: Sequence[SuccessRate]) -> None:
    """Success against the level of one disturbance: one line per policy, one panel per scenario, team and noise.

    Args:
        path: Output file.
        name: The disturbance.
        rates: Those of its levels, at least one.
    """
    groups = _panels(rates)
    figure, axes = _figure(len(groups), 4.8, 3.6)
    for ax, (title, group) in zip(axes, groups.items()):
        places = {level: place for place, level in enumerate(dict.fromkeys(rate.level for rate in group))}
        # Levels that are no quantities, or lie apart by orders of magnitude, are places in a row.
        levels = [level for level in places if level is not None and np.isfinite(level)]
        even = len(levels) < len(places) or _uneven(levels)
        _draw_lines(ax, group, lambda rate: places[rate.level] if even else rate.level)  # noqa: B023 - called at once
        if even:
            ax.set_xticks(range(len(places)), [_shown(level) for level in places])
        elif levels[0] > levels[-1]:
            ax.invert_xaxis()
        ax.axhline(THRESHOLD, color="0.6", linewidth=0.8, linestyle=":")
        ax.set(title=title, xlabel=name)
    axes[0].legend(loc="best")
    figure.savefig(path, dpi=150)


def _draw_lines(ax: Any, rates: Sequence[SuccessRate], place: Callable[[SuccessRate], float | None]) -> None:
    """A line with a confidence band per policy."""
    for policy in dict.fromkeys(rate.label for rate in rates):
        line = [rate for rate in rates if rate.label == policy]
        x = [place(rate) for rate in line]
        (drawn,) = ax.plot(x, [rate.rate for rate in line], marker="o", label=policy, clip_on=False)
        lower, upper = [rate.lower for rate in line], [rate.upper for rate in line]
        ax.fill_between(x, lower, upper, color=drawn.get_color(), alpha=0.15, linewidth=0)
    ax.set(ylabel="success rate", ylim=(0, 1))
    ax.grid(alpha=0.3)


@own_style({"text.parse_math": False})  # no name is a formula
def _draw_map(path: Path, rates: Sequence[SuccessRate]) -> None:
    """A heat map of success: a row per policy, a column per level of every disturbance, a panel as above."""
    groups = _panels([rate for rate in rates if rate.disturbance])
    columns = max(len({(rate.disturbance, rate.level) for rate in group}) for group in groups.values())
    rows = max(len({rate.label for rate in group}) for group in groups.values())
    figure, axes = _figure(len(groups), 1.6 + 0.42 * columns, 1.7 + 0.35 * rows, across=1)
    for ax, (title, group) in zip(axes, groups.items()):
        _draw_cells(ax, group)
        ax.set_title(title, loc="left", pad=30)
    figure.savefig(path, dpi=150)


def _draw_cells(ax: Axes, group: Sequence[SuccessRate]) -> None:
    columns = list(dict.fromkeys((rate.disturbance, rate.level) for rate in group))
    labels = list(dict.fromkeys(rate.label for rate in group))
    shares = np.full((len(labels), len(columns)), np.nan)
    for rate in group:
        shares[labels.index(rate.label), columns.index((rate.disturbance, rate.level))] = rate.rate
    ax.imshow(shares, cmap="RdYlBu", vmin=0, vmax=1, aspect="auto")
    for (row, column), share in np.ndenumerate(shares):
        if np.isfinite(share):
            ink = "black" if 0.15 < share < 0.85 else "white"
            ax.text(column, row, f"{100 * share:.0f}", ha="center", va="center", fontsize=8, color=ink)
    ax.set_xticks(range(len(columns)), [_shown(level) for _, level in columns], fontsize=8)
    ax.set_yticks(range(len(labels)), labels)
    ax.tick_params(length=0)
    edges = [place for place in range(len(columns)) if not place or columns[place][0] != columns[place - 1][0]]
    for begin, end in pairwise([*edges, len(columns)]):
        ax.text((begin + end - 1) / 2, -0.6, columns[begin][0].replace(".", "\n"), ha="center", va="bottom", fontsize=8)
        ax.axvline(begin - 0.5, color="white", linewidth=4)
    ax.set_xlabel("level; success in %")


def _panels(rates: Sequence[SuccessRate]) -> dict[str, list[SuccessRate]]:
    """Group rates as in the tables, but for levels of noise too."""
    groups: dict[str, list[SuccessRate]] = {}
    for title, group in panels(rates).items():
        for rate in group:
            noise = rate.control_noise_std
            groups.setdefault(f"{title}, noise {noise:g}" if noise else title, []).append(rate)
    return groups


def _figure(count: int, width: float, height: float, across: int = 3) -> tuple[Figure, NDArray[np.object_]]:
    """A figure made without pyplot, which would keep state and want a display, and its axes."""
    columns = min(count, across)
    rows = -(-count // columns)
    figure = figures.Figure(figsize=(width * columns, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[count:]:
        ax.set_visible(False)
    return figure, axes


def _uneven(levels: Sequence[float]) -> bool:
    gaps = np.abs(np.diff(levels))
    return bool(len(gaps) and gaps.max() > 20 * max(gaps.min(), 1e-12))


def _shown(level: float | None) -> str:
    return "-" if level is None else f"{level:g}"
