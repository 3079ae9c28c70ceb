"""Compiled kernels on disk, invalidated by any change of the sources they are made of.

Kernels of a wheel come first.
"""

from __future__ import annotations

import gc
import hashlib
import os
import stat
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property, wraps
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, ParamSpec, Protocol, TypeVar

import numba
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    InTreeCacheLocator,
    UserProvidedCacheLocator,
)
from numba.core.codegen import JITCPUCodegen
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys
from numba.core.typing.templates import Signature
from numba.misc.appdirs import AppDirs

from d4orm_env.dynamics.source_digest import bytecode, pieces
from d4orm_env.engine.compilers import KernelCompiler
from d4orm_env.engine.kernel_files import KernelFiles, ShippedFiles, Turn, shipped_folder

P = ParamSpec("P")
R_co = TypeVar("R_co", covariant=True)
_NAMING = "structs by reference, named by their fields, parts by their kernels"
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


class _CacheFolder(CompileResultCacheImpl):
    """The folder that numba chooses, but none in a home folder that is not there or that others can write to."""

    def __init__(self, function: Callable[..., object]) -> None:
        if not _is_private(Path(AppDirs(appname="numba", appauthor=False).user_cache_dir)):
            self._locator_classes = [UserProvidedCacheLocator, InTreeCacheLocator]
        super().__init__(function)


def _is_private(folder: Path) -> bool:
    """Check that no other user can put files there, which would be unpickled and executed."""
    if not folder.is_absolute():  # where the home folder is unknown, it begins with ~
        return False
    if not hasattr(os, "getuid"):
        return True
    try:
        states = [path.stat() for path in (folder, *folder.parents) if path.exists()]
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

    _impl_class = _CacheFolder

    def __init__(self, function: Callable[..., object], key: str) -> None:
        super().__init__(function)
        self._function, self._key = function, key
        self._turn = Turn(Path(self.cache_path, f"{self._impl.filename_base}.lock"))
        self._cache_file: KernelFiles = KernelFiles(
            self.cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp()
        )

    @cached_property
    def _source_key(self) -> str:
        """SHA-256 over all code that the kernel is made of."""
        content = repr([_NAMING, self._key, *pieces(self._function, bytecode)])
        return hashlib.sha256(content.encode()).hexdigest()

    def _index_key(self, sig: Signature, codegen: JITCPUCodegen) -> tuple[object, ...]:
        return sig, codegen.magic_tuple(), self._source_key

    def load_overload(self, sig: Signature, target_context: Any) -> Any:
        """The kernel kept for a signature, or ``None`` if it is this process's turn to compile it.

        numba fills its registries first, for half a second, which only compiling has a use for.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            found = self._load_overload(sig, target_context)
            if found is None and self._turn.wait():
                found = self._load_overload(sig, target_context)
            return found

    def let_go(self) -> None:
        """Let other processes compile the kernel."""
        self._turn.end()

    def _load_overload(self, sig: Signature, target_context: Any) -> Any:
        shipped = self._shipped and self._shipped.load((sig, self._source_key))
        return self._impl.rebuild(target_context, shipped) if shipped else super()._load_overload(sig, target_context)

    @property
    def _shipped(self) -> ShippedFiles | None:
        folder = shipped_folder()
        return None if folder is None else ShippedFiles(folder, self._impl.filename_base)

    def save_overload(self, sig: Signature, data: CompileResult) -> None:
        """Keep a kernel where there is room for it; elsewhere the next process compiles it anew."""
        with suppress(OSError):
            super().save_overload(sig, data)

    def is_kept(self, sig: object = None) -> bool:
        """True if anything is kept, or a signature, for the sources as they are now."""
        return any(
            key[-1] == self._source_key and sig in (None, key[0]) and files.holds(key)
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
        dispatcher = numba.njit(nogil=True, **options | {"no_cfunc_wrapper": True, "pipeline_class": KernelCompiler})(
            function
        )
        if dispatcher is function:
            raise ImportError("NUMBA_DISABLE_JIT is set, but the kernels run only when compiled; unset it")
        with suppress(RuntimeError):
            dispatcher._cache = _SourceKeyedCache(function, f"{key} {options}")
        dispatcher.compile = _compile_once(dispatcher.compile, dispatcher._cache)
        return dispatcher

    return decorate


def _compile_once(compile_kernel: Callable[P, R_co], cache: object) -> Callable[P, R_co]:
    """Compile without garbage collection, which takes a twelfth of the time and finds next to nothing.

    Meanwhile other processes that need the kernel wait, as :meth:`_SourceKeyedCache.load_overload` says.
    """

    @wraps(compile_kernel)
    def compile_once(*args: P.args, **kwargs: P.kwargs) -> R_co:
        collects = gc.isenabled()
        gc.disable()
        try:
            return compile_kernel(*args, **kwargs)
        finally:
            if isinstance(cache, _SourceKeyedCache):
                cache.let_go()
            if collects:
                gc.enable()

    return compile_once


def check_can_be_kept() -> None:
    """Raise OSError if kernels cannot be kept on disk: no folder can be written to, or the disk is full."""
    try:
        folder = _CacheFolder(check_can_be_kept).locator.get_cache_path()
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


def is_kept(kernel: Kernel[..., object], sig: tuple[object, ...]) -> bool:
    """Check whether a kernel of :func:`cached_kernel` is compiled for these types already, here or on disk."""
    cache = getattr(kernel, "_cache", None)
    return sig in kernel.signatures or (isinstance(cache, _SourceKeyedCache) and cache.is_kept(sig))
