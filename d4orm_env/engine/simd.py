"""All worlds of a tile at once, where loops over them would not do: as vector instructions written out.

What holds in some worlds only is a mask, one bit per world, lowest bit first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir
from llvmlite.ir import IRBuilder, Value
from numba import extending
from numba.core import types
from numba.core.base import BaseContext
from numba.core.types import Type
from numba.core.typing.context import BaseContext as TypingContext
from numba.core.typing.templates import Signature

from d4orm_env.core.arrays import FloatArray, Whole

Generator: TypeAlias = Callable[[BaseContext, IRBuilder, Signature, tuple[Value, ...]], Value]
"""Writer of a function's instructions."""
Instructions: TypeAlias = tuple[Signature, Generator]
"""A function as numba is told of it: its signature, and the writer of its instructions."""

intrinsic: Callable[[Callable[..., Instructions]], Callable[..., Any]] = extending.intrinsic
"""Decorator; compiled code calls the result with numbers and arrays instead of types, without the first argument."""

TILE = 64
"""Worlds per tile, as many as a mask has bits."""

CHUNK = 16
"""Worlds per instruction; where registers hold fewer, the compiler splits it."""

BLOCK = 4
"""Rows that :func:`enclose` takes at once."""

BOX = 2 * (TILE + CHUNK)
"""Numbers it makes of them."""

NOWHERE = np.uint64(0)
"""The mask of what holds in no world."""

_FLOATS = ir.VectorType(ir.FloatType(), CHUNK)
_BITS = ir.IntType(CHUNK)
_MASK = ir.IntType(TILE)


def _splat(builder: IRBuilder, value: Value) -> Value:
    lane = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), CHUNK), [0] * CHUNK)
    return builder.shuffle_vector(lane, ir.Constant(_FLOATS, ir.Undefined), order)


def _place(
    context: BaseContext, builder: IRBuilder, array_type: Type, array: Value, offset: Value, first: int
) -> Value:
    """The address of ``array[offset + first]`` as that of a vector."""
    data = context.make_array(array_type)(context, builder, array).data
    index = builder.add(offset, ir.Constant(offset.type, first))
    return builder.bitcast(builder.gep(data, [index], inbounds=True), _FLOATS.as_pointer())


def _load(context: BaseContext, builder: IRBuilder, array_type: Type, array: Value, offset: Value, first: int) -> Value:
    return builder.load(_place(context, builder, array_type, array, offset, first), align=4)


def _at_most(builder: IRBuilder, first: int, values: Value, bound: Value) -> Value:
    """The part of a mask that begins with world ``first``; not a number is not at most anything."""
    bits = builder.bitcast(builder.fcmp_ordered("<=", values, bound), _BITS)
    return builder.shl(builder.zext(bits, _MASK), ir.Constant(_MASK, first))


def _squared_gap(builder: IRBuilder, pairs: list[tuple[Value, Value]]) -> Value:
    total = None
    for a, b in pairs:
        gap = builder.fsub(a, b)
        square = builder.fmul(gap, gap)
        total = square if total is None else builder.fadd(total, square)
    return total


def _within(dimension: int, count: int) -> Callable[[FloatArray, Whole, Whole, np.float32], np.uint64]:
    """``(w, a, b, squared_reach) -> mask``: where the places in the rows from ``w[a]`` and ``w[b]`` on are near, in the
    first ``count`` worlds.
    """

    @intrinsic
    def within(typing_context: TypingContext, w: Type, a: Type, b: Type, squared_reach: Type) -> Instructions:
        def generate(
            context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]
        ) -> Value:
            array, offset_a, offset_b, reach = arguments
            bound = _splat(builder, reach)
            mask = ir.Constant(_MASK, 0)
            for first in range(0, count, CHUNK):
                pairs = [
                    tuple(
                        _load(context, builder, signature.args[0], array, offset, axis * TILE + first)
                        for offset in (offset_a, offset_b)
                    )
                    for axis in range(dimension)
                ]
                mask = builder.or_(mask, _at_most(builder, first, _squared_gap(builder, pairs), bound))
            return mask

        return types.uint64(w, types.int64, types.int64, types.float32), generate

    return within


within_2, within_3 = _within(2, TILE), _within(3, TILE)
chunk_within_2, chunk_within_3 = _within(2, CHUNK), _within(3, CHUNK)


