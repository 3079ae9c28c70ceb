"""Style of all that this package draws, whatever the user's rcParams say."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

from d4orm_env.core.lazy import LazyModule

mpl: Any = LazyModule("matplotlib")
style: Any = LazyModule("matplotlib.style")

_NOTHING: Mapping[Any, Any] = MappingProxyType({})
_DRAWING = threading.RLock()
"""rcParams are the process's: of two threads that change them for a while, one would restore what the other had set."""


@contextmanager
def own_style(changes: Mapping[Any, Any] = _NOTHING) -> Iterator[None]:
    """Matplotlib's defaults with these changes, as a context or a decorator; afterwards the user's rcParams are back.

    What is read only when a figure is drawn or saved, such as fonts, needs the context then too.
    """
    with _DRAWING, mpl.rc_context():
        style.use("default")
        mpl.rcParams.update(changes)
        yield
