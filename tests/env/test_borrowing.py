"""Structs of arrays by reference in compiled code."""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import pytest

from d4orm_env.core.arrays import FloatArray
from d4orm_env.engine.borrowing import borrow, borrowed
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import compiled


class Inner(NamedTuple):
    values: FloatArray
    factor: float


class Span(NamedTuple):
    begin: float
    end: float


class Outer(NamedTuple):
    first: FloatArray
    missing: None
    inner: Inner
    span: Span


@compiled
def _scaled(inner: Inner, i: int) -> float:
    return inner.values[i] * inner.factor


@cached_kernel()
def _total(outer: Outer, own: bool) -> float:
    outer = borrow(outer) if own else outer
    total = outer.span.begin + outer.span.end
    for i in range(outer.first.shape[0]):
        total += outer.first[i] + _scaled(outer.inner, i)
    return total


@pytest.mark.parametrize("own", [False, True])
def test_fields_are_read_where_they_are_and_belong_to_the_caller(own: bool) -> None:
    first, values = np.array([1.0, 2.0, 3.0]), np.array([10.0, 20.0, 30.0])
    references = sys.getrefcount(first), sys.getrefcount(values)
    assert _total(Outer(first, None, Inner(values, 0.5), Span(1.0, 2.0)), own) == 39.0
    assert (sys.getrefcount(first), sys.getrefcount(values)) == references


def test_structs_of_other_fields_have_other_names() -> None:
    # Kernels that two processes have compiled are loaded into a third, where functions are told apart by these.
    rows, span = np.zeros(3), Span(0.0, 1.0)
    inner = Inner(rows, 1.0)
    structs = [Outer(rows, None, inner, span), Outer(rows.reshape(3, 1), None, inner, span)]
    structs.append(Outer(rows + 1, None, Inner(rows, 2.0), span))
    names = [borrowed(struct).name for struct in structs]
    assert names[0] == names[2] != names[1]


def test_a_kernel_does_not_return_its_argument() -> None:
    @cached_kernel(variant="itself")
    def itself(inner: Inner) -> Inner:
        return inner

    with pytest.raises(TypeError, match="a kernel returns a struct that it was given; return its fields"):
        itself(Inner(np.zeros(1), 1.0))
