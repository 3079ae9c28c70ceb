"""A session, its page from the first browser to the last, and those that drive side by side on it, in rows."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from d4orm_env.core.problem import Problem
from d4orm_env.render.panels import view_limits
from d4orm_planners.play.meshes import Points, in_space
from d4orm_planners.play.origin_check import LOOPBACK, MessageValidator, OriginCheck
from d4orm_planners.play.panel import THEME, Panel
from d4orm_planners.play.session import Session
from d4orm_planners.play.viewport import Frame
from d4orm_planners.play.viewport_view import ViewportView

GAP = 0.12  #: Between two scenes, in sizes of one
FIELD_OF_VIEW = np.deg2rad(35)
WIDE, NARROW = 1.5, 1.0  #: Windows' width over height: a usual one, and one so narrow that the controls lie below
Vector = NDArray[np.float64]


class View:
    """Shapes on the page."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self._session = server, session
        #: Which of ``"plans"``, ``"guidance"``, ``"trails"``, ``"subgoals"`` and ``"margins"`` are, and whether on
        #: ``"dark"``
        self.shown = {
            "plans": True,
            "guidance": True,
            "trails": True,
            "subgoals": False,
            "margins": False,
            "dark": False,
        }
        self._camera = Viewpoint(server)
        self._viewports: list[ViewportView] = []
        self._built: object = None
        self._looked_at: object = None

    def update(self) -> None:
        frames = self._session.frames
        built = (frames[0].status.generation, *(len(frame.bodies) for frame in frames))
        if built != self._built:
            self._built = built
            self._rebuild(frames)
        now = time.perf_counter()
        with self._server.atomic():
            for viewport, frame in zip(self._viewports, frames):
                viewport.update(frame, now)

    def _rebuild(self, frames: tuple[Frame, ...]) -> None:
        limits = in_space(view_limits(frames[0].problem))
        positions = _positions(len(frames), limits)
        with self._server.atomic():
            for viewport in self._viewports:
                viewport.remove()
            self._viewports = [
                ViewportView(self._server, self._session, index, frame, position, self.shown)
                for index, (frame, position) in enumerate(zip(frames, positions, strict=True))
            ]
            if len(frames) > 1:
                top = np.array([limits[:, 0].mean(), limits[1, 1], limits[:, 2].mean()], np.float32)
                for viewport, frame in zip(self._viewports, frames):
                    viewport.name(frame.policy, top)
        problem = frames[0].problem
        scene = (problem.name, problem.num_robots, problem.dimension, len(frames))
        if scene != self._looked_at:
            self._looked_at = scene
            corners = limits + positions[:, None]
            self._camera.show(np.stack([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))]), problem.dimension)


def _positions(number: int, limits: Points) -> Points:
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
            with _bad_camera_left_alone():
                client.camera.up_direction = up
            self._look(client)

    def _look(self, client: viser.ClientHandle) -> None:
        camera = client.camera
        with _bad_camera_left_alone():
            camera.position, camera.look_at = view_from(self._limits, self._dimension, camera.aspect)


@contextmanager
def _bad_camera_left_alone() -> Iterator[None]:
    """A context that leaves a camera alone whose browser says that it looks nowhere, or that has nothing to see yet."""
    with suppress(ValueError, FloatingPointError), np.errstate(divide="raise", invalid="raise"):
        yield


