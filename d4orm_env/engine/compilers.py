"""numba's compiler for kernels, and for what they call: without what only Python needs and what it does over and over.

Two thirds of its time are spent in Python.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from types import CodeType
from typing import Any, TypeAlias

from llvmlite.binding import Linkage
from llvmlite.ir import Type
from numba.core import compiler, event, ir, typed_passes, types, untyped_passes, utils
from numba.core.codegen import JITCodeLibrary
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.registry import cpu_target
from numba.core.targetconfig import TargetConfig
from numba.core.transforms import canonicalize_cfg

from d4orm_env.engine.borrowing import by_reference


class _PartLibrary(JITCodeLibrary):
    """Code of a function that only kernels call, to be linked into theirs and optimised there.

    By itself numba optimises every function by itself and makes machine code of it, then does all that again wherever
    it is called, at every level of calls.
    """

    def _optimize_functions(self, ll_module: Any) -> None:
        # The kernel's optimisation will do the rest.
        ll_module.data_layout = self._codegen._data_layout
        for function in ll_module.functions:
            if not function.is_declaration:
                manager, builder = self._codegen._function_pass_manager(opt=1)
                manager.run(function, builder)

    def add_linking_library(self, library: JITCodeLibrary) -> None:
        """Note what is called, and what that calls."""
        _link(self, library)

    def finalize(self) -> None:
        """Let every kernel that it is linked into have a copy."""
        self._raise_if_finalized()
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == Linkage.external:
                function.linkage = "linkonce_odr"
        self._finalize_dynamic_globals()
        self._finalized = True

    def _get_module_for_linking(self) -> Any:
        # With all that it calls, for code that numba compiles as it does by itself.
        if self._shared_module is None:
            module = self._final_module.clone()
            for library in self._linking_libraries:
                module.link_in(_own_module(library), preserve=True)
            self._shared_module = module
        return self._shared_module

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


def _link(caller: JITCodeLibrary, library: JITCodeLibrary) -> None:
    """Link a library into another, and the parts that it consists of, all of them once."""
    library._ensure_finalized()
    others = library._linking_libraries if isinstance(library, _PartLibrary) else []
    caller._linking_libraries = list(dict.fromkeys([*caller._linking_libraries, library, *others]))


def _own_module(library: JITCodeLibrary) -> Any:
    return library._final_module if isinstance(library, _PartLibrary) else library._get_module_for_linking()


_IDLE = {
    untyped_passes.WithLifting,
    untyped_passes.InlineClosureLikes,
    untyped_passes.FindLiterallyCalls,
    untyped_passes.LiteralUnroll,
    untyped_passes.LiteralPropagationSubPipelinePass,
    typed_passes.InlineOverloads,
    typed_passes.NopythonRewrites,
    typed_passes.DumpParforDiagnostics,
}
"""Passes that kernels' functions have no use for, unless another is defined within one."""


_UNCOUNTED = {typed_passes.IRLegalization}
"""Passes that functions without reference counts have no use for: it says where variables end."""


class PartCompiler(compiler.Compiler):
    """numba's compiler for functions that only kernels call."""

    def define_pipelines(self) -> Any:
        self.state.library = _part(self.state)
        managers, constants = super().define_pipelines(), self.state.func_id.code.co_consts
        idle = _UNCOUNTED if any(isinstance(constant, CodeType) for constant in constants) else _UNCOUNTED | _IDLE
        for manager in managers:
            manager.passes = [(step, name) for step, name in manager.passes if step not in idle]
            manager.finalize()
        return managers


class KernelCompiler(compiler.Compiler):
    """numba's compiler for a kernel."""

    def compile_extra(self, func: Callable[..., object]) -> Any:
        """Compile a kernel, which takes structs by reference from Python; its signature says nothing of it."""
        kinds = self.state.args
        if not self.state.flags.no_cpython_wrapper:
            self.state.args = tuple(map(by_reference, kinds))
        with _replaced(*_parts_of_numba(), *_done_once(), *_done_sooner()):
            made = super().compile_extra(func)
        return made._replace(signature=made.signature.replace(args=kinds))


Replacement: TypeAlias = tuple[Any, str, object]
"""An object, class or module, the name of an attribute of it, and what takes its place."""


def _part(state: Any) -> _PartLibrary:
    return _PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)


@contextmanager
def _replaced(*replacements: Replacement) -> Iterator[None]:
    """Replace attributes while a kernel is compiled under numba's lock."""
    before = [(owner, name, vars(owner).get(name, _replaced)) for owner, name, _ in replacements]
    for owner, name, value in replacements:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in before:
            if value is _replaced:
                delattr(owner, name)
            else:
                setattr(owner, name, value)


