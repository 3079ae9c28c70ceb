"""Files of compiled kernels: what is whole is loaded, from the cache or from a wheel; and turns at compiling them.

A wheel may bring kernels, compiled for the levels of x86-64 (``make warm-wheel``). A plan has the same bits on every
processor, so that a level is all that such a kernel has to know of one.
"""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import os
import pickle
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from llvmlite.binding import get_host_cpu_features
from numba.core.caching import IndexDataCacheFile, _cache_log
from numba.core.environment import Environment, _rebuild_env, lookup_environment

from d4orm_env.core.files import replaced_when_done

try:
    import fcntl
except ImportError:  # Windows: nobody waits
    fcntl = None  # type: ignore[assignment]

_PATIENCE, _PAUSE = 120.0, 0.02
"""Seconds to wait for a turn at most, for the process whose turn it is may have been stopped; and between looks."""
_DIGEST_SIZE = hashlib.sha256().digest_size


class _Unpickler(pickle.Unpickler):
    """Reader of kernels that does not import what numba's functions in them come from, for a tenth of a second."""

    def find_class(self, module: str, name: str) -> Any:
        rebuilt = (module, name) == (_rebuild_env.__module__, _rebuild_env.__name__)
        return _environment if rebuilt else super().find_class(module, name)


def _environment(module: str, constants: list[object], name: str) -> Environment:
    """As numba's, but without the names of the module, which only Python's objects in kernels would ask for."""
    found = lookup_environment(name)
    if found is None:
        found = Environment({"__name__": module})
        found.consts[:], found.env_name = constants, name
        Environment._memo[name] = found
    return found


class KernelFiles(IndexDataCacheFile):
    """numba's index and data files, with a digest of the content and of what it depends on behind it.

    What a power cut, a full disk or another version has left counts as missing: it is neither unpickled nor executed.
    """

    def load(self, key: tuple[object, ...]) -> Any:
        """Content kept under a key, or ``None``."""
        kept = super().load(key)
        # Two processes that add to an index at once may have given the same file to different keys.
        return kept[1] if kept is not None and kept[0] == key else None

    def save(self, key: tuple[object, ...], data: object) -> None:
        """Keep it."""
        super().save(key, (key, data))

    def _load_index(self) -> dict[tuple[object, ...], str]:
        with suppress(ImportError, AttributeError):
            return {} if self._content(self._index_path) is None else super()._load_index()
        return {}

    def holds(self, key: tuple[object, ...]) -> bool:
        """Check whether something whole is kept under a key, without loading it."""
        name = self._load_index().get(key)
        return name is not None and self._content(self._data_path(name)) is not None

    def _load_data(self, name: str) -> Any:
        content = self._content(self._data_path(name))
        # ImportError, AttributeError: another version of this package kept types that are gone.
        with suppress(ImportError, AttributeError):
            kept = None if content is None else _Unpickler(BytesIO(content)).load()
            _cache_log("[cache] data loaded from %r", self._data_path(name))  # as numba does with NUMBA_DEBUG_CACHE
            return kept
        return None

    def _content(self, path: str) -> bytes | None:
        """Content of a file, if it is there and whole."""
        with suppress(OSError):
            content = Path(path).read_bytes()
            if content[-_DIGEST_SIZE:] == self._digest(content[:-_DIGEST_SIZE]):
                return content
        return None

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BytesIO]:
        with BytesIO() as content, replaced_when_done(Path(filepath)) as temporary:
            yield content
            # What is behind a pickle is no part of it.
            temporary.write_bytes(content.getvalue() + self._digest(content.getvalue()))

    def _digest(self, content: bytes) -> bytes:
        return hashlib.sha256(repr((self._version, self._source_stamp)).encode() + content).digest()


class Turn:
    """A turn at something that one process at a time does, as long as it takes less than two minutes.

    It is a lock on a file, which the system takes from a process that dies.
    """

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


LEVELS = {
    "x86-64-v4": ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
    "x86-64-v3": ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"),
    "x86-64-v2": ("sse4.2", "popcnt", "ssse3"),
}
"""Levels of x86-64, the newest first, and what a processor must have for each beyond the next."""
SHIPPED = Path(__file__).parents[1] / "kernels"
"""Folder of a wheel with one of kernels for each level; a checkout has none."""
SHIPPED_STAMP = "shipped"
"""In place of the time of a source file, which is that of the installation."""


def levels_here() -> tuple[str, ...]:
    """The levels that this processor is of, the newest first."""
    has, levels = get_host_cpu_features(), tuple(LEVELS)
    missing = [level for level in levels if not all(has.get(feature) for feature in LEVELS[level])]
    return levels[levels.index(missing[-1]) + 1 :] if missing else levels


@cache
def shipped_folder() -> Path | None:
    """The folder of this processor's kernels, if there is one and kernels are not to be compiled for another."""
    if not SHIPPED.is_dir() or os.environ.get("NUMBA_CPU_NAME"):
        return None
    return next((SHIPPED / level for level in levels_here() if (SHIPPED / level).is_dir()), None)


@cache
def _record() -> Mapping[Path, str]:
    """Digests of the kernels that the wheel's own record lists."""
    files = importlib.metadata.files("d4orm-env") or []
    return {
        Path(str(file.locate())).resolve(): file.hash.value for file in files if file.hash and "kernels" in file.parts
    }


class ShippedFiles(KernelFiles):
    """Index and data files of a level. What the wheel's record does not list, as it is, counts as missing."""

    def __init__(self, folder: Path, filename_base: str) -> None:
        super().__init__(str(folder), filename_base, SHIPPED_STAMP)

    def _content(self, path: str) -> bytes | None:
        with suppress(OSError):
            content = Path(path).read_bytes()
            digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).decode().rstrip("=")
            return content if _record().get(Path(path).resolve()) == digest else None
        return None