def view_from(limits: Points, dimension: int, aspect: float) -> tuple[Vector, Vector]:
    """Camera and target for all between corners ``(2, 3)`` to be seen beside the controls in a window of this shape.

    In the plane it is seen from above, in space from the side.
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


FRAMES_PER_SECOND = 33
LAST_WAIT = 1.5  #: Seconds that closing takes at most, whatever is planned or connected


class _Server(viser.ViserServer):
    """A page that cannot be asked to open a tunnel to the internet."""

    def request_share_url(self, verbose: bool = True) -> None:
        del verbose


class Playground:
    """A page that shows a session, and lets its viewers change it.

    Args:
        problem: The scene to begin with.
        policies: Names of what drives, side by side; D4orm-C2F by default.
        seed: Of the policies, of what goes wrong, and of new goals.
        host: Address of the page; by default on this machine only. Elsewhere the address has a token.
        port: Port of the page; 0 for any free one.
        **observation: Arguments of :class:`d4orm_env.navigation_v0.parallel_env` on what robots observe.

    Raises:
        ValueError: If it cannot be found there, or there is no such policy.
    """

    def __init__(
        self,
        problem: Problem,
        *policies: str,
        seed: int = 0,
        host: str = LOOPBACK[0],
        port: int = 0,
        **observation: Any,
    ) -> None:
        local = host in LOOPBACK
        where, chosen = LOOPBACK[0] if local else host, _free_port(host, port)
        token = None if local else secrets.token_urlsafe(24)
        self.session = Session(problem, *policies, seed=seed, **observation)  #: Session that it shows
        with (
            contextlib.redirect_stdout(io.StringIO()),  # its own words on where it is
            OriginCheck(token, f"d4orm_play_{chosen}").installed(),
        ):
            self._server = _Server(host=where, port=chosen, verbose=False)
        # Otherwise Python prints every request that cannot be read.
        logging.getLogger("websockets").addHandler(logging.NullHandler())
        MessageValidator(self._server, self.session.refuse)
        named = socket.gethostname() if host in ("0.0.0.0", "::") else where
        #: Address to open in a browser
        self.address = f"http://{named}:{self._server.get_port()}/" + ("" if local else f"?token={token}")
        self._server.scene.configure_default_lights(enabled=False)
        self._server.scene.add_light_ambient("/light", intensity=1.1)
        self._server.scene.add_light_directional("/sun", intensity=0.5, position=(-1.0, -0.5, 2.0))
        self._server.gui.configure_theme(**THEME)
        self._server.gui.set_panel_label("d4orm play")
        self._view = View(self._server, self.session)
        self._panel = Panel(self._server, self.session, self._view)
        self._stopping = threading.Event()

    def run(self, seconds: float | None = None) -> None:
        """Show the session until Ctrl-C or :meth:`stop`, or for so long; an error that ended it is raised."""
        end = None if seconds is None else time.perf_counter() + seconds
        self.session.start()
        due = time.perf_counter()
        while not self._stopping.is_set() and (end is None or time.perf_counter() < end):
            if self.session.failure is not None:
                raise self.session.failure
            self.show()
            due = max(due + 1 / FRAMES_PER_SECOND, time.perf_counter())
            time.sleep(max(due - time.perf_counter(), 0.001))

    def stop(self) -> None:
        """Let :meth:`run` come to its end."""
        self._stopping.set()

    def show(self) -> None:
        self._view.update()
        self._panel.update()

    def close(self) -> None:
        """Leave no thread and no port, but for what does not end in :data:`LAST_WAIT`, which the process's end ends."""
        ending = [threading.Thread(target=end, daemon=True) for end in (self.session.close, self._server.stop)]
        deadline = time.perf_counter() + LAST_WAIT
        for thread in ending:
            thread.start()
        for thread in ending:
            thread.join(max(deadline - time.perf_counter(), 0))


def _free_port(host: str, port: int) -> int:
    """Return that port, any that is free for 0; ValueError if it is taken, or the host is not one of this machine's."""
    if not host:  # which would be every address
        raise ValueError(
            "cannot listen at no host; give --host an address, as 127.0.0.1, or 0.0.0.0 for all of this machine's"
        )
    try:
        with socket.create_server((host, port)) as listening:
            return int(listening.getsockname()[1])
    except (OSError, OverflowError, TypeError) as error:  # a name that is none is a TypeError
        raise ValueError(f"cannot listen at {host} port {port} ({error}); choose another --host or --port") from None
