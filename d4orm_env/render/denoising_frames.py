"""Denoising as pictures and replays show it: a candidate at a time, from noise to clean paths."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.files import replaced_when_done
from d4orm_env.core.problem import Problem
from d4orm_env.render import own_style
from d4orm_env.render.panels import Axes2D, TeamLayer, view_limits
from d4orm_env.render.pictures import PICTURE_SUFFIXES


@dataclass(frozen=True, eq=False)
class Denoising:
    """Candidates of some denoising steps ``S``, each at ``P`` points of its time."""

    labels: tuple[str, ...]  #: ``S`` texts, one for every step shown
    paths: FloatArray  #: ``(S, P, K, d)`` where the candidate leads [m]
    samples: FloatArray  #: ``(S, N, P, K, d)`` where some of the samples lead that it was made of [m]
    alpha: FloatArray  #: ``(S, N)`` how opaque each sample is drawn, 0 to 1
    seconds_per_step: float = 0.06  #: Time for which a replay shows each

    def __post_init__(self) -> None:
        steps, expected = len(self.labels), (len(self.labels), self.alpha.shape[-1], *self.paths.shape[1:])
        if not steps or len(self.paths) != steps or self.samples.shape != expected or self.alpha.shape != expected[:2]:
            raise ValueError(
                f"labels, paths, samples and alpha have lengths and shapes {steps}, {self.paths.shape}, "
                f"{self.samples.shape} and {self.alpha.shape}; they must be S, (S, P, K, d), (S, N, P, K, d) and (S, N)"
            )
        if not (np.isfinite(self.paths).all() and np.isfinite(self.samples).all()):
            raise ValueError("paths and samples must be finite")


@own_style()
def save_denoising(problem: Problem, denoising: Denoising, path: str | Path, panels: int = 6) -> Path:
    """Write a picture of a plan's denoising: the paths of its candidate, from the first step to the last.

    Faint lines are samples. Spatial problems are seen from above.

    Args:
        problem: The problem that was planned for.
        denoising: Denoising as seen.
        path: A PNG, SVG or PDF file.
        panels: Number of steps to show, in rows of three.

    Raises:
        ValueError: For another suffix.
        OSError: If it cannot be written; nothing is left behind then.
    """
    shown = np.unique(np.linspace(0, len(denoising.labels) - 1, panels).round().astype(int))
    rows = -(-len(shown) // 3)
    limits = view_limits(problem)
    figure = Figure(figsize=(9.6, 3.5 * rows), layout="constrained")
    for number, step in enumerate(shown, 1):
        panel = Axes2D(figure.add_subplot(rows, 3, number), problem, limits)
        panel.axes.set_title(denoising.labels[step].partition(" of ")[0], fontsize=10)
        panel.axes.label_outer()
        _draw_step(TeamLayer(panel, problem), denoising, int(step))
    with replaced_when_done(path := Path(path), PICTURE_SUFFIXES) as temporary:
        figure.savefig(temporary, format=path.suffix.lower()[1:], dpi=120)
    return path


def _draw_step(layer: TeamLayer, denoising: Denoising, step: int) -> None:
    panel, problem = layer.panel, layer.problem
    for sample, alpha in zip(denoising.samples[step], denoising.alpha[step]):
        paths = panel.flatten(sample).swapaxes(0, 1)
        panel.segments(paths, colors=layer.colors, linewidths=0.6, alpha=float(alpha), zorder=3)
    arrived, contacts = np.zeros(problem.num_robots, bool), np.empty((0, problem.dimension))
    layer.update(problem.start, arrived, problem.goal, denoising.paths[step], contacts)
