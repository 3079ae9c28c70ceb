"""Rendering of MuJoCo's environments: by MuJoCo where OpenGL can draw, by our own pictures elsewhere."""

from __future__ import annotations

from d4orm_env.envs.body_simulation import BodySimulation
from d4orm_env.envs.team_simulation import TeamSimulation
from d4orm_env.envs.viewer import Frame, Viewer
from d4orm_env.mujoco.bodies import TeamBodies
from d4orm_env.mujoco.camera import Camera, NoCameraError

RENDERERS = ("auto", "mujoco", "pictures")
"""Renderers of frames."""


class MujocoViewer(Viewer):
    """Draws a simulation in the environment's render mode.

    Args:
        render_mode: As of :class:`~d4orm_env.envs.viewer.Viewer`.
        renderer: One of :data:`RENDERERS`; ``"auto"`` becomes what is there when the first frame is drawn.
    """

    def __init__(self, render_mode: str | None, renderer: str) -> None:
        super().__init__(render_mode)
        self.renderer = renderer if render_mode == "rgb_array" else "pictures"
        self._camera: Camera | None = None
        self._looks_at: object = None

    def __getstate__(self) -> dict[str, object]:
        return super().__getstate__() | {"_camera": None, "_looks_at": None}

    def render(self, simulation: TeamSimulation) -> Frame | None:
        """``(height, width, 3)`` uint8 frame in mode ``"rgb_array"``, else ``None``.

        Raises:
            NoCameraError: If MuJoCo is to draw and OpenGL cannot.
        """
        assert isinstance(simulation, BodySimulation)
        if self.renderer != "pictures":
            simulation.require_reset()
            bodies = simulation.bodies
            assert isinstance(bodies, TeamBodies)
            try:
                if self._camera is None or self._looks_at is not bodies:
                    self.close()
                    self._camera, self._looks_at = Camera(bodies.scene.model, bodies.problem), bodies
            except NoCameraError:
                if self.renderer == "mujoco":
                    raise
                self.renderer = "pictures"
            else:
                self.renderer = "mujoco"
                return self._camera.draw(bodies.data, simulation.goals)
        return super().render(simulation)

    def close(self) -> None:
        """Close window, picture and camera; a later frame opens new ones."""
        super().close()
        if self._camera is not None:
            self._camera.close()
        self._camera = self._looks_at = None
