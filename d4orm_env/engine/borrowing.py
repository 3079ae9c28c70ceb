"""Structs of arrays by reference, so that they are one argument of a kernel, and of what it hands them on to.

By value each is hundreds of numbers, to be taken apart and put together at every call: a third of all that is compiled.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

from llvmlite import ir
from llvmlite.ir import IRBuilder, Value
from numba import typeof
from numba.core import cgutils, types
from numba.core.base import BaseContext
from numba.core.datamodel.manager import DataModelManager
from numba.core.imputils import impl_ret_borrowed
from numba.core.pythonapi import NativeValue
from numba.core.typing.context import BaseContext as TypingContext
from numba.core.typing.templates import AttributeTemplate, Signature, infer_getattr
from numba.extending import box, lower_getattr_generic, models, register_model, unbox

from d4orm_env.engine.simd import Instructions, intrinsic

S = TypeVar("S", bound=tuple[Any, ...])
Struct: TypeAlias = types.NamedTuple | types.NamedUniTuple
"""numba's type of a named tuple."""


class _Borrowed(types.Type):
    """A named tuple in memory that the caller keeps."""

    def __init__(self, struct: Struct) -> None:
        self.struct = struct
        # Short, because it becomes part of the names of all functions that take it. Two that differ must have names
        # that do: kernels of several processes are loaded into one, and numba numbers functions by process.
        digest = hashlib.sha256(struct.name.encode()).hexdigest()[:8]
        super().__init__(name=f"Borrowed{struct.instance_class.__name__}{digest}")

    @property
    def key(self) -> Struct:
        """The struct, by which two of these types are the same."""
        return self.struct

    def field(self, name: str) -> types.Type | None:
        """Type of a field, or ``None`` if there is none of this name."""
        if name not in self.struct.fields:
            return None
        return by_reference(self.struct.types[self.struct.fields.index(name)])


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


@unbox(_Borrowed)
def _unbox(kind: _Borrowed, value: Value, c: Any) -> NativeValue:
    address = cgutils.alloca_once(c.builder, c.context.get_value_type(kind.struct))
    _fill(kind.struct, value, address, c)
    return NativeValue(address)


@box(_Borrowed)
def _refuse(kind: _Borrowed, address: Value, c: Any) -> Value:
    raise TypeError("a kernel returns a struct that it was given; return its fields that are new")


def _fill(struct: Struct, value: Value, address: Value, c: Any) -> None:
    """Fill a struct from a named tuple of these types, whose arrays the caller keeps alive."""
    array = ir.FunctionType(ir.IntType(32), [c.pyapi.pyobj, c.pyapi.voidptr])
    for i, kind in enumerate(struct.types):
        item, field = c.pyapi.tuple_getitem(value, i), cgutils.gep_inbounds(c.builder, address, 0, i)
        if isinstance(kind, Struct):
            _fill(kind, item, field, c)
        elif isinstance(kind, types.Array):
            adapt = cgutils.get_or_insert_function(c.builder.module, array, "numba_adapt_ndarray")
            c.builder.call(adapt, (item, c.builder.bitcast(field, c.pyapi.voidptr)))
        else:
            c.builder.store(c.unbox(kind, item).value, field)


def by_reference(kind: types.Type) -> types.Type:
    """The type by which a kernel takes an argument: named tuples of arrays by reference."""
    if isinstance(kind, Struct) and any(isinstance(part, types.Array | Struct) for part in kind.types):
        return _Borrowed(kind)
    return kind


@intrinsic
def _borrow(typing_context: TypingContext, struct: _Borrowed) -> Instructions:
    def generate(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]) -> Value:
        kind = context.get_value_type(struct.struct)
        address, size = cgutils.alloca_once(builder, kind), context.get_abi_sizeof(kind)
        cgutils.raw_memcpy(builder, address, arguments[0], ir.Constant(ir.IntType(64), size), 1)
        return address

    return struct(struct), generate


borrow: Callable[[S], S] = _borrow
"""A kernel's own copy of an argument, a named tuple, but for its arrays.

Without it the optimiser must expect every store to change the struct: hot loops take up to a tenth longer.
"""


def borrowed(struct: tuple[Any, ...]) -> _Borrowed:
    """The type of a named tuple by reference."""
    return _Borrowed(typeof(struct))
