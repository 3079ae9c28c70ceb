"""Pictures, animations, replays and live views of trajectories.

The drawing functions load matplotlib, so they are imported on first use and ``import d4orm_env.render`` stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from d4orm_env.render.animation import save_animation
    from d4orm_env.render.frames import FrameRenderer, WindowRenderer
    from d4orm_env.render.pictures import plot, plot_trajectory, save_picture
    from d4orm_env.render.replay import Replay, motion

_HOMES = {
    "FrameRenderer": "frames",
    "Replay": "replay",
    "WindowRenderer": "frames",
    "motion": "replay",
    "plot": "pictures",
    "plot_trajectory": "pictures",
    "save_animation": "animation",
    "save_picture": "pictures",
}

__all__ = [
    "FrameRenderer", "Replay", "WindowRenderer", "motion", "plot", "plot_trajectory", "save_animation", "save_picture",
]  # fmt: skip


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
