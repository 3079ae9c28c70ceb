"""Frames for the environment's render modes, a live window, and the marks of disturbances, with matplotlib."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.registry import backend_registry
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import DisturbanceEvents
from d4orm_env.render import own_style
from d4orm_env.render.panels import BODY, INK, PUSH, Array, Axes2D, TeamLayer, make_axes, view_limits

_ARROW_SECONDS = 1.0
"""An arrow is as long as what its speed covers in this time."""
_SHOWN_SECONDS = 0.5
"""Time for which a moving picture shows a push."""


class FrameRenderer:
    """Draws one state after another into an image: the environment's ``rgb_array`` mode, and animations.

    The world is drawn once and kept; a frame redraws only what moves.

    Args:
        problem: Team, world, and the starts and goals that the view is fitted to.
        size: Width and height [pixels]. Spatial problems get a view of space, and a view from above beside it where
            the image is at least 1.6 times as wide as high.
        points: ``(..., d)`` further positions that must be in view; the view grows when a robot leaves it.

    Raises:
        ValueError: If the size is below 64 x 64.
    """

    def __init__(self, problem: Problem, size: tuple[int, int] = (480, 480), points: ArrayLike = ()) -> None:
        self.problem, self.size = problem, (int(size[0]), int(size[1]))
        if min(self.size) < 64:
            raise ValueError(f"size is {size}; a frame needs at least 64 x 64 pixels")
        self._closed = False
        self._build(view_limits(problem, points))

    @own_style()
    def _build(self, limits: Array) -> None:
        width, height = self.size
        scale = float(np.clip(min(width, height) / 480, 0.5, 2.0))
        figure = Figure(figsize=(width / (100 * scale), height / (100 * scale)), dpi=100 * scale)
        self._canvas = FigureCanvasAgg(figure)
        panels = self._panels(figure, limits)
        self._layers = [TeamLayer(panel, self.problem) for panel in panels]
        self._mark_layers = [MarkLayer(panel, self.problem) for panel in panels]
        self._caption = figure.text(0.5, 0.965, "", ha="center", va="center", fontsize=10, color=INK, animated=True)
        for artist, _ in self._artists:
            artist.set_animated(True)
        self._limits = limits
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)

    @property
    def _artists(self) -> Iterator[tuple[Any, Axes2D]]:
        """All that moves, in drawing order, with its panel."""
        for layer, mark_layer in zip(self._layers, self._mark_layers):
            yield from ((artist, layer.panel) for artist in (*layer.artists, *mark_layer.artists))

    def _panels(self, figure: Figure, limits: Array) -> list[Axes2D]:
        if self.problem.dimension == 2:
            views = [("plane", (0.12, 0.1, 0.85, 0.83))]
        elif self.size[0] >= 1.6 * self.size[1]:
            views = [("space", (0.015, 0.04, 0.44, 0.84)), ("above", (0.57, 0.1, 0.42, 0.83))]
        else:
            views = [("space", (0.01, 0.04, 0.86, 0.86))]
        panels = []
        for view, rectangle in views:
            panel = Axes2D(make_axes(figure, 111, view), self.problem, limits)
            panel.axes.set_position(rectangle)
            panels.append(panel)
        return panels

    def draw(
        self,
        states: ArrayLike,
        arrived: ArrayLike,
        collided: ArrayLike,
        goals: ArrayLike | None = None,
        trail: ArrayLike | None = None,
        *,
        contacts: ArrayLike = (),
        caption: str | None = None,
        events: DisturbanceEvents | None = None,
    ) -> NDArray[np.uint8]:
        """Draw one state.

        Args:
            states: ``(K, n)``.
            arrived: ``(K,)`` bool; these robots are drawn paler.
            collided: ``(K,)`` bool; these robots get a star.
            goals: ``(K, d)`` where they differ from the problem's.
            trail: ``(T, K, d)`` positions up to now, oldest first.
            contacts: ``(N, d)`` further points to mark with a star, such as earlier contacts.
            caption: Text above the picture; by default how many robots have arrived.
            events: Disturbances of the execution up to now; its moments are the last ones of ``trail``.

        Returns:
            ``(height, width, 3)`` image, the caller's own.

        Raises:
            ValueError: If the states have another shape or are not finite.
            RuntimeError: After :meth:`close`.
        """
        team, d = self._checked(np.asarray(states)), self.problem.dimension
        arrived = np.asarray(arrived, bool)
        goals = self.problem.goal if goals is None else np.asarray(goals)
        path = np.empty((0, len(team), d)) if trail is None else np.asarray(trail)
        stars = np.concatenate([np.reshape(contacts, (-1, d)), team[np.asarray(collided, bool), :d]])
        self._keep_in_view(np.concatenate([team[:, :d], goals]))
        for layer in self._layers:
            layer.update(team, arrived, goals, path, stars)
        if events is not None:
            for mark_layer in self._mark_layers:
                mark_layer.show_last(events, path[-len(events.pushed) :])
        self._caption.set_text(f"arrived {arrived.sum()} of {len(arrived)}" if caption is None else caption)
        return self._paint()

    def _checked(self, states: Array) -> Array:
        if self._closed:
            raise RuntimeError("this renderer is closed; make a new one to draw again")
        expected = (self.problem.num_robots, self.problem.state_size)
        if states.shape != expected or not np.isfinite(states).all():
            raise ValueError(f"states must be finite and of shape (K, n) = {expected}; these have {states.shape}")
        return states

    def _keep_in_view(self, positions: Array) -> None:
        radius = np.max(self.problem.team.radius)
        lower, upper = positions.min(axis=0) - radius, positions.max(axis=0) + radius
        low, high = self._limits
        if (lower < low).any() or (upper > high).any():
            room = 0.15 * (high - low)
            lower, upper = np.where(lower < low, lower - room, low), np.where(upper > high, upper + room, high)
            self._build(np.stack([lower, upper]))

    @own_style()
    def _paint(self) -> NDArray[np.uint8]:
        self._canvas.restore_region(self._background)
        for artist, panel in self._artists:
            if panel.spatial:
                artist.do_3d_projection()
            panel.axes.draw_artist(artist)
        self._canvas.figure.draw_artist(self._caption)
        return np.array(self._canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Let go of the figure. Closing twice is fine."""
        if not self._closed:
            self._closed = True
            del self._canvas, self._layers, self._mark_layers, self._caption, self._background


