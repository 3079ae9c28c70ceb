"""The code that a function is made of: its own, that of all functions that it calls, and the constants they name."""

from __future__ import annotations

import dis
import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

FOREIGN = sys.stdlib_module_names | {"llvmlite", "numba", "numpy"}
"""Packages whose functions are not looked into; their versions are noted elsewhere."""


def source_text(function: FunctionType) -> object:
    """Source of a function, which stays the same from one version of Python to the next."""
    try:
        return inspect.getsource(function)
    except (OSError, TypeError):  # defined where there is no file
        return bytecode(function)


def bytecode(function: FunctionType) -> object:
    """Code of a function as Python has compiled it, which needs no file."""
    return [(code.co_code, code.co_names, code.co_varnames, _constants(code)) for code in _codes(function.__code__)]


def pieces(function: Any, content: Callable[[FunctionType], object] = source_text) -> Iterator[object]:
    """Yield the content of a function and of those that it calls, compiled ones too, and the constants that they name.

    The order depends on names only.
    """
    seen: set[FunctionType] = set()
    waiting = [function]
    while waiting:
        called = waiting.pop()
        function = _plain(called)
        if function is None or function in seen:
            continue
        seen.add(function)
        yield from (content(function), getattr(called, "targetoptions", None), *_constants(function.__code__))
        for name, value in sorted(_named(function).items()):
            for part in value if isinstance(value, tuple) else (value,):
                if isinstance(part, np.ndarray):
                    yield from (name, part.dtype.str, part.shape, part.tobytes())
                elif isinstance(part, float | int | str | tuple | np.generic):
                    yield from (name, part)
                elif isinstance(part, type):
                    yield from (name, getattr(part, "_fields", ()))
                else:
                    waiting.append(part)


def _plain(value: Any) -> FunctionType | None:
    """The Python function behind one that numba has compiled, or will; ``None`` where there is none to look into."""
    value = getattr(value, "py_func", getattr(value, "_defn", value))
    own = isinstance(value, FunctionType) and value.__module__.partition(".")[0] not in FOREIGN
    return value if own else None


def _named(function: FunctionType) -> Mapping[str, Any]:
    """Values of the names in a function's code and annotations, and of those in modules that it names."""
    names = {name for code in _codes(function.__code__) for name in code.co_names}
    names.update(*(re.findall(r"\w+", str(text)) for text in function.__annotations__.values()))
    named = {name: function.__globals__[name] for name in names if name in function.__globals__}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        if cell != _EMPTY:
            named[name] = cell.cell_contents
    for module in [value for value in named.values() if isinstance(value, ModuleType)]:
        if module.__name__.partition(".")[0] not in FOREIGN:
            named |= {f"{module.__name__}.{name}": vars(module)[name] for name in names if name in vars(module)}
    return named


_EMPTY = CellType()
"""Of a name that has no value yet."""


def check_formulas(owner: str, function: FunctionType) -> None:
    """Refuse a function with branches or loops, or that names a module or a function from outside the physics.

    Raises:
        ValueError: If it does; ``owner`` begins the message.
    """
    jumps = [step.opname for step in dis.get_instructions(function) if "JUMP" in step.opname and "IF" in step.opname]
    if jumps:
        raise ValueError(f"{owner} branches, as by 'if' or 'and'; engines compute many robots at once: use ops.where")
    if len(list(_codes(function.__code__))) > 1 or any(
        step.opname == "FOR_ITER" for step in dis.get_instructions(function)
    ):
        raise ValueError(f"{owner} has a loop or a function within; write its terms out")
    named = {step.argval for step in dis.get_instructions(function) if step.opname in ("LOAD_GLOBAL", "LOAD_DEREF")}
    for name, value in sorted(_named(function).items()):
        if name in named and isinstance(value, ModuleType):
            raise ValueError(f"{owner} names the module {name}; take mathematics from ops, as ops.cos")
        if name in named and callable(value) and not str(getattr(value, "__module__", "")).startswith("d4orm_env."):
            raise ValueError(f"{owner} names {name}, which engines cannot compile; write its formula into the function")


def with_strict_integers(function: FunctionType) -> FunctionType:
    """The function with whole numbers that it names, which widen what they meet, as they do once it is compiled."""
    whole = {name: np.int64(value) for name, value in _named(function).items() if type(value) is int}
    cells = tuple(
        CellType(whole.get(name, cell.cell_contents))
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or ())
    )
    defaults = tuple(np.int64(value) if type(value) is int else value for value in function.__defaults__ or ())
    return FunctionType(function.__code__, function.__globals__ | whole, function.__name__, defaults, cells)


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _constants(code: CodeType) -> list[object]:
    values = [constant for constant in code.co_consts if not isinstance(constant, CodeType)]
    return [sorted(map(repr, value)) if isinstance(value, frozenset) else value for value in values]
