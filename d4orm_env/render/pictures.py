"""Still pictures of a trajectory with matplotlib, and as HTML for notebooks."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from functools import partial
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from d4orm_env.core.arrays import short_repr
from d4orm_env.core.files import checked_path, replaced_when_done
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import check_is_problem
from d4orm_env.core.summary_line import KeyFigure, count
from d4orm_env.core.trajectory import DisturbanceEvents, Trajectory, arrival_times, beginnings
from d4orm_env.render import own_style
from d4orm_env.render.frames import MarkLayer
from d4orm_env.render.panels import (
    BODY,
    CONTACT,
    INK,
    MARGIN,
    OBSTACLE,
    OBSTACLE_EDGE,
    PUSH,
    Array,
    Axes2D,
    TeamLayer,
    make_axes,
    view_limits,
)

pyplot: Any = LazyModule("matplotlib.pyplot")

PICTURE_SUFFIXES = (".png", ".svg", ".pdf")


def contact_points(trajectory: Trajectory) -> list[Array]:
    """Return, for every time, the ``(N, d)`` positions at which a robot has come into contact up to then."""
    starts = beginnings(np.asarray(trajectory.collided))
    return [np.asarray(trajectory.positions)[: t + 1][starts[: t + 1]] for t in range(len(starts))]


def checked_trajectory(problem: Problem, trajectory: Trajectory) -> None:
    """Check that a trajectory belongs to a problem of this size."""
    check_is_problem(problem)
    if not isinstance(trajectory, Trajectory):
        raise ValueError(f"trajectory is {short_repr(trajectory)}; give a Trajectory, such as plan.trajectory")
    shape = np.shape(trajectory.states)
    if len(shape) != 3 or shape[0] < 1 or shape[1:] != (problem.num_robots, problem.state_size):
        raise ValueError(
            f"trajectory has states of shape {shape}; this problem needs (steps + 1, {problem.num_robots}, "
            f"{problem.state_size}): pass the problem that the trajectory solves"
        )
    if not np.isfinite(trajectory.states).all():
        t, robot = (int(i) for i in np.argwhere(~np.isfinite(trajectory.states))[0][:2])
        raise ValueError(f"state of robot_{robot} at step {t} is not finite; roll out finite controls to draw them")


def last_moment(problem: Problem, trajectory: Trajectory, aftermath: float) -> int:
    """The step until which there is something to see: so many seconds after the last arrival, or the end."""
    everyone, last = arrival_times(trajectory.arrived, problem.dt).max(), len(trajectory.states) - 1
    return min(last, round((everyone + aftermath) / problem.dt)) if np.isfinite(everyone) else last


@own_style()
def plot_trajectory(
    problem: Problem, trajectory: Trajectory, *, title: str | None = None, events: DisturbanceEvents | None = None
) -> Figure:
    """Draw a whole trajectory, to scale: the world, every robot's path, and what went wrong.

    A circle in a robot's colour is its start, a diamond its goal, the line out of it the goal heading, the filled disc
    where it ends (paler when it has arrived), the line in it the heading of a differential drive. A star marks where a
    contact begins, a red disc each further step of it, a pale red disc each step at which only the margin is violated.
    Spatial problems get a view of space and a view from above.

    Args:
        problem: The problem that the trajectory belongs to.
        trajectory: Motion to draw.
        title: Title of the figure; by default the problem's name and the outcome, ``""`` for none.
        events: Its disturbances, ``episode.events``: arrows are pushes, as long as the distance in a second at their
            speed, crosses are where a robot stops obeying, and grey discs with dotted paths are intruders.

    Returns:
        A figure that belongs to no window; save it with ``figure.savefig`` or display it in a notebook.

    Raises:
        ValueError: If the trajectory does not fit the problem, or is not finite.
    """
    checked_trajectory(problem, trajectory)
    limits = view_limits(problem, trajectory.positions)
    size = limits[1] - limits[0]
    height = float(np.clip(5.4 * size[1] / size[0], 2.6, 7.5))
    spatial = problem.dimension == 3
    figure = Figure(figsize=(11.0 if spatial else 5.8, height + 0.9), layout="constrained")
    layer = None
    for position, view in ((121, "space"), (122, "above")) if spatial else ((111, "plane"),):
        panel = Axes2D(make_axes(figure, position, view), problem, limits)
        layer = TeamLayer(panel, problem)
        _draw_history(layer, trajectory)
        if events is not None:
            MarkLayer(panel, problem).show_all(events, np.asarray(trajectory.positions))
        if not panel.spatial:
            _number_robots(layer, trajectory, points_per_metre=72 * 4.6 / float(np.max(size[:2])))
    title = _outcome(problem, trajectory) if title is None else title
    if title:
        figure.suptitle(title, fontsize=11)
    spacing = {"columnspacing": 1.4, "handletextpad": 0.1, "fontsize": 8.5, "frameon": False}
    figure.legend(handles=_legend(problem, trajectory, events), loc="outside lower center", ncols=6, **spacing)
    return figure


def _draw_history(layer: TeamLayer, trajectory: Trajectory) -> None:
    panel, problem = layer.panel, layer.problem
    positions, collided = np.asarray(trajectory.positions), np.asarray(trajectory.collided)
    margin_only = positions[np.asarray(trajectory.margin_violated) & ~collided]
    further = positions[collided & ~beginnings(collided)]
    size = 0.5 * layer.mark_size
    panel.polygons(panel.outlines(margin_only, size), facecolors=MARGIN, edgecolors="none", zorder=2)
    panel.polygons(panel.outlines(further, size), facecolors=CONTACT, edgecolors="none", zorder=3.5)
    _draw_starts(layer)
    contacts = contact_points(trajectory)[-1]
    layer.update(trajectory.states[-1], trajectory.arrived[-1], problem.goal, positions, contacts)


def _draw_starts(layer: TeamLayer) -> None:
    panel, start = layer.panel, layer.problem.start
    style = {name: np.asarray(value)[layer.robots] for name, value in layer.hollow.items()}
    panel.polygons(layer.body_outlines(start), **style, linewidths=layer.goals.get_linewidth(), zorder=2.5)
    panel.segments(layer.heading_lines(start), colors=layer.colors[layer.drives], linewidths=1.2, zorder=2.5)


def plot(problem: Problem, trajectory: Trajectory | None = None, axes: Axes | None = None) -> Axes:
    """Draw a problem, and a motion in it if there is one, on axes, as :func:`plot_trajectory` does without its legend.

    Args:
        problem: Problem to draw.
        trajectory: A motion that belongs to it; without one the team is at its starts.
        axes: Axes to draw on; for a spatial problem ``projection="3d"``, or flat for a view from above. By default axes
            of a new figure of ``matplotlib.pyplot``, so that notebooks and ``pyplot.show()`` show it.

    Returns:
        The axes.

    Raises:
        ValueError: If the trajectory does not fit the problem, or the axes are spatial and the problem is not.
    """
    if trajectory is not None:
        checked_trajectory(problem, trajectory)
    if axes is None:
        with own_style():
            figure = pyplot.figure(layout="constrained")
            axes = make_axes(figure, 111, "space" if problem.dimension == 3 else "plane")
    elif not isinstance(axes, Axes):
        raise ValueError(f"axes is {short_repr(axes)}; give axes of Matplotlib, as pyplot.subplots() returns")
    elif axes.name == "3d" and problem.dimension == 2:
        raise ValueError("the axes are spatial and the problem is planar; give axes without projection='3d'")
    return _plot_on(axes, problem, trajectory)


@own_style()
def _plot_on(axes: Axes, problem: Problem, trajectory: Trajectory | None) -> Axes:
    positions = () if trajectory is None else trajectory.positions
    layer = TeamLayer(Axes2D(axes, problem, view_limits(problem, positions)), problem)
    if trajectory is None:
        nowhere = np.empty((0, problem.num_robots, problem.dimension))
        layer.update(problem.start, np.zeros(problem.num_robots, bool), problem.goal, nowhere, nowhere[:, 0])
        axes.set_title(f"{problem.name}, {count(problem.num_robots, 'robot')}", fontsize=10)
    else:
        _draw_history(layer, trajectory)
        axes.set_title(_outcome(problem, trajectory), fontsize=10)
    return axes


def _number_robots(layer: TeamLayer, trajectory: Trajectory, points_per_metre: float) -> None:
    """Write the robots' numbers into their discs where they fit; a heading line needs the room itself."""
    style: dict[str, object] = {"ha": "center", "va": "center_baseline", "zorder": 6.5}
    # Discs of robots that have arrived are pale.
    white = (layer.colors @ [0.299, 0.587, 0.114] < 0.55) & ~np.asarray(trajectory.arrived[-1])
    for robot, (x, y) in enumerate(layer.panel.flatten(trajectory.positions[-1])):
        fontsize = min(9.0, points_per_metre * layer.radius[robot])
        if robot not in layer.drives and fontsize >= 4.5:
            layer.panel.axes.text(x, y, str(robot), fontsize=fontsize, color="white" if white[robot] else INK, **style)