class WindowRenderer:
    """Shows the frames of a :class:`FrameRenderer` in a window, at the pace of the problem's time step.

    The window is that of matplotlib's backend. Without a display that backend draws to memory only, and so does this:
    frames are made, and no window opens.

    Args:
        problem: As for :class:`FrameRenderer`.
        size: As for :class:`FrameRenderer`.
    """

    def __init__(self, problem: Problem, size: tuple[int, int] = (480, 480)) -> None:
        self._frames = FrameRenderer(problem, size)
        self._period = problem.dt
        self._manager: FigureManagerBase | None = None
        self._image: AxesImage
        self._last = -np.inf
        self._open_window(problem, size)

    @own_style()
    def _open_window(self, problem: Problem, size: tuple[int, int]) -> None:
        canvas_class = backend_registry.load_backend_module(mpl.get_backend()).FigureCanvas
        if not canvas_class.required_interactive_framework:
            return
        figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        self._image = axes.imshow(np.full((size[1], size[0], 3), 255, np.uint8))
        self._manager = canvas_class.new_manager(figure, 1)
        self._manager.set_window_title(f"d4orm: {problem.name}")
        self._manager.canvas.mpl_connect("close_event", self._forget_window)
        self._manager.show()

    def _forget_window(self, event: object) -> None:
        self._manager = None

    def draw(self, *state: ArrayLike, **events: Any) -> NDArray[np.uint8]:
        """Draw one state as :meth:`FrameRenderer.draw` does, show it, and wait until it is time for the next."""
        frame = self._frames.draw(*state, **events)
        if self._manager is not None:
            canvas = self._manager.canvas
            self._image.set_data(frame)
            canvas.draw()
            canvas.start_event_loop(max(1e-3, self._period - (time.monotonic() - self._last)))
            self._last = time.monotonic()
        return frame

    def close(self) -> None:
        """Close the window. Closing twice is fine."""
        self._frames.close()
        if self._manager is not None:
            manager, self._manager = self._manager, None
            manager.destroy()


