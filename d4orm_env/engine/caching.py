"""Compiled kernels on disk, invalidated by any change of the sources they are made of."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import ModuleType
from typing import Any, ParamSpec, Protocol, TypeVar

import numba
from numba.core.base import BaseContext
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCPUCodegen
from numba.core.typing.templates import Signature

P = ParamSpec("P")
R_co = TypeVar("R_co", covariant=True)


class Kernel(Protocol[P, R_co]):
    """A function that numba has compiled, or will when it is first called.

    Attributes:
        signatures: Types of arguments that it is compiled for.
    """

    @property
    def signatures(self) -> Sequence[tuple[object, ...]]: ...

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R_co: ...


def fingerprint(modules: tuple[ModuleType, ...]) -> str:
    """SHA-256 over the source text of these modules."""
    return hashlib.sha256("".join(inspect.getsource(module) for module in modules).encode()).hexdigest()


class _SourceKeyedCache(FunctionCache):
    """Kernels by a key of our own: numba notices an edit of the file a kernel is in, but neither of those it calls into
    nor what functions one kernel of a factory has that another has not.
    """

    def __init__(self, function: Callable[..., object], key: str) -> None:
        super().__init__(function)
        self._source_key = key

    def _index_key(self, sig: Signature, codegen: JITCPUCodegen) -> tuple[object, ...]:
        return sig, codegen.magic_tuple(), self._source_key

    def load_overload(self, sig: Signature, target_context: BaseContext) -> object:
        """What is kept for arguments of these types, or ``None``."""
        self.kept()
        return super().load_overload(sig, target_context)

    def kept(self) -> tuple[tuple[object, ...], ...]:
        """Keys of all that is kept; none, from then on, where another version kept what this one cannot read."""
        try:
            return tuple(self._cache_file._load_index())
        except (ImportError, AttributeError):
            self.flush()
            return ()


def cached_kernel(key: str, variant: str = "", **options: Any) -> Callable[[Callable[P, R_co]], Kernel[P, R_co]]:
    """Decorator: compile with numba on first call, and keep the result on disk under ``key``.

    The kernels of a factory need a ``variant`` each, which names their files: processes that compile two of them at the
    same time would otherwise write to the same ones, and one might be loaded for the other.

    Where neither the package's folder nor the user's cache folder can be written, kernels are compiled anew in every
    process; set ``NUMBA_CACHE_DIR`` to a folder that can.
    """

    def decorate(function: Callable[P, R_co]) -> Kernel[P, R_co]:
        function.__qualname__ += variant and f"_{variant}"
        dispatcher = numba.njit(nogil=True, **options)(function)
        with suppress(RuntimeError):
            dispatcher._cache = _SourceKeyedCache(function, key)
        return dispatcher

    return decorate


def has_to_be_compiled(kernel: Kernel[..., object]) -> bool:
    """Whether a kernel of :func:`cached_kernel` could be kept on disk and has not been yet, as its sources are now."""
    cache = getattr(kernel, "_cache", None)
    if not isinstance(cache, _SourceKeyedCache):
        return False
    return not any(key[-1] == cache._source_key for key in cache.kept())
