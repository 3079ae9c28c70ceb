"""Structs of arrays handed on by reference, so that they are one argument of a compiled function.

By value each is hundreds of numbers, to be taken apart and put together at every call: a third of all that is compiled.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, TypeVar

from llvmlite import ir
from llvmlite.ir import IRBuilder, Value
from numba import typeof
from numba.core import cgutils, types
from numba.core.base import BaseContext
from numba.core.datamodel.manager import DataModelManager
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.context import BaseContext as TypingContext
from numba.core.typing.templates import AttributeTemplate, Signature, infer_getattr
from numba.extending import lower_getattr_generic, models, register_model

from d4orm_env.engine.simd import Instructions, intrinsic

S = TypeVar("S", bound=tuple[Any, ...])


class _Borrowed(types.Type):
    """A named tuple in memory that the caller keeps."""

    def __init__(self, struct: types.NamedTuple) -> None:
        self.struct = struct
        # Short, because it becomes part of the names of all functions that take it. Two that differ must have names
        # that do: kernels of several processes are loaded into one, and numba numbers functions by process.
        digest = hashlib.sha256(struct.name.encode()).hexdigest()[:8]
        super().__init__(name=f"Borrowed{struct.instance_class.__name__}{digest}")

    @property
    def key(self) -> types.NamedTuple:
        """The struct, by which two of these types are the same."""
        return self.struct

    def field(self, name: str) -> types.Type | None:
        """Type of a field, or ``None`` if there is none of this name."""
        if name not in self.struct.fields:
            return None
        kind = self.struct.types[self.struct.fields.index(name)]
        return _Borrowed(kind) if isinstance(kind, types.NamedTuple) else kind


@register_model(_Borrowed)
class _BorrowedModel(models.PrimitiveModel):
    def __init__(self, manager: DataModelManager, kind: _Borrowed) -> None:
        address = manager.lookup(kind.struct).get_value_type().as_pointer()
        super().__init__(manager, kind, address)  # type: ignore[no-untyped-call]


@infer_getattr
class _Fields(AttributeTemplate):
    key = _Borrowed

    def generic_resolve(self, borrowed: _Borrowed, name: str) -> types.Type | None:  # type: ignore[override]
        return borrowed.field(name)


@lower_getattr_generic(_Borrowed)
def _read(context: BaseContext, builder: IRBuilder, borrowed: _Borrowed, address: Value, name: str) -> Value:
    kind = borrowed.field(name)
    field = cgutils.gep_inbounds(builder, address, 0, borrowed.struct.fields.index(name))
    return field if isinstance(kind, _Borrowed) else impl_ret_borrowed(context, builder, kind, builder.load(field))


def _store(builder: IRBuilder, struct: Value, address: Value) -> None:
    """Store field by field, which LLVM takes apart best."""
    for i, kind in enumerate(struct.type.elements):
        field, value = cgutils.gep_inbounds(builder, address, 0, i), builder.extract_value(struct, i)
        if isinstance(kind, ir.LiteralStructType):
            _store(builder, value, field)
        else:
            builder.store(value, field)


@intrinsic
def _borrow(typing_context: TypingContext, struct: types.NamedTuple) -> Instructions:
    def generate(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]) -> Value:
        address = cgutils.alloca_once(builder, arguments[0].type)
        _store(builder, arguments[0], address)
        return address

    return _Borrowed(struct)(struct), generate


borrow: Callable[[S], S] = _borrow
"""Hand on a kernel's own argument, a named tuple, by reference: its caller keeps the arrays alive."""


def borrowed(struct: tuple[Any, ...]) -> _Borrowed:
    """The type of a named tuple by reference."""
    return _Borrowed(typeof(struct))