class MarkLayer:
    """Disturbances on one panel, drawn once and then moved: pushes as arrows, robots that have stalled as crosses,
    intruders as grey bodies.

    Attributes:
        artists: The matplotlib artists, in drawing order.
    """

    def __init__(self, panel: Axes2D, problem: Problem) -> None:
        self.panel, self.problem = panel, problem
        self.radius = np.asarray(problem.team.radius, np.float64)
        empty = np.empty((0, 4, len(panel.right)))
        self.paths = panel.segments(empty, colors=BODY, linewidths=1.0, linestyles=":", zorder=1.6)
        self.bodies = panel.polygons(empty, facecolors=BODY, edgecolors=INK, linewidths=0.7, zorder=4.8)
        self.pushes = panel.segments(empty, colors=PUSH, linewidths=1.8, zorder=6.6)
        self.stalls = panel.segments(empty, colors=INK, linewidths=1.8, zorder=6.7)
        self.artists = [self.paths, self.bodies, self.pushes, self.stalls]

    def show_last(self, events: DisturbanceEvents, positions: Array) -> None:
        """Show the last moment of ``events``, with ``(T + 1, K, d)`` positions of the robots."""
        shown = max(1, round(_SHOWN_SECONDS / self.problem.dt))
        self._draw_bodies(events)
        self._draw_pushes(events.pushed, positions, max(0, len(positions) - shown))
        self._draw_stalls(positions[-1:], events.stalled[-1:])

    def show_all(self, events: DisturbanceEvents, positions: Array) -> None:
        """Show the whole execution; arguments as for :meth:`show_last`."""
        self._draw_bodies(events)
        self._draw_pushes(events.pushed, positions, 0)
        self._draw_stalls(positions, events.stall_starts)

    def _draw_bodies(self, events: DisturbanceEvents) -> None:
        d, bodies = self.problem.dimension, np.asarray(events.bodies, np.float64)
        now = bodies[-1, bodies[-1, :, -1] > 0]
        self.bodies.set_verts(self.panel.outlines(now[:, :d], now[:, -1]))
        # A body that has left comes again somewhere else, or is absent.
        moved, speed = (np.linalg.norm(part, axis=-1) for part in (np.diff(bodies[..., :d], axis=0), bodies[..., d:-1]))
        far = moved > 2 * self.problem.dt * np.maximum(speed[1:], speed[:-1])
        jumps = far | (np.diff(bodies[..., -1], axis=0) != 0)
        flat = self.panel.flatten(bodies[..., :d])
        flat[bodies[..., -1] == 0] = np.nan
        parts = [np.split(flat[:, i], np.flatnonzero(jumps[:, i]) + 1) for i in range(bodies.shape[1])]
        whole = [path for paths in parts for path in paths if len(path) > 1 and np.isfinite(path).all()]
        self.paths.set_segments(whole)

    def _draw_pushes(self, pushed: Array, positions: Array, begin: int) -> None:
        given = np.asarray(pushed[begin:], np.float64)
        hit = given.any(axis=-1)
        # Where the robot was when it was pushed: the step before.
        before = positions[np.maximum(np.arange(begin, len(positions)) - 1, 0)]
        tails, arrows = before[hit].astype(np.float64), _ARROW_SECONDS * given[hit]
        self.pushes.set_segments([path for tail, arrow in zip(tails, arrows) for path in self._arrow(tail, arrow)])

    def _arrow(self, tail: Array, arrow: Array) -> list[Array]:
        start, tip = self.panel.flatten(tail), self.panel.flatten(tail + arrow)
        along = tip - start
        normal = self.panel.right * along.dot(self.panel.up) - self.panel.up * along.dot(self.panel.right)
        barbs = [tip, tip - 0.35 * along + 0.2 * normal], [tip, tip - 0.35 * along - 0.2 * normal]
        return [np.array([start, tip]), *map(np.array, barbs)]

    def _draw_stalls(self, positions: Array, where: Array) -> None:
        centres = self.panel.flatten(positions[where])
        arms = 1.2 * np.broadcast_to(self.radius, where.shape)[where][:, None]
        one, other = self.panel.right + self.panel.up, self.panel.right - self.panel.up
        crosses = [np.stack([centres - arms * along, centres + arms * along], axis=1) for along in (one, other)]
        self.stalls.set_segments(np.concatenate(crosses))
