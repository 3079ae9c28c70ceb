"""Figures of success against noise, and under disturbances for a paper of two columns: small multiples, a heat map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from d4orm_env.core.files import replaced_when_done
from d4orm_env.core.lazy import LazyModule
from d4orm_env.disturbances.disturbance_registry import find_level, name_of
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import ACCELERATION
from d4orm_env.render import own_style
from d4orm_planners.evaluation.summary import SuccessRate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

figures: Any = LazyModule("matplotlib.figure")
KINDS = ("pdf", "svg", "png")  #: Files of a figure
COLUMN, PAGE = 3.5, 7.16  #: Width of a column and of a page of two [inches]
_LETTERS = 28  #: Letters that fit over a map beside each other
_LEGEND_LETTERS = 50  #: Letters of a legend that fit in a column beside each other, five for each symbol

_STYLE = {
    "text.parse_math": False,  # no name is a formula
    "font.size": 7,
    "axes.titlesize": 7,
    "axes.linewidth": 0.6,
    "pdf.fonttype": 42,
    "svg.hashsalt": "d4orm",
}
_UNDATED = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
_MARKERS = "osD^v<>P"
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#56B4E9", "#E69F00", "#7C3AED")


class Quantity(NamedTuple):
    """Quantity of a disturbance that is varied, in plain words, and its unit."""

    name: str
    unit: str

    @property
    def text(self) -> str:
        """Both on one line."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


_QUANTITIES = {
    "control_noise.std": Quantity("control noise", "std, control units"),
    "correlated_noise.std": Quantity("correlated control noise", "std, control units"),
    "bias.std": Quantity("control bias", "std, control units"),
    "delay.steps": Quantity("control delay", "time steps"),
    "lag.time_constant": Quantity("actuator lag", "s"),
    "dropout.probability": Quantity("lost commands", "probability"),
    "quantisation.step": Quantity("control quantisation", "control units"),
    "gain.std": Quantity("actuator gain error", "std"),
    "state_noise.position_std": Quantity("position noise", "std, m"),
    "state_noise.velocity_std": Quantity("velocity noise", "std, m/s"),
    "state_noise.heading_std": Quantity("heading noise", "std, rad"),
    "state_delay.steps": Quantity("state delay", "time steps"),
    "occlusion.range": Quantity("sensing range", "m"),
    "ray_noise.std": Quantity("range sensor noise", "std, m"),
    "push.rate": Quantity("pushes", "per robot and s"),
    "push.speed": Quantity("speed of pushes", "m/s"),
    "stall.probability": Quantity("stalled robots", "probability"),
    "stall.duration": Quantity("duration of stalls", "s"),
    "intruder.count": Quantity("intruders", "number"),
    "intruder.speed": Quantity("speed of intruders", "m/s"),
    "intruder.radius": Quantity("radius of intruders", "m"),
    "drag.coefficient": Quantity("drag", "1/s"),
    "limit_mismatch.factor": Quantity("true over assumed limits", ""),
}


def quantity_of(disturbance: str) -> Quantity:
    """The quantity that a name such as ``"push.speed"`` stands for; any other label itself."""
    try:
        level = find_level(disturbance)
    except (ValueError, ImportError):
        return Quantity(disturbance, "")
    fixed = ", ".join(f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
                      for name, value in level.fixed.items())  # fmt: skip
    kind = name_of(level.kind)
    known = _QUANTITIES.get(f"{kind}.{level.attribute}")
    quantity = known or Quantity(f"{kind}: {level.attribute}".replace("_", " "), "")
    return quantity._replace(name=f"{quantity.name} ({fixed})") if fixed else quantity


def write_figure(folder: Path, name: str, figure: Figure) -> list[Path]:
    """Write a figure as PDF, SVG and PNG. The same figure gives the same bytes."""
    paths = [folder / f"{name}.{kind}" for kind in KINDS]
    for path, kind in zip(paths, KINDS):
        with replaced_when_done(path) as temporary, own_style(_STYLE):
            figure.savefig(temporary, format=kind, dpi=300, metadata=_UNDATED.get(kind))
    return paths