@intrinsic
def enclose(
    typing_context: TypingContext, w: Type, first: Type, step: Type, widening: Type, boxes: Type, begin: Type
) -> Instructions:
    """Enclose the numbers of ``BLOCK`` rows, the first at ``w[first]`` and the others ``step`` numbers apart.

    From ``boxes[begin]`` on this fills a row of ``TILE`` lower ends, world by world, and one of upper ends,
    ``widening`` beyond the numbers; then rows of ``CHUNK`` ends, lane by lane: a lane encloses four worlds. What
    is not a number is left out.
    """

    def generate(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]) -> Value:
        array, offset, distance, extra, target, start = arguments
        offsets = [offset]
        for _ in range(1, BLOCK):
            offsets.append(builder.add(offsets[-1], distance))
        extra = _splat(builder, extra)
        for end, (comparison, sign) in enumerate((("<", 1), (">", -1))):
            beyond, ends = builder.fsub if end == 0 else builder.fadd, []
            for chunk in range(0, TILE, CHUNK):
                most = ir.Constant(_FLOATS, [sign * math.inf] * CHUNK)
                for row in offsets:
                    values = _load(context, builder, signature.args[0], array, row, chunk)
                    most = builder.select(builder.fcmp_ordered(comparison, values, most), values, most)
                ends.append(beyond(most, extra))
                place = _place(context, builder, signature.args[4], target, start, end * TILE + chunk)
                builder.store(ends[-1], place, align=4)
            most = ends[0]
            for other in ends[1:]:
                most = builder.select(builder.fcmp_ordered(comparison, other, most), other, most)
            place = _place(context, builder, signature.args[4], target, start, 2 * TILE + end * CHUNK)
            builder.store(most, place, align=4)
        return context.get_dummy_value()

    return types.void(w, types.int64, types.int64, types.float32, boxes, types.int64), generate


def _overlap(dimension: int, width: int, begin: int) -> Callable[[FloatArray, Whole, Whole], np.uint64]:
    """``(boxes, a, b) -> mask``: where the boxes from ``boxes[a]`` and ``boxes[b]`` on touch, of the worlds or of the
    lanes of :func:`enclose`.
    """

    @intrinsic
    def overlap(typing_context: TypingContext, boxes: Type, a: Type, b: Type) -> Instructions:
        def generate(
            context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]
        ) -> Value:
            array, offset_a, offset_b = arguments
            mask = ir.Constant(_MASK, 0)
            for first in range(0, width, CHUNK):
                touch = ir.Constant(ir.VectorType(ir.IntType(1), CHUNK), [1] * CHUNK)
                for axis in range(dimension):
                    for low, high in ((offset_a, offset_b), (offset_b, offset_a)):
                        row = axis * BOX + begin + first
                        lower = _load(context, builder, signature.args[0], array, low, row)
                        upper = _load(context, builder, signature.args[0], array, high, row + width)
                        touch = builder.and_(touch, builder.fcmp_ordered("<=", lower, upper))
                bits = builder.zext(builder.bitcast(touch, _BITS), _MASK)
                mask = builder.or_(mask, builder.shl(bits, ir.Constant(_MASK, first)))
            return mask

        return types.uint64(boxes, types.int64, types.int64), generate

    return overlap


def _meets(dimension: int) -> Callable[[FloatArray, Whole, FloatArray, Whole], bool]:
    """``(boxes, a, limits, b) -> bool``: whether in any lane the boxes from ``boxes[a]`` on touch one more box, whose
    lower and upper end along the first axis, and then along the others, are the numbers from ``limits[b]`` on.
    """

    @intrinsic
    def meets(typing_context: TypingContext, boxes: Type, a: Type, limits: Type, b: Type) -> Instructions:
        def generate(
            context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]
        ) -> Value:
            array, offset, others, first = arguments
            data = context.make_array(signature.args[2])(context, builder, others).data
            touch = ir.Constant(ir.VectorType(ir.IntType(1), CHUNK), [1] * CHUNK)
            for axis in range(dimension):
                low, high = (
                    _splat(builder, builder.load(builder.gep(data, [builder.add(first, ir.Constant(first.type, i))])))
                    for i in (2 * axis, 2 * axis + 1)
                )
                row = axis * BOX + 2 * TILE
                lower = _load(context, builder, signature.args[0], array, offset, row)
                upper = _load(context, builder, signature.args[0], array, offset, row + CHUNK)
                touch = builder.and_(touch, builder.fcmp_ordered("<=", lower, high))
                touch = builder.and_(touch, builder.fcmp_ordered("<=", low, upper))
            return builder.icmp_unsigned("!=", builder.bitcast(touch, _BITS), ir.Constant(_BITS, 0))

        return types.boolean(boxes, types.int64, limits, types.int64), generate

    return meets


worlds_overlap_2, worlds_overlap_3 = _overlap(2, TILE, 0), _overlap(3, TILE, 0)
lanes_overlap_2, lanes_overlap_3 = _overlap(2, CHUNK, 2 * TILE), _overlap(3, CHUNK, 2 * TILE)
lanes_meet_2, lanes_meet_3 = _meets(2), _meets(3)


