"""numba's compiler for kernels: what becomes machine code, and that other functions are compiled as ever."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from numba.core import compiler, event, ir
from numba.core.codegen import JITCodeLibrary
from numba.core.errors import TypingError
from numba.core.registry import cpu_target

from d4orm_env.core.arrays import FloatArray
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled


@numba.njit
def _double(x: float) -> float:
    return 2 * x


@compiled
def _square(x: float) -> float:
    def times(y: float) -> float:
        return x * y

    return times(x)


def _joined(x: float) -> FloatArray:
    values = np.zeros(2)
    values[0] = max(_double(x), _square(x))
    return np.concatenate((values, values))


def _numbas() -> list[object]:
    target = cpu_target.target_context
    return [
        compiler.Compiler.define_pipelines, event.start_event, ir.Inst._rec_list_vars,
        *sorted(vars(target)), *sorted(vars(target.typing_context)),
    ]  # fmt: skip


def test_machine_code_is_made_of_kernels_and_of_what_python_can_call(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    finalize = JITCodeLibrary._finalize_specific
    monkeypatch.setattr(JITCodeLibrary, "_finalize_specific", lambda self: (made.append(self.name), finalize(self))[1])
    kernel: Any = cached_kernel(**OPTIONS)(_joined)
    kernel._cache = numba.core.caching.NullCache()
    assert kernel(3.0).tolist() == [9, 0, 9, 0]
    # Of numba's own functions, as those for zeros, is none.
    assert [name for name in made if name != "nrt"] == ["_double", "_joined"]
    assert _double(3.0) == 6


def test_other_functions_are_compiled_as_ever_afterwards() -> None:
    before = _numbas()
    kernel: Any = cached_kernel(**OPTIONS)(lambda x: x.missing)
    kernel._cache = numba.core.caching.NullCache()
    with pytest.raises(TypingError):
        kernel(1.0)
    assert _numbas() == before
    assert numba.njit(_joined)(3.0).tolist() == [9, 0, 9, 0]
