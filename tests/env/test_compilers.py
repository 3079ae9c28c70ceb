"""numba's compiler for kernels: what becomes machine code, and that other functions are compiled as ever."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from llvmlite.binding import Linkage, ModuleRef
from numba.core import compiler, event, ir, utils
from numba.core.codegen import JITCodeLibrary
from numba.core.errors import TypingError
from numba.core.lowering import Lower
from numba.core.postproc import PostProcessor
from numba.core.registry import cpu_target
from numba.core.targetconfig import TargetConfig

from d4orm_env.core.arrays import FloatArray
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, UNCOUNTED, compiled


@numba.njit
def _double(x: float) -> float:
    return 2 * x


@compiled
def _square(x: float) -> float:
    def times(y: float) -> float:
        return x * y

    return times(x)


@compiled
def _fourth_power(x: float) -> float:
    return _square(_square(x))


@numba.njit(**UNCOUNTED | {"_dbg_optnone": True})
def _apart(x: float) -> float:
    return _fourth_power(x)


def _joined(x: float) -> FloatArray:
    values = np.zeros(2)
    values[0], values[1] = max(_double(x), _square(x)), _fourth_power(x)
    return np.concatenate((values, values))


def _numbas() -> list[object]:
    target = cpu_target.target_context
    return [
        compiler.Compiler.define_pipelines, event.start_event, ir.Inst._rec_list_vars, PostProcessor.run,
        utils.order_by_target_specificity, TargetConfig.__eq__, TargetConfig.__hash__,
        JITCodeLibrary.add_linking_library,
        *sorted(vars(target)), *sorted(vars(target.typing_context)),
    ]  # fmt: skip


def _kernel() -> Any:
    kernel: Any = cached_kernel(**OPTIONS)(_joined)
    kernel._cache = numba.core.caching.NullCache()
    return kernel


def test_parts_of_different_kernels_have_different_names(monkeypatch: pytest.MonkeyPatch) -> None:
    # In a process that loads both from disk, one would be called for the other.
    names: list[set[str]] = []
    finalize = JITCodeLibrary._finalize_specific

    def note(library: JITCodeLibrary) -> None:
        functions = [function for function in library._final_module.functions if not function.is_declaration]
        names.append({function.name for function in functions if function.linkage == Linkage.linkonce_odr})
        finalize(library)

    monkeypatch.setattr(JITCodeLibrary, "_finalize_specific", note)
    for variant in ("once", "twice"):
        kernel: Any = cached_kernel(variant=variant, **OPTIONS)(lambda x: _apart(x) + _apart(x + 1))
        kernel._cache = numba.core.caching.NullCache()
        kernel(2.0)
    first, second = filter(None, names)
    assert not first & second


def test_machine_code_is_made_of_kernels_and_of_what_python_can_call(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    finalize = JITCodeLibrary._finalize_specific
    monkeypatch.setattr(JITCodeLibrary, "_finalize_specific", lambda self: (made.append(self.name), finalize(self))[1])
    assert _kernel()(3.0).tolist() == [9, 81, 9, 81]
    # Of numba's own functions, as those for zeros, is none.
    assert [name for name in made if name != "nrt"] == ["_double", "_joined"]
    assert _double(3.0) == 6


def test_parts_are_linked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    linked: list[str] = []
    link = ModuleRef.link_in

    def note(self: ModuleRef, other: ModuleRef, preserve: bool = False) -> None:
        if preserve:  # it stays there for others
            linked.append(other.name)
        link(self, other, preserve)

    monkeypatch.setattr(ModuleRef, "link_in", note)
    inner = compiled(lambda x: x * x)
    outer = compiled(lambda x: inner(inner(x)))
    kernel: Any = cached_kernel(**OPTIONS)(lambda x: outer(x) + inner(x))
    kernel._cache = numba.core.caching.NullCache()
    assert kernel(3.0) == 90
    assert len([name for name in linked if "lambda" in name]) == 2


def test_no_variable_ends_where_nothing_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: set[str] = set()
    end = Lower.delvar

    def note(self: Lower, name: str) -> None:
        ended.add(self.func_ir.func_id.func_name)
        end(self, name)

    monkeypatch.setattr(Lower, "delvar", note)
    _kernel()(3.0)
    assert "_joined" in ended
    assert not ended & {"_square", "_fourth_power"}


def test_other_functions_are_compiled_as_ever_afterwards() -> None:
    before = _numbas()
    kernel: Any = cached_kernel(**OPTIONS)(lambda x: x.missing)
    kernel._cache = numba.core.caching.NullCache()
    with pytest.raises(TypingError):
        kernel(1.0)
    assert _numbas() == before
    assert numba.njit(_joined)(3.0).tolist() == [9, 81, 9, 81]
