"""All worlds of a tile at once, where loops over them would not do: as vector instructions written out.

What holds in some worlds only is a mask, one bit per world, lowest bit first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from inspect import Parameter
from inspect import Signature as Parameters
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from llvmlite import ir
from llvmlite.ir import IRBuilder, Value
from numba import extending
from numba.core.base import BaseContext
from numba.core.types import Type, boolean, float32, int64, uint64, void
from numba.core.typing.context import BaseContext as TypingContext
from numba.core.typing.templates import Signature

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
BIT = np.uint64(1)

_FLOATS = ir.VectorType(ir.FloatType(), CHUNK)
_FLAGS = ir.VectorType(ir.IntType(1), CHUNK)
_BITS = ir.IntType(CHUNK)
_MASK = ir.IntType(TILE)


class Writer(NamedTuple):
    """The function whose instructions are written, and what most of them do. Arrays are given by argument number."""

    context: BaseContext
    builder: IRBuilder
    signature: Signature
    arguments: tuple[Value, ...]

    def address(self, array: int, offset: Value) -> Value:
        data = self.context.make_array(self.signature.args[array])(self.context, self.builder, self.arguments[array])
        return self.builder.gep(data.data, [offset], inbounds=True)

    def _vector(self, array: int, offset: Value, first: int) -> Value:
        """The address of ``array[offset + first]`` as that of a vector."""
        index = self.builder.add(offset, ir.Constant(offset.type, first))
        return self.builder.bitcast(self.address(array, index), _FLOATS.as_pointer())

    def load(self, array: int, offset: Value, first: int = 0) -> Value:
        return self.builder.load(self._vector(array, offset, first), align=4)

    def store(self, values: Value, array: int, offset: Value, first: int = 0) -> None:
        self.builder.store(values, self._vector(array, offset, first), align=4)

    def splat(self, value: Value) -> Value:
        undefined = ir.Constant(_FLOATS, ir.Undefined)
        lane = self.builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
        return self.builder.shuffle_vector(lane, undefined, ir.Constant(ir.VectorType(ir.IntType(32), CHUNK), None))

    def mask(self, count: int, holds: Callable[[int], Value]) -> Value:
        """The mask of the first ``count`` worlds, of what holds in ``CHUNK`` of them from one on."""
        mask = ir.Constant(_MASK, 0)
        for first in range(0, count, CHUNK):
            bits = self.builder.zext(self.builder.bitcast(holds(first), _BITS), _MASK)
            mask = self.builder.or_(mask, self.builder.shl(bits, ir.Constant(_MASK, first)))
        return mask

    def at_most(self, values: Value, bound: Value) -> Value:
        """The mask of values up to the bound, which what is not a number never is."""
        return self.builder.fcmp_ordered("<=", values, bound)


ANY = None
"""In place of the type of an argument that may have any, as an array of whatever layout."""


def instructions(result: Type, *kinds: Type | None) -> Callable[[Callable[[Writer], Value]], Callable[..., Any]]:
    """Decorator: what ``write(writer)`` writes as a function of compiled code with arguments of these types."""

    def decorate(write: Callable[[Writer], Value]) -> Callable[..., Any]:
        @wraps(write)
        def define(typing_context: TypingContext, *given: Type) -> Instructions:
            def generate(
                context: BaseContext, builder: IRBuilder, signature: Signature, arguments: tuple[Value, ...]
            ) -> Value:
                value = write(Writer(context, builder, signature, arguments))
                return context.get_dummy_value() if value is None else value

            return result(*(own if kind is ANY else kind for own, kind in zip(given, kinds, strict=True))), generate

        names = ("typing_context", *(f"argument_{number}" for number in range(len(kinds))))
        parameters = [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in names]
        define.__signature__ = Parameters(parameters)  # type: ignore[attr-defined] # numba counts them
        return intrinsic(define)

    return decorate


def _within(dimension: int, count: int) -> Callable[..., np.uint64]:
    """``(w, a, b, squared_distance) -> mask``: where the positions in the rows from ``w[a]`` and ``w[b]`` on are
    near, in the first ``count`` worlds.
    """

    @instructions(uint64, ANY, int64, int64, float32)
    def within(writer: Writer) -> Value:
        _, a, b, squared_distance = writer.arguments
        bound = writer.splat(squared_distance)

        def near(first: int) -> Value:
            total = None
            for axis in range(dimension):
                row = axis * TILE + first
                gap = writer.builder.fsub(writer.load(0, a, row), writer.load(0, b, row))
                square = writer.builder.fmul(gap, gap)
                total = square if total is None else writer.builder.fadd(total, square)
            return writer.at_most(total, bound)

        return writer.mask(count, near)

    return within


within_2, within_3 = _within(2, TILE), _within(3, TILE)
chunk_within_2, chunk_within_3 = _within(2, CHUNK), _within(3, CHUNK)


@instructions(void, ANY, int64, int64, float32, ANY, int64)
def enclose(writer: Writer) -> None:
    """``(w, first, step, widening, boxes, begin)``: enclose the numbers of ``BLOCK`` rows, the first at ``w[first]``
    and the others ``step`` numbers apart.

    From ``boxes[begin]`` on this fills a row of ``TILE`` lower ends, world by world, and one of upper ends,
    ``widening`` beyond the numbers; then rows of ``CHUNK`` ends, lane by lane: a lane encloses four worlds. What
    is not a number is left out.
    """
    (_, offset, distance, widening, _, start), builder = writer.arguments, writer.builder
    rows = [offset]
    for _ in range(1, BLOCK):
        rows.append(builder.add(rows[-1], distance))
    extra = writer.splat(widening)
    for end, (comparison, beyond) in enumerate((("<", builder.fsub), (">", builder.fadd))):

        def farther(values: Value, most: Value, comparison: str = comparison) -> Value:
            return builder.select(builder.fcmp_ordered(comparison, values, most), values, most)

        ends = []
        for chunk in range(0, TILE, CHUNK):
            most = ir.Constant(_FLOATS, [math.inf if end == 0 else -math.inf] * CHUNK)
            for row in rows:
                most = farther(writer.load(0, row, chunk), most)
            ends.append(beyond(most, extra))
            writer.store(ends[-1], 4, start, end * TILE + chunk)
        most = ends[0]
        for other in ends[1:]:
            most = farther(other, most)
        writer.store(most, 4, start, 2 * TILE + end * CHUNK)


def _overlap(dimension: int, width: int, begin: int) -> Callable[..., np.uint64]:
    """``(boxes, a, b) -> mask``: where the boxes from ``boxes[a]`` and ``boxes[b]`` on touch, of the worlds or of the
    lanes of :func:`enclose`.
    """

    @instructions(uint64, ANY, int64, int64)
    def overlap(writer: Writer) -> Value:
        _, a, b = writer.arguments

        def touch(first: int) -> Value:
            flags = ir.Constant(_FLAGS, [1] * CHUNK)
            for axis in range(dimension):
                row = axis * BOX + begin + first
                for low, high in ((a, b), (b, a)):
                    below = writer.at_most(writer.load(0, low, row), writer.load(0, high, row + width))
                    flags = writer.builder.and_(flags, below)
            return flags

        return writer.mask(width, touch)

    return overlap


def _meets(dimension: int) -> Callable[..., bool]:
    """``(boxes, a, limits, b) -> bool``: whether in any lane the boxes from ``boxes[a]`` on touch one more box, whose
    lower and upper end along the first axis, and then along the others, are the numbers from ``limits[b]`` on.
    """

    @instructions(boolean, ANY, int64, ANY, int64)
    def meets(writer: Writer) -> Value:
        (_, offset, _, first), builder = writer.arguments, writer.builder
        flags = ir.Constant(_FLAGS, [1] * CHUNK)
        for axis in range(dimension):
            low, high = (
                writer.splat(builder.load(writer.address(2, builder.add(first, ir.Constant(first.type, 2 * axis + i)))))
                for i in range(2)
            )
            row = axis * BOX + 2 * TILE
            flags = builder.and_(flags, writer.at_most(writer.load(0, offset, row), high))
            flags = builder.and_(flags, writer.at_most(low, writer.load(0, offset, row + CHUNK)))
        return builder.icmp_unsigned("!=", builder.bitcast(flags, _BITS), ir.Constant(_BITS, 0))

    return meets


worlds_overlap_2, worlds_overlap_3 = _overlap(2, TILE, 0), _overlap(3, TILE, 0)
lanes_overlap_2, lanes_overlap_3 = _overlap(2, CHUNK, 2 * TILE), _overlap(3, CHUNK, 2 * TILE)
lanes_meet_2, lanes_meet_3 = _meets(2), _meets(3)


@instructions(void, ANY, int64, ANY, int64)
def copy_chunk(writer: Writer) -> None:
    """``(source, a, target, b)``: copy ``CHUNK`` numbers from ``source[a]`` on to ``target[b]`` on."""
    _, a, _, b = writer.arguments
    writer.store(writer.load(0, a), 2, b)


def _add_turned(power: int) -> Callable[..., None]:
    """``(sums, a, draws, b, cosine, c, sine, d)``: add ``CHUNK`` weighted draws to as many sums, lane by lane.

    With power 1 the rows ``(x, y)`` from ``draws[b]`` on add ``cosine x - sine y`` and ``cosine y + sine x`` to the two
    rows from ``sums[a]`` on; with power 2 ``cosine x^2 + sine y^2`` and ``cosine y^2 + sine x^2``.
    """

    @instructions(void, ANY, int64, ANY, int64, ANY, int64, ANY, int64)
    def add_turned(writer: Writer) -> None:
        (_, a, _, b, _, c, _, d), builder = writer.arguments, writer.builder
        x, y = writer.load(2, b), writer.load(2, b, CHUNK)
        if power == 2:
            x, y = builder.fmul(x, x), builder.fmul(y, y)
        along, across = writer.load(4, c), writer.load(6, d)
        first = builder.fadd(writer.load(0, a), builder.fmul(along, x))
        second = builder.fadd(writer.load(0, a, CHUNK), builder.fmul(along, y))
        fold = builder.fsub if power == 1 else builder.fadd
        writer.store(fold(first, builder.fmul(across, y)), 0, a)
        writer.store(builder.fadd(second, builder.fmul(across, x)), 0, a, CHUNK)

    return add_turned


add_turned, add_turned_squares = _add_turned(1), _add_turned(2)


def _at_most_of(count: int) -> Callable[..., np.uint64]:
    """``(w, offset, bound) -> mask``: where ``w[offset:offset + count] <= bound``."""

    @instructions(uint64, ANY, int64, float32)
    def at_most(writer: Writer) -> Value:
        _, offset, bound = writer.arguments
        limit = writer.splat(bound)
        return writer.mask(count, lambda first: writer.at_most(writer.load(0, offset, first), limit))

    return at_most


at_most, chunk_at_most = _at_most_of(TILE), _at_most_of(CHUNK)


@instructions(void, ANY, int64, uint64, float32)
def subtract_where(writer: Writer) -> None:
    """``(w, offset, mask, amount)``: take ``amount`` from ``w[offset:offset + TILE]`` where the mask is set."""
    (_, offset, mask, amount), builder = writer.arguments, writer.builder
    value, nothing = writer.splat(amount), ir.Constant(_FLOATS, [0.0] * CHUNK)
    for first in range(0, TILE, CHUNK):
        bits = builder.trunc(builder.lshr(mask, ir.Constant(_MASK, first)), _BITS)
        part = builder.select(builder.bitcast(bits, _FLAGS), value, nothing)
        writer.store(builder.fsub(writer.load(0, offset, first), part), 0, offset, first)


@instructions(void)
def use_wide_registers(writer: Writer) -> None:
    """Let the compiler use all of the registers' width in the function that calls this.

    LLVM keeps to half of AVX-512's by default, because using all of it may slow the clock of some processors a little.
    The kernels gain more than that. Without AVX-512 this does nothing.
    """
    # llvmlite knows no attributes with values, but writes down whatever is in the set.
    set.add(writer.builder.function.attributes, '"prefer-vector-width"="512"')
