"""First viewpoint of each browser: all of the scene, beside the controls."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np
import viser
from numpy.typing import NDArray

from d4orm_planners.play.meshes import Points

FIELD_OF_VIEW = np.deg2rad(35)

WIDE, NARROW = 1.5, 1.0
"""Shapes of windows, width over height: a usual one, and one so narrow that the controls lie below."""

Vector = NDArray[np.float64]


class Viewpoint:
    """Shows a page's viewers all that lies between two corners.

    Args:
        server: The page.
    """

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
