"""Tuples of two to six numbers: consecutive rows of a workspace from offset ``o``, in world ``s``.

Written out, because the vectoriser gives up on loops over tuples.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.engine.compiling import compiled
from d4orm_env.engine.simd import TILE

Row: TypeAlias = tuple[np.float32, ...]
"""A state, a control, limits, a place or a velocity of one robot in one world."""


@compiled
def read2(w: FloatArray, o: int, s: int) -> Row:
    return (w[o + s], w[o + TILE + s])


@compiled
def read3(w: FloatArray, o: int, s: int) -> Row:
    return (w[o + s], w[o + TILE + s], w[o + 2 * TILE + s])


@compiled
def _write2(w: FloatArray, o: int, s: int, x: Row) -> None:
    w[o + s] = x[0]
    w[o + TILE + s] = x[1]


@compiled
def _write3(w: FloatArray, o: int, s: int, x: Row) -> None:
    _write2(w, o, s, x)
    w[o + 2 * TILE + s] = x[2]


@compiled
def _pick2(first: bool, x: Row, y: Row) -> Row:
    return (x[0] if first else y[0], x[1] if first else y[1])


@compiled
def _pick3(first: bool, x: Row, y: Row) -> Row:
    return (x[0] if first else y[0], x[1] if first else y[1], x[2] if first else y[2])


@compiled
def _squared_norm2(v: Row) -> np.float32:
    return v[0] * v[0] + v[1] * v[1]


@compiled
def _squared_norm3(v: Row) -> np.float32:
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


@compiled
def squared_gap2(x: Row, y: Row) -> np.float32:
    return _squared_norm2((x[0] - y[0], x[1] - y[1]))


@compiled
def squared_gap3(x: Row, y: Row) -> np.float32:
    return _squared_norm3((x[0] - y[0], x[1] - y[1], x[2] - y[2]))


READ: dict[int, Any] = {2: read2, 3: read3}
WRITE: dict[int, Any] = {2: _write2, 3: _write3}
PICK: dict[int, Any] = {2: _pick2, 3: _pick3}
SQUARED_NORM = {2: _squared_norm2, 3: _squared_norm3}
SQUARED_GAP = {2: squared_gap2, 3: squared_gap3}


def _add_size(size: int, rest: int) -> None:
    """Put together the functions of tuples of ``size`` numbers and of the ``rest``."""
    (read, read_rest), (write, write_rest), (pick, pick_rest) = ((of[size], of[rest]) for of in (READ, WRITE, PICK))

    @compiled
    def read_both(w: FloatArray, o: int, s: int) -> Row:
        return read(w, o, s) + read_rest(w, o + size * TILE, s)

    @compiled
    def write_both(w: FloatArray, o: int, s: int, x: Row) -> None:
        write(w, o, s, x)
        write_rest(w, o + size * TILE, s, x[size:])

    @compiled
    def pick_both(first: bool, x: Row, y: Row) -> Row:
        return pick(first, x, y) + pick_rest(first, x[size:], y[size:])

    READ[size + rest], WRITE[size + rest], PICK[size + rest] = read_both, write_both, pick_both


for _sizes in ((2, 2), (2, 3), (3, 3)):
    _add_size(*_sizes)
