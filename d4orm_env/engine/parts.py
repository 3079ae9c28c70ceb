"""Compilation of functions that only kernels call: LLVM optimises them once, in the kernels.

By itself numba optimises every function by itself and makes machine code of it, then does all that again wherever it is
called, at every level of calls.
"""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class _PartLibrary(JITCodeLibrary):
    """Code of a function, to be linked into that of kernels and optimised there."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return null: there is no machine code."""
        return 0

    @property
    def codegen(self) -> Any:
        """Return a stand-in: the compiler would tell machine code its environment."""
        return _NoMachineCode


class _NoMachineCode:
    @staticmethod
    def set_env(env_name: str, env: object) -> None:
        pass


class PartCompiler(Compiler):
    """numba's compiler, with such libraries."""

    def define_pipelines(self) -> Any:
        self.state.library = _PartLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return Compiler.define_pipelines(self)