def _outcome(problem: Problem, trajectory: Trajectory) -> str:
    robots, contacts = problem.num_robots, int(np.asarray(trajectory.collided).any(axis=0).sum())
    times = arrival_times(trajectory.arrived, problem.dt)
    arrived = int(np.isfinite(times).sum())
    result = f"all arrived after {times.max():.1f} s" if arrived == robots else f"{arrived} of {robots} arrived"
    return f"{problem.name}, {count(robots, 'robot')}: {result}" + (f", {contacts} in contact" if contacts else "")


def _legend(problem: Problem, trajectory: Trajectory, events: DisturbanceEvents | None) -> list[Line2D]:
    """Entries for what there is."""
    collided = np.asarray(trajectory.collided)
    missed = np.asarray(trajectory.margin_violated) & ~collided
    mark = partial(Line2D, [], [], linestyle="none")
    entries = [
        (True, mark(label="start", marker="o", mfc="none", mec=INK, ms=8)),
        (True, mark(label="goal", marker="D", mfc="none", mec=INK, ms=7)),
        (True, mark(label="end", marker="o", mfc="#9CA3AF", mec=INK, ms=8)),
        (problem.world.num_obstacles > 0, mark(label="obstacle", marker="s", mfc=OBSTACLE, mec=OBSTACLE_EDGE, ms=8)),
        (collided.any(), mark(label="contact", marker=(8, 1, 0), mfc=CONTACT, mec=CONTACT, ms=9)),
        (missed.any(), mark(label="margin violated", marker="o", mfc=MARGIN, mec=MARGIN, ms=6)),
    ]
    if events is not None:
        entries += [
            (events.pushed.any(), Line2D([], [], color=PUSH, linewidth=1.8, label="push")),
            (events.stalled.any(), mark(label="stalls", marker="x", color=INK, ms=8, mew=1.8)),
            (events.bodies.shape[1] > 0, mark(label="moving obstacle", marker="o", mfc=BODY, mec=INK, ms=8)),
        ]
    return [line for shown, line in entries if shown]


