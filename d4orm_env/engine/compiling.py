"""Compilation of kernels, and of the plain Python functions of the physics that they may call."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any, Protocol, TypeVar

import numba
import numpy as np
from numba.cpython.unsafe import numbers
from numba.extending import register_jitable
from numba.np.unsafe import ndarray

from d4orm_env.core import winding
from d4orm_env.core.arrays import FloatArray
from d4orm_env.dynamics import collision, formulas, robot_model, transition
from d4orm_env.engine.compilers import PartCompiler

ZERO = np.float32(0)
ONE = np.float32(1)
F = TypeVar("F", bound=Callable[..., object])


class Compiler(Protocol):
    """A decorator that compiles a function, which otherwise stays what it is."""

    def __call__(self, function: F, /) -> F: ...


OPTIONS: dict[str, Any] = {"error_model": "numpy"}
"""No fast mathematics: only what IEEE 754 defines to the bit, in the order in which it is written. Multiply-adds do not
fuse, sums are not regrouped, nothing is estimated; so a kernel gives the same bits on every processor, however wide its
registers. What it costs is measured in docs/background/performance.md."""

WITHOUT_ARRAYS: dict[str, Any] = OPTIONS | {"_nrt": False}
"""Options for kernels that make no arrays: without numba's reference counts."""

UNCOUNTED = WITHOUT_ARRAYS | {
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "pipeline_class": PartCompiler,
}
"""Options for everything that kernels call: without numba's reference counts, which would cost more than the sums they
surround, and without what Python would call them by, which takes a fifth to a third of the time of compiling. Such
functions cannot make arrays, and a call from Python ends the process: tests call them from compiled functions."""
compiled: Compiler = numba.njit(nogil=True, **UNCOUNTED)

INLINED = UNCOUNTED | {"forceinline": True}
"""Options for functions that take functions (a model, ``Ops``): inlining leaves no function pointer, so that numba can
keep the kernels on disk. And for those that take a problem's arrays, which are a long argument to pass by value."""
inlined: Compiler = numba.njit(nogil=True, **INLINED)


def register(*modules: ModuleType) -> None:
    """Let compiled code call all functions of modules, which stay plain Python functions for all other callers."""
    for module in modules:
        for function in vars(module).values():
            if isinstance(function, FunctionType) and function.__module__ == module.__name__:
                register_jitable(**INLINED)(function)


register(formulas, robot_model, winding, transition, collision)

to_fixed_tuple: Callable[..., tuple[np.float32, ...]] = ndarray.to_fixed_tuple
"""Its calls in compiled code lack the first argument, which type checkers cannot know."""
trailing_zeros: Callable[..., int] = numbers.trailing_zeros
"""Number of the lowest bit that is set; likewise."""


@register_jitable(nogil=True, **OPTIONS)
def aligned_zeros(size: int) -> FloatArray:
    """A flat float32 array that begins with a cache line, so that no vector load touches two."""
    space = np.zeros(size + 16, np.float32)
    first = np.int64(-(space.ctypes.data // 4) % 16)
    return space[first : first + size]
