"""Structs of arrays by reference in compiled code."""

from __future__ import annotations

import sys
from typing import NamedTuple

import numba
import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.engine.borrowing import _Borrowed, borrow
from d4orm_env.engine.compiling import compiled


class Inner(NamedTuple):
    values: FloatArray
    factor: float


class Outer(NamedTuple):
    first: FloatArray
    missing: None
    inner: Inner


@compiled
def _scaled(inner: Inner, i: int) -> float:
    return inner.values[i] * inner.factor


@numba.njit(nogil=True)
def _total(outer: Outer) -> float:
    outer = borrow(outer)
    total = 0.0
    for i in range(outer.first.shape[0]):
        total += outer.first[i] + _scaled(outer.inner, i)
    return total


def test_fields_are_read_where_they_are_and_belong_to_the_caller() -> None:
    first, values = np.array([1.0, 2.0, 3.0]), np.array([10.0, 20.0, 30.0])
    references = sys.getrefcount(first), sys.getrefcount(values)
    assert _total(Outer(first, None, Inner(values, 0.5))) == 36.0
    assert (sys.getrefcount(first), sys.getrefcount(values)) == references


def test_structs_of_other_fields_have_other_names() -> None:
    # Kernels that two processes have compiled are loaded into a third, where functions are told apart by these.
    rows = np.zeros(3)
    structs = [Outer(rows, None, Inner(rows, 1.0)), Outer(rows.reshape(3, 1), None, Inner(rows, 1.0))]
    names = [_Borrowed(numba.typeof(struct)).name for struct in (*structs, Outer(rows + 1, None, Inner(rows, 2.0)))]
    assert names[0] == names[2] != names[1]
