"""Units: kernels that others call by their addresses."""

from __future__ import annotations

import io
import pickle
import subprocess
import sys
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numba
import numpy as np
import pytest

from d4orm_env.core.arrays import Floats, IntArray
from d4orm_env.engine import units
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS
from d4orm_env.engine.tiles import robot_unit
from d4orm_env.engine.units import UNIT, address_of, caller, compile_together, kernel_of, path_of

KINDS = numba.float64[::1], numba.float64
call_add = caller(2)


@cached_kernel(**UNIT)
def add(values: Floats, amount: float) -> None:
    values[0] += amount


@cached_kernel(**UNIT)
def subtract(values: Floats, amount: float) -> None:
    values[0] -= amount


@cached_kernel(**WITHOUT_ARRAYS)
def add_twice(values: Floats, amount: float, address: IntArray) -> None:
    call_add(address, values, amount)
    call_add(address, values, amount)


def test_a_kernel_calls_whichever_unit_it_is_given() -> None:
    values = np.zeros(1)
    add_twice(values, 2.5, np.array(address_of(path_of(add), KINDS)))
    assert values == 5
    add_twice(values, 2.0, np.array(address_of(path_of(subtract), KINDS)))
    assert values == 1


def test_a_unit_that_is_compiled_for_other_types_is_not_called() -> None:
    address, values = np.array(address_of(path_of(add), KINDS)), np.zeros(1, np.float32)
    with pytest.raises(TypeError, match="a unit is compiled for other types of arguments"):
        add_twice(values, 2.5, address)
    assert values == 0


def compiled_here_and_there(monkeypatch: pytest.MonkeyPatch, kept: set[str], cores: int) -> tuple[list[str], list[str]]:
    """Names of the kernels, of ``abc``, that are compiled here and in another process, in order."""
    here: list[str] = []
    there: list[str] = []

    def kernel(path: tuple[str, ...]) -> Any:
        return SimpleNamespace(name=path[0], compile=lambda kinds: here.append(path[0]))

    class Pipe(io.BytesIO):
        def close(self) -> None:
            there.extend(path[0] for path, _ in pickle.loads(self.getvalue()))

    process = MagicMock()
    process.return_value.__enter__.return_value.stdin = Pipe()
    monkeypatch.setattr(units, "kernel_of", kernel)
    monkeypatch.setattr(units, "is_kept", lambda kernel, kinds: kernel.name in kept)
    monkeypatch.setattr(units, "available_cores", lambda: cores)
    monkeypatch.setattr(subprocess, "Popen", process)
    compile_together([((name,), KINDS) for name in "abc"])
    return here, there


def test_another_process_compiles_what_is_missing_from_the_end_on(monkeypatch: pytest.MonkeyPatch) -> None:
    assert compiled_here_and_there(monkeypatch, {"b"}, 2) == (["a", "c"], ["c", "a"])
    # Kernels are compiled when they are called, too.
    assert compiled_here_and_there(monkeypatch, {"a", "b"}, 2) == ([], [])
    assert compiled_here_and_there(monkeypatch, set(), 1) == ([], [])


def test_another_process_finds_the_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    given = pickle.dumps([(path_of(subtract), KINDS)])
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(given)))
    units.compile_given()
    assert KINDS in subtract.signatures
    assert kernel_of(path_of(robot_unit, "velocity2d")) is robot_unit("velocity2d")
