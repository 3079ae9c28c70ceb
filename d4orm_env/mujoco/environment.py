"""Multi-robot navigation among rigid bodies: the PettingZoo environment, moved by MuJoCo, and its pictures.

These are MuJoCo's where OpenGL draws without a screen, else our own.
"""

from __future__ import annotations

import importlib
import math
from functools import partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from pettingzoo import AECEnv
from pettingzoo.utils import OrderEnforcingWrapper

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import FloatArray, check_choice, short_repr
from d4orm_env.core.problem import Problem
from d4orm_env.envs.base_env import Frame, TeamSimulation, Viewer
from d4orm_env.envs.body_simulation import BodySimulation
from d4orm_env.envs.options import EnvOptions
from d4orm_env.mujoco.bodies import TeamBodies
from d4orm_env.mujoco.scene import Physics, check_problem, colour
from d4orm_env.navigation_v0 import AECNavigationEnv
from d4orm_env.scenarios.problems import ScenarioLike

PLATFORMS = ("egl", "osmesa")
"""OpenGL without a screen, as MuJoCo calls it."""
SIZE = 480
"""Height and width of a picture [pixels]."""
_VIEW_ANGLE = 45.0


class NoCameraError(RuntimeError):
    """OpenGL cannot draw without a screen here."""


def open_context(size: int) -> Any:
    """A context of OpenGL."""
    complaints = []
    for platform in PLATFORMS:
        try:
            context = importlib.import_module(f"mujoco.{platform}").GLContext(size, size)
            context.make_current()
        except Exception as error:  # every driver and loader fails in its own way
            complaints.append(f"{platform}: {' '.join(str(error).split()) or type(error).__name__}")
        else:
            return context
    raise NoCameraError(
        f"OpenGL cannot draw without a screen here ({'; '.join(complaints)}); install EGL or OSMesa, or use "
        "renderer='pictures'"
    )


class Camera:
    """A look down on a scene at a slant, with a problem's starts, goals and bounds in view."""

    def __init__(self, model: mujoco.MjModel, problem: Problem) -> None:
        self._gl = open_context(SIZE)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._model, self._goal_radius = model, problem.goal_radius
        self._scene = mujoco.MjvScene(model, maxgeom=10_000)
        self._view = mujoco.MjvCamera()
        positions = np.concatenate([problem.start[:, :2], problem.goal])
        if problem.world.lower is not None:
            positions = np.concatenate([positions, problem.world.bounds])
        low, high = positions.min(axis=0), positions.max(axis=0)
        extent = float(np.linalg.norm(high - low)) / 2 + 2 * float(problem.team.radius.max())
        self._view.lookat[:] = [*((low + high) / 2), 0]
        self._view.distance = extent / math.tan(math.radians(_VIEW_ANGLE / 2))
        self._view.elevation, self._view.azimuth = -60, 90

    def draw(self, data: mujoco.MjData, goals: FloatArray) -> NDArray[np.uint8]:
        """``(480, 480, 3)`` uint8 picture of the bodies as they are, and of goals ``(K, 2)`` [m] on the floor."""
        # What is drawn follows from positions; after a step these are ahead of it.
        mujoco.mj_kinematics(self._model, data)
        self._gl.make_current()
        frame = np.empty((SIZE, SIZE, 3), np.uint8)
        view, whole = mujoco.MjvOption(), mujoco.MjrRect(0, 0, SIZE, SIZE)
        mujoco.mjv_updateScene(self._model, data, view, None, self._view, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene)
        self._add_goals(goals)
        mujoco.mjr_render(whole, self._scene, self._context)
        mujoco.mjr_readPixels(frame, None, whole, self._context)
        return frame[::-1].copy()

    def _add_goals(self, goals: FloatArray) -> None:
        size = [self._goal_radius, 1e-3, 0]
        for robot, goal in enumerate(goals.tolist()):
            if self._scene.ngeom == self._scene.maxgeom:
                return
            disc = self._scene.geoms[self._scene.ngeom]
            paint = np.array(colour(robot), np.float32)
            mujoco.mjv_initGeom(disc, mujoco.mjtGeom.mjGEOM_CYLINDER, size, [*goal, 2e-3], np.eye(3).ravel(), paint)
            self._scene.ngeom += 1

    def close(self) -> None:
        """Give back what OpenGL holds."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()


RENDERERS = ("auto", "mujoco", "pictures")
"""Renderers of frames."""


class MujocoViewer(Viewer):
    """Draws a simulation in the environment's render mode, by one of :data:`RENDERERS`.

    ``"auto"`` becomes what is there when the first frame is drawn.
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


class parallel_env(navigation_v0.parallel_env):
    """:class:`d4orm_env.navigation_v0.parallel_env` with the team as rigid bodies in MuJoCo.

    Observations, actions, infos, docking, rewards and metrics are the same; what differs is how robots move. Planar
    problems of ``holonomic2d`` and ``velocity2d``, which are pushed pucks, and of ``differential_drive`` and
    ``unicycle``, which have two wheels and a caster. ``collided`` is contact at any moment of a step.

    Args:
        scenario: As in :class:`~d4orm_env.envs.options.EnvOptions`, like all arguments not named here.
        num_robots: Size of the team.
        physics: Material of the bodies.
        renderer: Renderer of ``"rgb_array"`` frames: ``"mujoco"``; ``"pictures"``, which are those of the other
            environments; or by default ``"auto"``, MuJoCo where EGL or OSMesa is there, else pictures. A window is
            always of pictures.
        **options: Further attributes of :class:`~d4orm_env.envs.options.EnvOptions`, and arguments of the scenario.

    Raises:
        TypeError: For an argument that neither the environment nor the scenario has.
        ValueError: For a bad argument, or a robot that has no body in MuJoCo.
    """

    metadata: dict[str, object] = navigation_v0.parallel_env.metadata | {"name": "d4orm_mujoco"}

    def __init__(
        self,
        scenario: ScenarioLike | None = None,
        num_robots: int | None = None,
        *,
        physics: Physics | None = None,
        renderer: str = "auto",
        **options: object,
    ) -> None:
        if not isinstance(physics, Physics | None):
            raise ValueError(f"physics is {short_repr(physics)}; give d4orm_env.mujoco.Physics(...), or leave it out")
        check_choice(renderer, "renderer", RENDERERS)
        self._physics, self._renderer = physics or Physics(), renderer
        super().__init__(scenario, num_robots, **options)

    def _make_simulation(self, options: EnvOptions) -> BodySimulation:
        return BodySimulation(options, check_problem, partial(TeamBodies, physics=self._physics))

    def _make_viewer(self, options: EnvOptions) -> MujocoViewer:
        return MujocoViewer(options.render_mode, self._renderer)


def raw_env(
    scenario: ScenarioLike | None = None, num_robots: int | None = None, **options: object
) -> AECEnv[str, FloatArray, FloatArray | None]:
    """The robots act in turn and move together when the last has chosen; arguments of :class:`parallel_env`."""
    return AECNavigationEnv(parallel_env(scenario, num_robots, **options))  # type: ignore[arg-type] # checked there


def env(
    scenario: ScenarioLike | None = None, num_robots: int | None = None, **options: object
) -> AECEnv[str, FloatArray, FloatArray | None]:
    """:func:`raw_env`, with calls in the wrong order caught; arguments of :class:`parallel_env`."""
    return OrderEnforcingWrapper(raw_env(scenario, num_robots, **options))