def save_picture(
    problem: Problem,
    trajectory: Trajectory,
    path: str | Path,
    *,
    title: str | None = None,
    events: DisturbanceEvents | None = None,
) -> Path:
    """Write :func:`plot_trajectory` to a PNG, SVG or PDF file, by its suffix. The same input gives the same bytes.

    Returns:
        The path.

    Raises:
        ValueError: For another suffix, as :func:`plot_trajectory`, or if it cannot be written; nothing is left behind.
    """
    path = checked_path(path, "a picture")
    kind = path.suffix.lower()[1:]
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with replaced_when_done(path, PICTURE_SUFFIXES) as temporary:
        figure = plot_trajectory(problem, trajectory, title=title, events=events)
        with own_style({"svg.hashsalt": "d4orm", "pdf.fonttype": 42}):
            figure.savefig(temporary, format=kind, dpi=160, metadata=undated.get(kind))
    return path


_DPI = 72


def motion_html(problem: Problem, trajectory: Trajectory, title: str, rows: Iterable[KeyFigure]) -> str:
    """A motion of a team: its picture and its key figures, escaped."""
    return _page(title, rows, plot_trajectory(problem, trajectory, title=""))


@own_style()
def problem_html(problem: Problem, title: str, rows: Iterable[KeyFigure]) -> str:
    """A problem: its picture and its key figures, escaped."""
    figure = Figure(figsize=(4.6, 4.6), layout="constrained")
    _plot_on(make_axes(figure, 111, "space" if problem.dimension == 3 else "plane"), problem, None)
    return _page(title, rows, figure)


@own_style()
def paths_html(trajectory: Trajectory, title: str, rows: Iterable[KeyFigure]) -> str:
    """A motion whose world is not known: where the robots went, seen from above, and its key figures, escaped."""
    figure = Figure(figsize=(4.6, 4.6), layout="constrained")
    axes = figure.add_subplot(111, aspect="equal", xlabel="x [m]", ylabel="y [m]")
    x, y = trajectory.positions[..., 0], trajectory.positions[..., 1]
    axes.plot(x, y, linewidth=1)
    axes.plot(x[-1:], y[-1:], "o")
    return _page(title, rows, figure)


@own_style()
def _page(title: str, rows: Iterable[KeyFigure], figure: Figure) -> str:
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=_DPI)
    picture = base64.b64encode(stream.getvalue()).decode()
    table = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
    return (
        f'<div><strong>{escape(title)}</strong><div style="display:flex;flex-wrap:wrap;gap:1em;align-items:center">'
        f'<img alt="{escape(title)}" src="data:image/png;base64,{picture}"><table>{table}</table></div></div>'
    )
