"""Notebook display of a problem, a motion, a plan or an episode: a picture and key figures, as HTML."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape
from io import BytesIO

from matplotlib.figure import Figure

from d4orm_env.core.problem import Problem
from d4orm_env.core.summary_line import KeyFigure
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.render.pictures import plot_problem, plot_trajectory
from d4orm_env.render.style import own_style

_DPI = 72


def motion_html(problem: Problem, trajectory: Trajectory, title: str, rows: Iterable[KeyFigure]) -> str:
    """A motion of a team: its picture and its key figures, escaped."""
    return _page(title, rows, plot_trajectory(problem, trajectory, title=""))


def problem_html(problem: Problem, title: str, rows: Iterable[KeyFigure]) -> str:
    """A problem: its picture and its key figures, escaped."""
    return _page(title, rows, plot_problem(problem))


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
