"""Display of plans and episodes as text, pictures and replays; and escaping of text from untrusted sources.

Names of scenarios and policies, error messages and all else in a store of trials may come from anybody.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.summary_line import KeyFigure, joined, outcome_rows
from d4orm_env.core.trajectory import Trajectory, mean_stretch

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from d4orm_env.render import pictures, replay
else:
    pictures = LazyModule("d4orm_env.render.pictures")
    replay = LazyModule("d4orm_env.render.replay")


_MARKDOWN = "\\`*{}[]<>|~&"  #: Characters that begin markup within a line, also that of MDX, which has code in braces
_FORMULA = "=+-@"


class DisplayMixin:
    """A motion of a team in a world, with a title and metrics. What draws is imported when it is asked for."""

    problem: Problem
    trajectory: Trajectory
    metrics: dict[str, float]

    @property
    def title(self) -> str:
        """Name of it in a few words."""
        raise NotImplementedError

    @property
    def key_figures(self) -> list[KeyFigure]:
        """Key figures of the team."""
        return outcome_rows(self.metrics, self.problem.num_robots)

    @cached_property
    def stretch(self) -> float:
        """Path travelled over the shortest path, see :func:`d4orm_env.core.trajectory.mean_stretch`; found when it is
        first asked for. In lifelong mode, where goals change, it means nothing.
        """
        return mean_stretch(self.problem, self.trajectory)

    def __repr__(self) -> str:
        return f"{type(self).__name__}: {self.title}\n  {joined(self.key_figures)}"

    def _repr_html_(self) -> str:
        return pictures.motion_html(self.problem, self.trajectory, self.title, self.key_figures)

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the motion with matplotlib; see :func:`d4orm_env.render.pictures.plot`.

        Args:
            axes: Axes to draw on; by default those of a new figure of ``matplotlib.pyplot``.

        Returns:
            The axes, spatial for a spatial problem.

        Raises:
            ValueError: If the axes are spatial and the problem is not.
        """
        return pictures.plot(self.problem, self.trajectory, axes)

    def motion(self, title: str | None = None, denoising: replay.Denoising | None = None) -> replay.ReplayMotion:
        """Return the motion of a replay; :class:`d4orm_env.render.replay.Replay` puts several side by side.

        Args:
            title: Its title there; by default its own.
            denoising: Denoising of the plan, shown before the motion; see :mod:`d4orm_planners.sampling.denoising`.
        """
        title = self.title if title is None else title
        goals, events = getattr(self, "goals", None), getattr(self, "events", None)
        bodies = None if events is None else events.bodies
        figures = joined(self.key_figures)
        return replay.motion(
            self.problem, self.trajectory, title, figures, goals=goals, denoising=denoising, bodies=bodies
        )

    def animate(self) -> replay.Replay:
        """A replay that notebooks show where it is the last value of a cell."""
        return replay.Replay(self.title, (self.motion(),))

    def to_html(self, path: str | Path) -> Path:
        """Write a replay to play, pause and scrub in any browser: one file that loads nothing from a network.

        Args:
            path: An ``.html`` file.

        Returns:
            The path.

        Raises:
            ValueError: For another suffix, or if it cannot be written; nothing is left behind then.
        """
        return self.animate().save(path)


def one_line(text: str) -> str:
    """Text for a terminal: line breaks are spaces, and characters that command it are written out."""
    return "".join(
        letter if letter.isprintable() else " " if letter.isspace() else letter.encode("unicode_escape").decode()
        for letter in text
    )


def markdown_text(text: str) -> str:
    """Text that Markdown reads as itself, on one line, in a cell of a table too."""
    return "".join(f"\\{letter}" if letter in _MARKDOWN else letter for letter in one_line(text))


def spreadsheet_cell(value: object) -> object:
    """A cell of a CSV file: text that a spreadsheet would compute has an apostrophe before it; numbers stay."""
    if not isinstance(value, str):
        return value
    text = one_line(value)
    computed = len(text) > 1 and text.lstrip().startswith(tuple(_FORMULA)) and not _is_number(text)
    return f"'{text}" if computed else text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
