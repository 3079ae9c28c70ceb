"""Replays: motions to play, pause and scrub in a browser, in one HTML file that loads nothing from a network.

And denoising as replays and pictures show it: a candidate at a time, from noise to clean paths.
"""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.files import checked_path, replaced_when_done
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.render import own_style
from d4orm_env.render.panels import Axes2D, TeamLayer, robot_colors, view_limits
from d4orm_env.render.pictures import PICTURE_SUFFIXES, checked_trajectory, last_moment

REPLAY_SUFFIXES = (".html",)

_NOTEBOOK_HEIGHT = 640
_AFTERMATH = 1.0
"""Time that a replay goes on when all have arrived [s]."""
_NO_CLEARANCE = 1e9
"""Number that stands for an infinite distance [m]."""


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


@dataclass(frozen=True, eq=False)
class ReplayMotion:
    """One team's motion, ready for a page."""

    content: dict[str, object]  #: Data of the page: lists, numbers and texts only


def motion(
    problem: Problem,
    trajectory: Trajectory,
    title: str,
    figures: str = "",
    *,
    goals: ArrayLike | None = None,
    denoising: Denoising | None = None,
    bodies: ArrayLike | None = None,
) -> ReplayMotion:
    """Take what a replay shows of a motion: up to a second after the last robot has arrived, or to its end.

    Args:
        problem: The problem that the trajectory belongs to.
        trajectory: Motion to show, ``T`` steps.
        title: Its title.
        figures: Key figures in a line.
        goals: ``(T+1, K, d)`` where they change on the way; the problem's by default.
        denoising: Denoising of the plan, shown before the motion.
        bodies: ``(T+1, N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves among the robots and is
            none; a radius of zero for what is not there.

    Raises:
        ValueError: If the trajectory, the goals or the bodies do not fit the problem, or are not finite.
    """
    checked_trajectory(problem, trajectory)
    goals = problem.goal[None] if goals is None else _checked_goals(problem, goals, len(trajectory.states))
    end = last_moment(problem, trajectory, _AFTERMATH) + 1
    limits = view_limits(problem, np.concatenate([trajectory.positions, goals]))
    flags = trajectory.arrived * 1 + trajectory.collided * 2 + trajectory.margin_violated * 4
    content = {
        "title": title,
        "figures": figures,
        "limits": [[*corner, 0.0][:3] for corner in limits.tolist()],
        **_setting(problem),
        "states": rounded(trajectory.states[:end]),
        "goals": rounded(goals[:end]),
        "world_clearance": _clearance(problem, trajectory.positions[:end]),
        "flags": _text(flags[:end].astype(np.uint8)),
    }
    if bodies is not None and np.size(bodies):
        content["bodies"] = _bodies(problem, np.asarray(bodies, np.float32), len(trajectory.states), end)
    if denoising is not None:
        content["denoising"] = _denoising(denoising)
    return ReplayMotion(content)


def _checked_goals(problem: Problem, goals: ArrayLike, moments: int) -> FloatArray:
    """``(T+1, K, d)`` goals, or ``(1, K, d)`` where they are always the same."""
    array: FloatArray = np.asarray(goals, np.float32)
    shape = (moments, *problem.goal.shape)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"goals have shape {array.shape}; they must be finite and of shape (T+1, K, d) = {shape}")
    return array[:1] if (array == array[0]).all() else array


@dataclass(frozen=True, eq=False)
class Replay:
    """Motions side by side on one page, with one clock; notebooks show it where it is the last value of a cell.

    Raises:
        ValueError: If there is none.
    """

    title: str  #: Title of the page
    motions: tuple[ReplayMotion, ...]  #: Motions that it shows, one or more
    autoplay: bool = False  #: Whether it plays when it is opened

    def __post_init__(self) -> None:
        if not self.motions:
            raise ValueError(f"the replay {self.title!r} has no motion; give one or more")

    @property
    def html(self) -> str:
        """The page."""
        page = {"autoplay": self.autoplay, "scenes": [motion.content for motion in self.motions]}
        # No text of a problem may end the script that the data is in; JSON reads the escapes back.
        data = json.dumps(page, allow_nan=False).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
        parts = {
            "title": escape(self.title),
            "style": _file("style.css"),
            "view": _file("view.js"),
            "draw": _file("draw.js"),
            "player": _file("player.js"),
            "data": data,
        }
        pieces = _file("page.html").split("{{")
        filled = [parts[name] + rest for name, _, rest in (piece.partition("}}") for piece in pieces[1:])]
        return "".join([pieces[0], *filled])

    def save(self, path: str | Path) -> Path:
        """Write the page to an ``.html`` file.

        Raises:
            ValueError: For another suffix, or if it cannot be written; nothing is left behind then.
        """
        with replaced_when_done(path := checked_path(path, "a replay"), REPLAY_SUFFIXES) as temporary:
            temporary.write_text(self.html, encoding="utf-8")
        return path

    def __repr__(self) -> str:
        return f"Replay({self.title!r}, {len(self.motions)} side by side)"

    def _repr_html_(self) -> str:
        """The page in a frame of its own, which may run its script and nothing else."""
        style = f"width:100%;height:{_NOTEBOOK_HEIGHT}px;border:0"
        return f'<iframe sandbox="allow-scripts" style="{style}" srcdoc="{escape(self.html)}"></iframe>'


