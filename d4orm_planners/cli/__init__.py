"""The command line: its entry, and signals while a command is under way."""

from __future__ import annotations

import gc
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def main() -> None:
    """Run the command line and exit, without a traceback if Ctrl-C comes while it is loaded."""
    gc.disable()  # until the command's modules are loaded: nothing of them is garbage
    try:
        from d4orm_planners.cli.app import main as run
    except KeyboardInterrupt:
        sys.exit(130)
    try:
        run()
    finally:
        gc.freeze()  # Python would look for garbage three times as it exits, for up to half a second


@contextmanager
def on_signals(handle: Callable[[int, Any], Any], *numbers: int) -> Iterator[None]:
    """Have SIGINT and SIGTERM, or these, call a function meanwhile; in other threads than the main one nothing is."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = {number: signal.signal(number, handle) for number in numbers or (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
