"""Base of the environments of one team: a simulation, and pictures of it in one window or image."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import gymnasium
import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance import DisturbanceEffect
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.setup import EnvSetup
from d4orm_env.envs.team_simulation import TeamSimulation

if TYPE_CHECKING:
    from d4orm_env.render import frames
    from d4orm_env.render.frames import FrameRenderer, WindowRenderer
else:
    frames = LazyModule("d4orm_env.render.frames")

Frame: TypeAlias = NDArray[np.uint8]
"""``(height, width, 3)``."""

RENDER_MODES = ("human", "rgb_array")


class Viewer:
    """Draws a simulation in the environment's render mode: ``"rgb_array"``, ``"human"`` or ``None``."""

    def __init__(self, render_mode: str | None) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode is {render_mode!r}; choose one of {', '.join(RENDER_MODES)}, or None")
        self._mode = render_mode
        self._renderer: FrameRenderer | WindowRenderer | None = None
        self._problem: Problem | None = None

    def __getstate__(self) -> dict[str, object]:
        # Figures and windows are neither copied nor sent to other processes; a copy opens its own.
        return self.__dict__ | {"_renderer": None, "_problem": None}

    def render(self, simulation: TeamSimulation) -> Frame | None:
        """``(height, width, 3)`` uint8 frame in mode ``"rgb_array"``, else ``None``."""
        if self._mode is None:
            gymnasium.logger.warn("render() was called without a render mode; give render_mode= when making the env.")
            return None
        simulation.require_reset()
        if self._renderer is None or self._problem is not simulation.problem:
            self.close()
            self._renderer, self._problem = self._open(simulation.problem), simulation.problem
        frame = self._renderer.draw(
            simulation.states,
            simulation.arrived,
            simulation.worlds.collided[0],
            goals=simulation.goals,
            trail=simulation.trail,
            marks=simulation.marks(),
        )
        return frame if self._mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window or picture; a later frame opens a new one."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = self._problem = None

    def _open(self, problem: Problem) -> FrameRenderer | WindowRenderer:
        return frames.FrameRenderer(problem) if self._mode == "rgb_array" else frames.WindowRenderer(problem)


class BaseEnv:
    """A simulation, read and drawn; how it is reset and stepped is up to the environment.

    Before the first reset all that asks about an episode is a ``RuntimeError``.

    Attributes:
        options: Options that it was made of.
    """

    options: EnvOptions
    metadata: dict[str, object]
    render_mode: str | None

    def _begin(self, options: EnvOptions) -> None:
        self.options, self.render_mode = options, options.render_mode
        self._viewer = self._make_viewer(options)
        self._simulation = self._make_simulation(options)
        self.metadata = type(self).metadata | {"render_fps": max(1, round(1 / self.problem.dt))}

    def _make_simulation(self, options: EnvOptions) -> TeamSimulation:
        """Make the environment's simulation; one with another physics overrides it."""
        return TeamSimulation(EnvSetup(options))

    def _make_viewer(self, options: EnvOptions) -> Viewer:
        return Viewer(options.render_mode)

    @property
    def problem(self) -> Problem:
        """The problem being run; where every reset draws a new instance, that of the present episode."""
        return self._simulation.problem

    @property
    def lifelong(self) -> bool:
        """True if robots that arrive get fresh goals instead of staying there."""
        return self._simulation.setup.lifelong

    def state(self) -> FloatArray:
        """The joint state, all a planner needs to go on from here; see :mod:`d4orm_env.envs.joint_state`."""
        return self._simulation.state()

    def true_state(self) -> FloatArray:
        """:meth:`state` as it truly is, where a disturbance of what is seen has it told otherwise."""
        return self._simulation.true_state()

    def effect(self) -> DisturbanceEffect:
        """Return the effect of the disturbances up to now, as arrays with one world as their first axis."""
        return self._simulation.effect()

    def metrics(self) -> dict[str, float]:
        """The episode so far in numbers; see :func:`d4orm_env.envs.team_step.episode_metrics`."""
        return self._simulation.metrics()

    def render(self) -> Frame | None:
        """``(height, width, 3)`` uint8 frame in mode ``"rgb_array"``, else ``None``."""
        return self._viewer.render(self._simulation)

    def _show(self) -> None:
        """Draw what has just happened, if it is shown."""
        if self.render_mode == "human":
            self.render()

    def close(self) -> None:
        """Close the window or picture, if there is one."""
        self._viewer.close()
