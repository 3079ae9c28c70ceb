"""Compiled kernels on disk, invalidated by any change of the sources they are made of.

A wheel may bring kernels, compiled for the levels of x86-64 (``make warm-wheel``): they are looked for first. A plan
has the same bits on every processor, so that a level is all that such a kernel has to know of one.
"""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import os
import pickle
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache, cached_property, partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, ParamSpec, Protocol, TypeVar

import numba
from llvmlite.binding import get_host_cpu_features
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    InTreeCacheLocator,
    UserProvidedCacheLocator,
)
from numba.core.codegen import JITCPUCodegen
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys
from numba.core.typing.templates import Signature
from numba.misc.appdirs import AppDirs

from d4orm_env.core.files import replaced_when_done
from d4orm_env.dynamics.source_digest import bytecode, pieces

P = ParamSpec("P")
R_co = TypeVar("R_co", covariant=True)
_DIGEST_SIZE = hashlib.sha256().digest_size
_NAMING = "structs by their fields"
"""Rule by which names in kernels differ; kernels named by another must not be loaded beside these."""
_ROOM = 2**24
"""Bytes that all kernels of the package take, more or less."""


class Kernel(Protocol[P, R_co]):
    """A function that numba has compiled, or will when it is first called.

    Attributes:
        signatures: Types of arguments that it is compiled for.
    """

    @property
    def signatures(self) -> Sequence[tuple[object, ...]]: ...

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R_co: ...


class _Files(IndexDataCacheFile):
    """numba's index and data files, with a digest of the content and of what it depends on behind it.

    What a power cut, a full disk or another version has left counts as missing: it is neither unpickled nor executed.
    """

    def load(self, key: tuple[object, ...]) -> Any:
        """Return what is kept under a key, or ``None``."""
        kept = super().load(key)
        # Two processes that add to an index at once may have given the same file to different keys.
        return kept[1] if kept is not None and kept[0] == key else None

    def save(self, key: tuple[object, ...], data: object) -> None:
        """Keep it."""
        super().save(key, (key, data))

    def _load_index(self) -> dict[tuple[object, ...], str]:
        return self._if_whole(self._index_path, super()._load_index) or {}

    def _load_data(self, name: str) -> Any:
        return self._if_whole(self._data_path(name), partial(super()._load_data, name))

    def _if_whole(self, path: str, load: Callable[[], Any]) -> Any:
        # ImportError, AttributeError: another version of this package kept types that are gone.
        with suppress(OSError, ImportError, AttributeError):
            content = Path(path).read_bytes()
            if content[-_DIGEST_SIZE:] == self._digest(content[:-_DIGEST_SIZE]):
                return load()
        return None

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BytesIO]:
        with BytesIO() as content, replaced_when_done(Path(filepath)) as temporary:
            yield content
            # What is behind a pickle is no part of it.
            temporary.write_bytes(content.getvalue() + self._digest(content.getvalue()))

    def _digest(self, content: bytes) -> bytes:
        return hashlib.sha256(repr((self._version, self._source_stamp)).encode() + content).digest()


LEVELS = {
    "x86-64-v4": ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
    "x86-64-v3": ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"),
    "x86-64-v2": ("sse4.2", "popcnt", "ssse3"),
}
"""Levels of x86-64, the newest first, and what a processor must have for each beyond the next."""
SHIPPED = Path(__file__).parents[1] / "kernels"
"""Folder of a wheel with one of kernels for each level; a checkout has none."""
_SHIPPED_STAMP = "shipped"
"""In place of the time of a source file, which is that of the installation."""


def levels_here() -> tuple[str, ...]:
    """The levels that this processor is of, the newest first."""
    has, levels = get_host_cpu_features(), tuple(LEVELS)
    missing = [level for level in levels if not all(has.get(feature) for feature in LEVELS[level])]
    return levels[levels.index(missing[-1]) + 1 :] if missing else levels


@cache
def _shipped_folder() -> Path | None:
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


class _ShippedFiles(_Files):
    """Index and data files of a level. What the wheel's record does not list, as it is, counts as missing."""

    def __init__(self, folder: Path, filename_base: str) -> None:
        super().__init__(str(folder), filename_base, _SHIPPED_STAMP)

    def _if_whole(self, path: str, load: Callable[[], Any]) -> Any:
        with suppress(OSError, ImportError, AttributeError):
            digest = hashlib.sha256(Path(path).read_bytes()).digest()
            if _record().get(Path(path).resolve()) == base64.urlsafe_b64encode(digest).decode().rstrip("="):
                return load()
        return None


class _Place(CompileResultCacheImpl):
    """The folder that numba chooses, but none in a home folder that is not there or that others can write to."""

    def __init__(self, function: Callable[..., object]) -> None:
        if not _is_private(Path(AppDirs(appname="numba", appauthor=False).user_cache_dir)):
            self._locator_classes = [UserProvidedCacheLocator, InTreeCacheLocator]
        super().__init__(function)