def rounded(array: ArrayLike) -> dict[str, object]:
    """Numbers ``(..., c)`` as 16-bit ones between the least and the most of each of the ``c`` components."""
    values = np.asarray(array, np.float64)
    flat = values.reshape(-1, values.shape[-1])
    low, high = flat.min(axis=0), flat.max(axis=0)
    step = np.where(high > low, (high - low) / 65535, 1.0)
    data = np.round((flat - low) / step).astype("<u2")
    return {"low": low.tolist(), "step": step.tolist(), "data": _text(data)}


def _setting(problem: Problem) -> dict[str, object]:
    """Team and world, which do not change."""
    models, world = problem.team.robot_models, problem.world
    return {
        "dimension": problem.dimension,
        "dt": problem.dt,
        "bounds": None if world.lower is None else world.bounds.tolist(),
        "world": {
            "balls": world.balls.tolist(),
            "cylinders": world.cylinders.tolist(),
            "boxes": world.boxes.tolist(),
            "polygons": [corners.tolist() for corners in world.polygons],
        },
        "radius": np.asarray(problem.team.radius).tolist(),
        "outlines": [footprint.outline().tolist() for footprint in problem.team.shapes] or None,
        "trailers": [_trailers(problem.team, robot) for robot in range(problem.num_robots)],
        "models": [model.name for model in models],
        "names": [list(model.state_names) for model in models],
        "heading": [model.heading_index for model in models],
        "colors": [to_hex(color) for color in robot_colors(problem.num_robots)],
    }


def _trailers(team: Team, robot: int) -> list[dict[str, object]]:
    """Outlines of a robot's trailers, their hitch angles' state components, and the hitches' lengths."""
    return [
        {"outline": body.footprint.outline().tolist(), "hitch": body.heading, "length": body.hitch}
        for body in team.bodies[team.num_robots :]
        if body.robot == robot
    ]


def _denoising(denoising: Denoising) -> dict[str, object]:
    samples, kept = denoising.samples, denoising.samples.shape[1]
    return {
        "labels": list(denoising.labels),
        "seconds": denoising.seconds_per_step,
        "points": denoising.paths.shape[1],
        "kept": kept,
        "paths": rounded(denoising.paths),
        "samples": rounded(samples) if kept else {"low": [0.0], "step": [1.0], "data": ""},
        "alpha": np.round(denoising.alpha, 2).tolist(),
    }


def _bodies(problem: Problem, bodies: FloatArray, steps: int, end: int) -> dict[str, object]:
    """Return the positions and radius of dynamic obstacles."""
    d = problem.dimension
    if bodies.ndim != 3 or len(bodies) != steps or bodies.shape[2] != 2 * d + 1 or not np.isfinite(bodies).all():
        raise ValueError(
            f"bodies have shape {bodies.shape}; they must be finite and of shape (T+1, N, 2 d + 1) = "
            f"({steps}, N, {2 * d + 1})"
        )
    return {"count": bodies.shape[1], **rounded(np.concatenate([bodies[:end, :, :d], bodies[:end, :, -1:]], axis=2))}


def _clearance(problem: Problem, positions: FloatArray) -> dict[str, object]:
    clearance = problem.world.clearance(positions)
    return rounded(np.where(np.isfinite(clearance), clearance, _NO_CLEARANCE)[..., None])


def _text(array: NDArray[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _file(name: str) -> str:
    return (resources.files(__package__) / "replay_page" / name).read_text(encoding="utf-8")


@own_style()
def save_denoising(problem: Problem, denoising: Denoising, path: str | Path, panels: int = 6) -> Path:
    """Write a picture of a plan's denoising, as PNG, SVG or PDF: its candidate's paths, in ``panels`` steps, three to a
    row.

    Faint lines are samples. Spatial problems are seen from above. Nothing is left behind after an error.
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
    with replaced_when_done(path := checked_path(path, "a picture"), PICTURE_SUFFIXES) as temporary:
        figure.savefig(temporary, format=path.suffix.lower()[1:], dpi=120)
    return path


def _draw_step(layer: TeamLayer, denoising: Denoising, step: int) -> None:
    panel, problem = layer.panel, layer.problem
    for sample, alpha in zip(denoising.samples[step], denoising.alpha[step]):
        paths = panel.flatten(sample).swapaxes(0, 1)
        panel.segments(paths, colors=layer.colors, linewidths=0.6, alpha=float(alpha), zorder=3)
    arrived, contacts = np.zeros(problem.num_robots, bool), np.empty((0, problem.dimension))
    layer.update(problem.start, arrived, problem.goal, denoising.paths[step], contacts)
