"""View of a session: those that drive side by side, in rows."""

from __future__ import annotations

import math
import time

import numpy as np
import viser

from d4orm_env.render.panels import view_limits
from d4orm_planners.play.meshes import Points, in_space
from d4orm_planners.play.scene_frame import Frame
from d4orm_planners.play.session import Session
from d4orm_planners.play.viewpoint import Viewpoint
from d4orm_planners.play.viewport_view import LaneView

GAP = 0.12
"""Between two scenes, in sizes of one."""


class View:
    """Shapes on the page.

    Args:
        server: The page.
        session: Session that is shown, and changed by dragging.

    Attributes:
        shown: Which of ``"plans"``, ``"guidance"``, ``"trails"``, ``"subgoals"`` and ``"margins"`` are, and whether on
            ``"dark"``.
    """

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self._session = server, session
        self.shown = {
            "plans": True,
            "guidance": True,
            "trails": True,
            "subgoals": False,
            "margins": False,
            "dark": False,
        }
        self._camera = Viewpoint(server)
        self._lanes: list[LaneView] = []
        self._built: object = None
        self._looked_at: object = None

    def update(self) -> None:
        """Show the present, where the robots are by now."""
        frames = self._session.frames
        built = (frames[0].status.generation, *(len(frame.bodies) for frame in frames))
        if built != self._built:
            self._built = built
            self._rebuild(frames)
        now = time.perf_counter()
        with self._server.atomic():
            for lane, frame in zip(self._lanes, frames):
                lane.update(frame, now)

    def _rebuild(self, frames: tuple[Frame, ...]) -> None:
        """Make all shapes anew."""
        limits = in_space(view_limits(frames[0].problem))
        places = _places(len(frames), limits)
        with self._server.atomic():
            for lane in self._lanes:
                lane.remove()
            self._lanes = [
                LaneView(self._server, self._session, index, frame, place, self.shown)
                for index, (frame, place) in enumerate(zip(frames, places, strict=True))
            ]
            if len(frames) > 1:
                top = np.array([limits[:, 0].mean(), limits[1, 1], limits[:, 2].mean()], np.float32)
                for lane, frame in zip(self._lanes, frames):
                    lane.name(frame.policy, top)
        problem = frames[0].problem
        scene = (problem.name, problem.num_robots, problem.dimension, len(frames))
        if scene != self._looked_at:
            self._looked_at = scene
            corners = limits + places[:, None]
            self._camera.show(np.stack([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))]), problem.dimension)


def _places(number: int, limits: Points) -> Points:
    """``(number, 3)`` where scenes of this size are side by side, in rows of about as many."""
    columns = math.ceil(math.sqrt(number))
    row, column = np.divmod(np.arange(number), columns)
    size = (1 + GAP) * np.ptp(limits, axis=0)
    return np.stack([column * size[0], -row * size[1], 0.0 * row], axis=1).astype(np.float32)