def _is_private(folder: Path) -> bool:
    """Return whether nobody else can put files there, which would be unpickled and executed."""
    if not folder.is_absolute():  # where nobody knows the home folder, it begins with ~
        return False
    if not hasattr(os, "getuid"):
        return True
    try:
        states = [place.stat() for place in (folder, *folder.parents) if place.exists()]
    except OSError:
        return False
    # Others may make folders in /tmp, but not put them in the place of ours.
    return all(
        state.st_uid in (0, os.getuid()) and (not state.st_mode & stat.S_IWOTH or state.st_mode & stat.S_ISVTX)
        for state in states
    )


class _SourceKeyedCache(FunctionCache):
    """Kernels by a key of their own: numba notices an edit of the file a kernel is in, but neither of those it calls
    into nor what functions one kernel of a factory has that another has not.
    """

    _impl_class = _Place

    def __init__(self, function: Callable[..., object], key: str) -> None:
        super().__init__(function)
        self._function, self._key = function, key
        self._cache_file = _Files(self.cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp())

    @cached_property
    def _source_key(self) -> str:
        """SHA-256 over all code that the kernel is made of."""
        content = repr([_NAMING, self._key, *pieces(self._function, bytecode)])
        return hashlib.sha256(content.encode()).hexdigest()

    def _index_key(self, sig: Signature, codegen: JITCPUCodegen) -> tuple[object, ...]:
        return sig, codegen.magic_tuple(), self._source_key

    def load_overload(self, sig: Signature, target_context: Any) -> Any:
        """Return what is kept for a signature, or ``None``.

        numba fills its registries first, for half a second, which only compiling has a use for.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def _load_overload(self, sig: Signature, target_context: Any) -> Any:
        shipped = self._shipped and self._shipped.load((sig, self._source_key))
        return self._impl.rebuild(target_context, shipped) if shipped else super()._load_overload(sig, target_context)

    @property
    def _shipped(self) -> _ShippedFiles | None:
        folder = _shipped_folder()
        return None if folder is None else _ShippedFiles(folder, self._impl.filename_base)

    def save_overload(self, sig: Signature, data: CompileResult) -> None:
        """Keep a kernel where there is room for it; elsewhere the next process compiles it anew."""
        with suppress(OSError):
            super().save_overload(sig, data)

    def is_kept(self) -> bool:
        """True if anything is kept, for the sources as they are now."""
        return any(
            key[-1] == self._source_key and files.load(key) is not None
            for files in (self._shipped, self._cache_file)
            if files is not None
            for key in files._load_index()
        )


def cached_kernel(variant: str = "", key: str = "", **options: Any) -> Callable[[Callable[P, R_co]], Kernel[P, R_co]]:
    """Decorator: compile with numba on first call, and keep the result on disk until any code that it calls changes.

    The kernels of a factory need a ``variant`` each, which names their files: processes that compile two of them at the
    same time would otherwise write to the same ones, and one might be loaded for the other. ``key`` is what a kernel
    depends on besides code.

    Where neither the package's folder nor the user's cache folder can be written, kernels are compiled anew in every
    process; set ``NUMBA_CACHE_DIR`` to a folder that can.

    Raises:
        ImportError: From the decorator, if ``NUMBA_DISABLE_JIT`` is set.
    """

    def decorate(function: Callable[P, R_co]) -> Kernel[P, R_co]:
        function.__qualname__ += variant and f"_{variant}"
        # No C code calls a kernel.
        dispatcher = numba.njit(nogil=True, **options | {"no_cfunc_wrapper": True})(function)
        if dispatcher is function:
            raise ImportError("NUMBA_DISABLE_JIT is set, but the kernels run only when compiled; unset it")
        with suppress(RuntimeError):
            dispatcher._cache = _SourceKeyedCache(function, f"{key} {options}")
        return dispatcher

    return decorate


def check_can_be_kept() -> None:
    """Find out whether kernels can be kept on disk.

    Raises:
        OSError: If no folder can be written to, or the disk is full.
    """
    try:
        folder = _Place(check_can_be_kept).locator.get_cache_path()
    except RuntimeError:
        raise OSError("no cache folder can be written to; set NUMBA_CACHE_DIR to one that can") from None
    try:
        with TemporaryFile(dir=folder) as file:
            file.write(bytes(_ROOM))
    except OSError as error:
        raise OSError(
            f"cache {folder} cannot be written to ({error.strerror}); set NUMBA_CACHE_DIR to another"
        ) from None


def has_to_be_compiled(kernel: Kernel[..., object]) -> bool:
    """Check whether a kernel of :func:`cached_kernel` could be kept on disk and is not yet, for the present sources."""
    cache = getattr(kernel, "_cache", None)
    return isinstance(cache, _SourceKeyedCache) and not cache.is_kept()


def ship(cache: Path, folder: Path) -> None:
    """Put all kernels that are kept below one folder into that of a wheel, under keys without the processor."""
    for index in cache.rglob("*.nbi"):
        with index.open("rb") as file:
            _, (stamp, _) = pickle.load(file), pickle.load(file)
        kept, shipped = (
            _Files(str(place), index.stem, mark) for place, mark in ((index.parent, stamp), (folder, _SHIPPED_STAMP))
        )
        for key in kept._load_index():
            sig, _, source_key = key
            shipped.save((sig, source_key), kept.load(key))
