"""Turns that processes take, by a lock on a file, which the system takes from a process that dies."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows: nobody waits
    fcntl = None  # type: ignore[assignment]

_PATIENCE = 120.0
"""Seconds to wait at most: the process whose turn it is may have been stopped."""
_PAUSE = 0.02


class Turn:
    """A turn at something that one process at a time does, as long as it takes less than two minutes."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] | None = None

    def wait(self) -> bool:
        """Wait for this process's turn; true if another one had it meanwhile."""
        if fcntl is None or self._file is not None:
            return False
        waited, begin = False, time.monotonic()
        with suppress(OSError):  # a folder that cannot be written to, or a file system without locks
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._path.open("ab")
            while time.monotonic() - begin < _PATIENCE:
                try:
                    fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    waited = True
                    time.sleep(_PAUSE)
        return waited

    def end(self) -> None:
        """End it, if it is this process's."""
        if self._file is not None:
            self._file.close()
            self._file = None