def _grid(count: int, across: int, width: float, height: float) -> tuple[Figure, Sequence[Axes]]:
    """A figure of so many axes of success, so wide, and so high by row [inches].

    Made without pyplot, which keeps state and wants a display.
    """
    rows = -(-count // across)
    figure: Figure = figures.Figure(figsize=(width, 0.3 + height * rows), layout="constrained")
    axes: list[Axes] = figure.subplots(rows, across, squeeze=False, sharey=True).ravel().tolist()
    for ax in axes[count:]:
        ax.set_visible(False)
    for ax in axes[::across]:
        ax.set_ylabel("success rate")
    return figure, axes[:count]


@own_style(_STYLE)
def draw_noise(groups: Mapping[str, Sequence[SuccessRate]]) -> Figure:
    """Success against the execution noise: a panel per title, and in it a line with confidence intervals per policy.

    One panel is as wide as a column and has no title, more are as wide as a page.
    """
    across = min(3, len(groups))
    labels = list(dict.fromkeys(rate.label for group in groups.values() for rate in group))
    figure, axes = _grid(len(groups), across, PAGE if across > 1 else COLUMN, 1.9)
    for ax, (title, group) in zip(axes, groups.items()):
        rates = [replace(rate, level=rate.control_noise_std) for rate in group]
        _draw_panel(ax, "control_noise", labels, sorted(rates, key=lambda rate: rate.control_noise_std))
        ax.set(title=title if len(groups) > 1 else "", xlabel="standard deviation of the control noise")
    _add_legend(figure, axes, across)
    return figure


@own_style(_STYLE)
def draw_lines(rates: Sequence[SuccessRate]) -> Figure:
    """Success against the level of every disturbance: a panel each, a line with confidence intervals per policy.

    Without a title, as figures in a paper are. One or two panels are as wide as a column, more as a page of two.
    """
    names, labels = (list(dict.fromkeys(all_of)) for all_of in zip(*((one.disturbance, one.label) for one in rates)))
    across = min(4, len(names))
    figure, axes = _grid(len(names), across, PAGE if across > 2 else COLUMN, 1.45)
    for ax, name in zip(axes, names):
        _draw_panel(ax, name, labels, [rate for rate in rates if rate.disturbance == name])
    _add_legend(figure, axes, across)
    return figure


def _add_legend(figure: Figure, axes: Sequence[Axes], across: int) -> None:
    lines, labels = axes[0].get_legend_handles_labels()
    in_one_row = sum(map(len, labels)) + 5 * len(labels) <= _LEGEND_LETTERS
    columns = len(labels) if in_one_row else min(max(across, 2), len(labels))
    figure.legend(lines, labels, loc="outside lower center", ncols=columns, frameon=False)


def _draw_panel(ax: Axes, name: str, labels: Sequence[str], rates: Sequence[SuccessRate]) -> None:
    levels = list(dict.fromkeys(rate.level for rate in rates))
    for number, label in enumerate(labels):
        line = [rate for rate in rates if rate.label == label]
        # Beside each other, so that no interval hides another.
        shift = 0.12 * (number - (len(labels) - 1) / 2)
        x, y = [levels.index(rate.level) + shift for rate in line], np.array([rate.rate for rate in line])
        ends = np.abs(np.array([(rate.lower, rate.upper) for rate in line]).T - y)
        color, marker = _COLORS[number % len(_COLORS)], _MARKERS[number % len(_MARKERS)]
        ax.errorbar(x, y, ends, color=color, marker=marker, markersize=3, linewidth=1, elinewidth=0.6, label=label)
    quantity = quantity_of(name)
    ax.set_xticks(range(len(levels)), [_shown(level) for level in levels])
    ax.set(title=quantity.name, xlabel=_unit(quantity, rates), ylim=(-0.06, 1.06), xlim=(-0.5, len(levels) - 0.5))
    ax.grid(axis="y", color="0.9", linewidth=0.5)
    ax.tick_params(length=2, width=0.5)


def _unit(quantity: Quantity, rates: Sequence[SuccessRate]) -> str:
    """The unit, of controls that of all robots where these are accelerated alike."""
    known = [MODELS.get(rate.model) for rate in rates]
    accelerated = all(model is not None and set(model.control_limits) == {ACCELERATION} for model in known)
    return quantity.unit.replace("control units", "m/s²") if accelerated else quantity.unit


@own_style(_STYLE)
def draw_map(rates: Sequence[SuccessRate]) -> Figure:
    """Success in percent: a row per level of every disturbance, the undisturbed one first, a column per policy.

    All rates are of one level of the execution noise, which the undisturbed one has too.
    """
    labels = list(dict.fromkeys(rate.label for rate in rates))
    rows = list(dict.fromkeys(map(_row, sorted(rates, key=lambda rate: not rate.undisturbed))))
    shares = np.full((len(rows), len(labels)), np.nan)
    for rate in rates:
        shares[rows.index(_row(rate)), labels.index(rate.label)] = 100 * rate.rate
    stretches = list(_stretches(name for name, _ in rows))
    # The name of a disturbance has two lines, whether it has one row or several.
    height = 0.22 if any(name and first == last for name, first, last in stretches) else 0.135
    longest = max(map(len, labels))
    upright = longest * len(labels) > _LETTERS
    top = 0.12 + 0.06 * longest if upright else 0.25
    whole = top + 0.03 + height * len(rows)
    figure: Figure = figures.Figure(figsize=(COLUMN, whole))
    ax = figure.add_axes((0.5, 0.03 / whole, 0.48, height * len(rows) / whole))
    _draw_cells(ax, shares)
    ax.set_yticks(range(len(rows)), ["" if name == "" else _shown(level) for name, level in rows], fontsize=6)
    ax.set_xticks(range(len(labels)), labels, rotation=90 if upright else 0)
    ax.tick_params(length=0, top=False, labeltop=True, labelbottom=False)
    ax.annotate("success [%]", (0, 1), (-4, 4), "axes fraction", "offset points", ha="right", fontsize=6)
    noise = rates[0].control_noise_std
    for name, first, last in stretches:
        alone = f"noise {noise:g} alone" if noise else "undisturbed"
        quantity = quantity_of(name)
        text = quantity._replace(unit=_unit(quantity, rates)).text.replace(" [", "\n[") if name else alone
        ax.annotate(text, (0, (first + last) / 2), (-26 if name else -4, 0), ("axes fraction", "data"), "offset points",
                    ha="right", va="center", fontsize=6)  # fmt: skip
        ax.axhline(first - 0.5, color="white", linewidth=1.5)
    return figure


def _draw_cells(ax: Axes, shares: np.ndarray) -> None:
    """Colours and numbers of a map; nothing where a share is NaN."""
    ax.imshow(shares, cmap="RdYlBu", vmin=0, vmax=100, aspect="auto")
    for (row, column), share in np.ndenumerate(shares):
        if np.isfinite(share):
            ink = "black" if 15 < share < 85 else "white"
            ax.text(column, row, f"{share:.0f}", ha="center", va="center", fontsize=6, color=ink)


def _row(rate: SuccessRate) -> tuple[str, float | None]:
    return ("", None) if rate.undisturbed else (rate.disturbance, rate.level)


def _stretches(names: Iterable[str]) -> Iterator[tuple[str, int, int]]:
    """Yield each name with its first and last row."""
    for name, group in groupby(enumerate(names), key=lambda row: row[1]):
        numbers = [number for number, _ in group]
        yield name, numbers[0], numbers[-1]


def _shown(level: float | None) -> str:
    return "-" if level is None else f"{level:g}"