def _parts_of_numba() -> list[Replacement]:
    """Replacements by which numba's own functions, which Python cannot call either, are parts of kernels."""
    target = cpu_target.target_context
    define, wrap = compiler.Compiler.define_pipelines, target.create_cfunc_wrapper
    optimize = JITCodeLibrary._optimize_final_module

    def define_part(self: compiler.Compiler) -> Any:
        if self.state.flags.no_cpython_wrapper and not isinstance(self, KernelCompiler | PartCompiler):
            self.state.library = _part(self.state)
        return define(self)

    def wrap_unless_part(library: JITCodeLibrary, *function: object) -> None:
        if not isinstance(library, _PartLibrary):
            wrap(library, *function)

    def optimize_own(library: JITCodeLibrary) -> None:
        # Kernels of several processes are loaded into one, where the linker takes parts of one name for the same; and
        # numba numbers functions by process.
        functions = [function for function in library._final_module.functions if not function.is_declaration]
        names = sorted(function.name for function in functions if function.linkage == Linkage.external)
        mark = hashlib.sha256("".join(names).encode()).hexdigest()[:16]
        for function in functions:
            if function.linkage == Linkage.linkonce_odr:
                function.name += f".{mark}"
        optimize(library)

    return [
        (JITCodeLibrary, "_optimize_final_module", optimize_own),
        (compiler.Compiler, "define_pipelines", define_part),
        (target, "create_cfunc_wrapper", wrap_unless_part),
        (JITCodeLibrary, "add_linking_library", _link),
        (_PartLibrary, "_get_module_for_linking", _own_module),
    ]


def _done_once() -> list[Replacement]:
    """Replacements by which numba does once what it does again and again, and not at all what nobody waits for."""
    from numba.core.typing.npydecl import NumpyRulesArrayOperator  # only compiling has a use for it

    target = cpu_target.target_context
    target.refresh()
    first = next(iter(target._registries))  # where numba registers intrinsics as it meets them
    list_vars, find_rule = ir.Inst._rec_list_vars, NumpyRulesArrayOperator.generic

    def list_vars_sooner(instruction: ir.Inst, value: object) -> Any:
        return () if type(value) in _NO_VARS else list_vars(instruction, value)

    def find_rule_of_arrays(template: Any, args: tuple[types.Type, ...], kws: object) -> Any:
        has_arrays = any(isinstance(kind, (types.ArrayCompatible, types.Optional)) for kind in args)
        return find_rule(template, args, kws) if has_arrays else None

    @cache
    def abi_sizeof(kind: Type) -> int:
        return int(kind.get_abi_size(target.target_data))

    return [
        (target, "load_additional_registries", partial(target.install_registry, first)),
        (target.typing_context, "load_additional_registries", _do_nothing),
        (target, "get_abi_sizeof", abi_sizeof),
        (event, "start_event", _do_nothing),
        (event, "end_event", _do_nothing),
        (ir.Inst, "_rec_list_vars", list_vars_sooner),
        (NumpyRulesArrayOperator, "generic", find_rule_of_arrays),
    ]


def _done_sooner() -> list[Replacement]:
    """Replacements by which numba does in less time what it does for every function."""
    process, order = PostProcessor.run, utils.order_by_target_specificity
    order_once = cache(lambda target, templates, fnkey: order(target, list(templates), fnkey=fnkey))

    def order_sooner(target: Any, templates: list[type], fnkey: object = "") -> Any:
        return order_once(target, tuple(templates), fnkey)

    def is_same_config(self: TargetConfig, other: TargetConfig) -> bool:
        if self is other or type(self) is not type(other):
            return self is other
        names = self._values.keys() | other._values.keys()
        return all(getattr(self, name) == getattr(other, name) for name in names)

    def process_sooner(self: PostProcessor, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        if self.func_ir.is_generator:
            process(self, emit_dels, extend_lifetimes)
            return
        # Which variables live where is found out when it is asked for.
        self.func_ir.blocks = canonicalize_cfg(self.func_ir.blocks)
        self.func_ir.generator_info, self.func_ir.variable_lifetime = None, VariableLifetime(self.func_ir.blocks)
        if emit_dels:
            self._insert_var_dels(extend_lifetimes=extend_lifetimes)

    return [
        (PostProcessor, "run", process_sooner),
        (utils, "order_by_target_specificity", order_sooner),
        (TargetConfig, "__eq__", is_same_config),
        (TargetConfig, "__hash__", lambda self: hash(type(self))),
    ]


_NO_VARS = {ir.Loc, str, int, float, bool, type(None)}


def _do_nothing(*args: object, **kwargs: object) -> None:
    pass
