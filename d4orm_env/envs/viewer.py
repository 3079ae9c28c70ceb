"""Rendering for the environments: one picture or window per environment, opened at the first frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import gymnasium
import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
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
    """Draws a simulation in the environment's render mode.

    Args:
        render_mode: ``"rgb_array"``, ``"human"`` or ``None``.

    Raises:
        ValueError: For another mode.
    """

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
