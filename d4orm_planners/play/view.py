"""View of a session: those that drive side by side, in rows, and from where each browser looks at them at first."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np
import viser
from numpy.typing import NDArray

from d4orm_env.render.panels import view_limits
from d4orm_planners.play.meshes import Points, in_space
from d4orm_planners.play.scene_frame import Frame
from d4orm_planners.play.session import Session
from d4orm_planners.play.viewport_view import LaneView

GAP = 0.12
"""Between two scenes, in sizes of one."""


FIELD_OF_VIEW = np.deg2rad(35)
WIDE, NARROW = 1.5, 1.0
"""Shapes of windows, width over height: a usual one, and one so narrow that the controls lie below."""
Vector = NDArray[np.float64]


class View:
    """Shapes on the page.

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


class Viewpoint:
    """Shows a page's viewers all that lies between two corners."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._dimension = server, 2
        self._limits = np.zeros((2, 3), np.float32)
        server.on_client_connect(self._look)

    def show(self, limits: Points, dimension: int) -> None:
        """Look at what lies between ``limits`` ``(2, 3)``: from above in the plane, from the side in space."""
        self._limits, self._dimension = limits, dimension
        up = (0.0, 1.0, 0.0) if dimension == 2 else (0.0, 0.0, 1.0)
        self._server.scene.set_up_direction(up)
        camera = self._server.initial_camera
        camera.position, camera.look_at = view_from(limits, dimension, WIDE)
        camera.up, camera.fov = up, FIELD_OF_VIEW
        for client in self._server.get_clients().values():
            with _looking_nowhere():
                client.camera.up_direction = up
            self._look(client)

    def _look(self, client: viser.ClientHandle) -> None:
        camera = client.camera
        with _looking_nowhere():
            camera.position, camera.look_at = view_from(self._limits, self._dimension, camera.aspect)


@contextmanager
def _looking_nowhere() -> Iterator[None]:
    """A context that leaves a camera alone whose browser says that it looks nowhere, or that has nothing to see yet."""
    with suppress(ValueError, FloatingPointError), np.errstate(divide="raise", invalid="raise"):
        yield


def view_from(limits: Points, dimension: int, aspect: float) -> tuple[Vector, Vector]:
    """Return camera and target for all between two corners to be seen beside the controls.

    Args:
        limits: ``(2, 3)`` corners.
        dimension: 2 for a view from above, 3 for one from the side.
        aspect: Width over height of the window.
    """
    size = np.ptp(limits, axis=0).astype(np.float64)
    if dimension == 2:
        back, right, up = np.eye(3)[[2, 0, 1]]
        width, height = size[:2]
    else:
        back = np.array([0.53, -0.69, 0.48]) / np.linalg.norm([0.53, -0.69, 0.48])
        right = np.array([0.79, 0.61, 0.0])
        up = np.cross(back, right)
        width = height = 1.1 * size.max()
    centre = limits.mean(axis=0).astype(np.float64)
    if aspect >= NARROW:
        seen = 1.15 * max(height, width / (0.7 * aspect))
        centre += 0.14 * aspect * seen * right
    else:
        seen = 1.15 * max(width / aspect, height / 0.4)
        centre -= 0.28 * seen * up
    return centre + seen / (2 * np.tan(FIELD_OF_VIEW / 2)) * back, centre