@intrinsic
def copy_chunk(typing_context: TypingContext, source: Type, a: Type, target: Type, b: Type) -> Instructions:
    """Copy ``CHUNK`` numbers from ``source[a]`` on to ``target[b]`` on."""

    def generate(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]) -> Value:
        values = _load(context, builder, signature.args[0], arguments[0], arguments[1], 0)
        builder.store(values, _place(context, builder, signature.args[2], arguments[2], arguments[3], 0), align=4)
        return context.get_dummy_value()

    return types.void(source, types.int64, target, types.int64), generate


def _add_turned(
    power: int,
) -> Callable[[FloatArray, Whole, FloatArray, Whole, FloatArray, Whole, FloatArray, Whole], None]:
    """``(sums, a, draws, b, cosine, c, sine, d)``: add ``CHUNK`` weighted draws to as many sums, lane by lane.

    With power 1 the rows ``(x, y)`` from ``draws[b]`` on add ``cosine x - sine y`` and ``cosine y + sine x`` to the two
    rows from ``sums[a]`` on; with power 2 ``cosine x^2 + sine y^2`` and ``cosine y^2 + sine x^2``.
    """

    @intrinsic
    def add_turned(
        typing_context: TypingContext,
        sums: Type,
        a: Type,
        draws: Type,
        b: Type,
        cosine: Type,
        c: Type,
        sine: Type,
        d: Type,
    ) -> Instructions:
        def generate(
            context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]
        ) -> Value:
            def load(array: int, row: int) -> Value:
                return _load(context, builder, signature.args[array], arguments[array], arguments[array + 1], row)

            def multiply(x: Value, y: Value) -> Value:
                return builder.fmul(x, y)

            x, y = load(2, 0), load(2, CHUNK)
            if power == 2:
                x, y = multiply(x, x), multiply(y, y)
            along, across = load(4, 0), load(6, 0)
            first, second = load(0, 0), load(0, CHUNK)
            first = builder.fadd(first, multiply(along, x))
            second = builder.fadd(second, multiply(along, y))
            fold = builder.fsub if power == 1 else builder.fadd
            first = fold(first, multiply(across, y))
            second = builder.fadd(second, multiply(across, x))
            for row, value in enumerate((first, second)):
                place = _place(context, builder, signature.args[0], arguments[0], arguments[1], row * CHUNK)
                builder.store(value, place, align=4)
            return context.get_dummy_value()

        offset = types.int64
        return types.void(sums, offset, draws, offset, cosine, offset, sine, offset), generate

    return add_turned


add_turned, add_turned_squares = _add_turned(1), _add_turned(2)


def _at_most_of(count: int) -> Callable[[FloatArray, Whole, np.float32], np.uint64]:
    """``(w, offset, bound) -> mask``: where ``w[offset:offset + count] <= bound``."""

    @intrinsic
    def at_most(typing_context: TypingContext, w: Type, offset: Type, bound: Type) -> Instructions:
        def generate(
            context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]
        ) -> Value:
            array, start, limit = arguments
            limit = _splat(builder, limit)
            mask = ir.Constant(_MASK, 0)
            for first in range(0, count, CHUNK):
                values = _load(context, builder, signature.args[0], array, start, first)
                mask = builder.or_(mask, _at_most(builder, first, values, limit))
            return mask

        return types.uint64(w, types.int64, types.float32), generate

    return at_most


at_most, chunk_at_most = _at_most_of(TILE), _at_most_of(CHUNK)


@intrinsic
def subtract_where(typing_context: TypingContext, w: Type, offset: Type, mask: Type, amount: Type) -> Instructions:
    """Take ``amount`` from ``w[offset:offset + TILE]`` where the mask is set."""

    def generate(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]) -> Value:
        array, start, bits, value = arguments
        value, nothing = _splat(builder, value), ir.Constant(_FLOATS, [0.0] * CHUNK)
        for first in range(0, TILE, CHUNK):
            place = _place(context, builder, signature.args[0], array, start, first)
            part = builder.trunc(builder.lshr(bits, ir.Constant(_MASK, first)), _BITS)
            part = builder.bitcast(part, ir.VectorType(ir.IntType(1), CHUNK))
            old = builder.load(place, align=4)
            builder.store(builder.fsub(old, builder.select(part, value, nothing)), place, align=4)
        return context.get_dummy_value()

    return types.void(w, types.int64, types.uint64, types.float32), generate


@intrinsic
def use_wide_registers(typing_context: TypingContext) -> Instructions:
    """Let the compiler use all of the registers' width in the function that calls this.

    LLVM keeps to half of AVX-512's by default, because using all of it may slow the clock of some processors a little.
    The kernels gain more than that. Without AVX-512 this does nothing.
    """

    def generate(context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]) -> Value:
        # llvmlite knows no attributes with values, but writes down whatever is in the set.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.void(), generate
