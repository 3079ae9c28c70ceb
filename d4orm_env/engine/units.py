"""Units: kernels that other kernels call by their addresses, each compiled by itself, in two processes at once.

What a kernel calls otherwise becomes part of it, and is compiled again for each that does.
"""

from __future__ import annotations

import hashlib
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any, TypeAlias

from llvmlite.ir import Constant, IntType
from numba.core import types

from d4orm_env.engine.caching import is_kept
from d4orm_env.engine.compiling import WITHOUT_ARRAYS
from d4orm_env.engine.simd import ANY, Writer, instructions
from d4orm_env.engine.threads import available_cores

CONTACTS, OBSTACLES, OBSERVATION, SEEN_OBSTACLES, ROBOTS = range(5)
"""Rows of the addresses that kernels of worlds get; those of the robots' models come last."""
Types: TypeAlias = tuple[types.Type, ...]
"""Types of a kernel's arguments."""
Path: TypeAlias = tuple[str, ...]
"""Place of a kernel: its module and name, or those of the function that makes it and the arguments of that."""
Call: TypeAlias = tuple[Path, Types]
"""A kernel, and what it is called with."""


UNIT: dict[str, Any] = WITHOUT_ARRAYS | {"no_cpython_wrapper": True}
"""Options for units; structs by reference are none of Python's business."""


def address_of(path: Path, kinds: Types) -> tuple[int, int]:
    """Address of a unit's machine code, which is compiled if need be, and a digest of the types."""
    unit = kernel_of(path)
    unit.compile(kinds)
    made = unit.overloads[kinds]
    return made.library.get_pointer_to_function(made.fndesc.llvm_func_name), _digest(kinds)


def _digest(kinds: Sequence[types.Type]) -> int:
    """A number that tells types of arguments apart, within 63 bits."""
    return int.from_bytes(hashlib.sha256(repr([str(kind) for kind in kinds]).encode()).digest()[:8], "big") >> 1


def caller(count: int) -> Callable[..., None]:
    """``call(address, *arguments)`` in compiled code for units of so many arguments.

    ``address`` is an array of the two numbers of :func:`address_of`.
    """

    @instructions(types.void, *[ANY] * (1 + count))
    def call(writer: Writer) -> None:
        context: Any = writer.context
        builder, kinds, convention = writer.builder, writer.signature.args[1:], context.call_conv
        where, digest = (builder.load(writer.address(0, Constant(IntType(64), i))) for i in range(2))
        with builder.if_then(builder.icmp_unsigned("!=", digest, Constant(digest.type, _digest(kinds))), False):
            convention.return_user_exc(builder, TypeError, ("a unit is compiled for other types of arguments",))
        function = builder.inttoptr(where, convention.get_function_type(types.void, kinds).as_pointer())
        convention.call_function(builder, function, types.void, kinds, writer.arguments[1:])

    return call


def path_of(function: Any, *arguments: str) -> Path:
    """The path of a kernel, or of one that a function makes."""
    return function.__module__, function.__name__, *arguments


def kernel_of(path: Path) -> Any:
    """The kernel there."""
    module, name, *arguments = path
    found = getattr(import_module(module), name)
    return found(*arguments) if arguments else found


def compile_together(calls: Sequence[Call]) -> None:
    """Compile kernels unless they are on disk already; if several are missing, another process begins at the end."""
    missing = [(path, kinds) for path, kinds in calls if not is_kept(kernel_of(path), kinds)]
    if len(missing) < 2 or available_cores() < 2 or not sys.executable:
        return
    # What fails there, as with a model that was registered here, is compiled here.
    with suppress(OSError), another_process(__name__, "compile_given()", stdin=subprocess.PIPE) as other:
        if other.stdin is not None:
            with other.stdin as pipe:
                pickle.dump(missing[::-1], pipe)
        for path, kinds in missing:
            kernel_of(path).compile(kinds)


def another_process(module: str, calls: str, **pipes: Any) -> subprocess.Popen[bytes]:
    """Start a process that calls functions of a module.

    It exits at once: Python would look through numba's objects for garbage, for a third of a second.
    """
    command = f"import os; from {module} import *; {calls}; os._exit(0)"
    return subprocess.Popen([sys.executable, "-c", command], stderr=subprocess.DEVNULL, **pipes)


def compile_given() -> None:
    """Compile kernels that another process names."""
    for path, kinds in pickle.load(sys.stdin.buffer):
        kernel_of(path).compile(kinds)
