"""Parts that a function of a robot model is made of: its code, and the constants and functions that it names."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from types import CodeType, FunctionType
from typing import Any


def pieces(function: Any, seen: frozenset[FunctionType] = frozenset()) -> Iterator[object]:
    """Source text or bytecode, and the numbers that the code holds or names, through all functions that it calls."""
    code = function.__code__
    yield _text(function)
    yield from _numbers(code)
    cells = zip(code.co_freevars, (cell.cell_contents for cell in function.__closure__ or ()), strict=True)
    named = {name: function.__globals__[name] for name in code.co_names if name in function.__globals__} | dict(cells)
    for name, value in sorted(named.items()):
        if isinstance(value, FunctionType) and value not in seen:
            yield from pieces(value, seen | {function})
        elif isinstance(value, float | int | str | tuple):
            yield name
            yield value


def _text(function: FunctionType) -> str:
    try:
        return inspect.getsource(function)
    except (OSError, TypeError):  # defined where there is no file
        return f"{function.__code__.co_code.hex()} {function.__code__.co_names}"


def _numbers(code: CodeType) -> Iterator[object]:
    return (value for value in code.co_consts if isinstance(value, float | int | tuple))
