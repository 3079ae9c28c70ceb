"""Disturbances in pictures: pushes as arrows, robots that have stalled as crosses, intruders as grey bodies."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import DisturbanceEvents
from d4orm_env.render.panels import BODY, INK, PUSH, Array, Axes2D

_ARROW_SECONDS = 1.0
"""An arrow is as long as what its speed covers in this time."""
_SHOWN_SECONDS = 0.5
"""Time for which a moving picture shows a push."""


class MarkLayer:
    """The marks of one panel, drawn once and then moved.

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
