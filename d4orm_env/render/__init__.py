"""Pictures, animations and live views of trajectories.

The drawing functions load matplotlib, so they are imported on first use and ``import d4orm_env.render`` stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from d4orm_env.render.animation import save_animation
    from d4orm_env.render.pictures import FrameRenderer, WindowRenderer, plot_trajectory, save_picture

__all__ = ["FrameRenderer", "WindowRenderer", "plot_trajectory", "save_animation", "save_picture"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    leaf = "animation" if name == "save_animation" else "pictures"
    return getattr(import_module(f"{__name__}.{leaf}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
