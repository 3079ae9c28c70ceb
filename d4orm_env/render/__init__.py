"""Pictures, animations, replays and live views of trajectories, and the style of all that this package draws.

The drawing functions load matplotlib, so they are imported on first use and ``import d4orm_env.render`` stays light.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from d4orm_env.core.lazy import LazyModule

if TYPE_CHECKING:
    from d4orm_env.render.animation import check_ffmpeg as check_ffmpeg
    from d4orm_env.render.animation import save_animation
    from d4orm_env.render.frames import FrameRenderer, WindowRenderer
    from d4orm_env.render.pictures import plot, plot_trajectory, save_picture
    from d4orm_env.render.replay import Replay, motion

_mpl: Any = LazyModule("matplotlib")
_style: Any = LazyModule("matplotlib.style")

_HOMES = {
    "FrameRenderer": "frames",
    "Replay": "replay",
    "WindowRenderer": "frames",
    "check_ffmpeg": "animation",
    "motion": "replay",
    "plot": "pictures",
    "plot_trajectory": "pictures",
    "save_animation": "animation",
    "save_picture": "pictures",
}

__all__ = [
    "FrameRenderer", "Replay", "WindowRenderer", "motion", "plot", "plot_trajectory", "save_animation", "save_picture",
]  # fmt: skip

_NOTHING: Mapping[Any, Any] = MappingProxyType({})
_DRAWING = threading.RLock()
"""rcParams are the process's: of two threads that change them for a while, one would restore what the other had set."""


@contextmanager
def own_style(changes: Mapping[Any, Any] = _NOTHING) -> Iterator[None]:
    """Matplotlib's defaults with these changes, as a context or a decorator; afterwards the user's rcParams are back.

    What is read only when a figure is drawn or saved, such as fonts, needs the context then too.
    """
    with _DRAWING, _mpl.rc_context():
        _style.use("default")
        _mpl.rcParams.update(changes)
        yield


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
