"""Tuples of two to six numbers: consecutive rows of a workspace from offset ``o``, in world ``s``.

Written out, because the vectoriser gives up on loops over tuples.
"""

from __future__ import annotations

from typing import TypeAlias

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
def _read4(w: FloatArray, o: int, s: int) -> Row:
    return read2(w, o, s) + read2(w, o + 2 * TILE, s)


@compiled
def _read5(w: FloatArray, o: int, s: int) -> Row:
    return read2(w, o, s) + read3(w, o + 2 * TILE, s)


@compiled
def _read6(w: FloatArray, o: int, s: int) -> Row:
    return read3(w, o, s) + read3(w, o + 3 * TILE, s)


@compiled
def _write2(w: FloatArray, o: int, s: int, x: Row) -> None:
    w[o + s] = x[0]
    w[o + TILE + s] = x[1]


@compiled
def _write3(w: FloatArray, o: int, s: int, x: Row) -> None:
    _write2(w, o, s, x)
    w[o + 2 * TILE + s] = x[2]


@compiled
def _write4(w: FloatArray, o: int, s: int, x: Row) -> None:
    _write3(w, o, s, x)
    w[o + 3 * TILE + s] = x[3]


@compiled
def _write5(w: FloatArray, o: int, s: int, x: Row) -> None:
    _write4(w, o, s, x)
    w[o + 4 * TILE + s] = x[4]


@compiled
def _write6(w: FloatArray, o: int, s: int, x: Row) -> None:
    _write4(w, o, s, x)
    w[o + 4 * TILE + s] = x[4]
    w[o + 5 * TILE + s] = x[5]


@compiled
def _pick2(first: bool, x: Row, y: Row) -> Row:
    return (x[0] if first else y[0], x[1] if first else y[1])


@compiled
def _pick3(first: bool, x: Row, y: Row) -> Row:
    return (x[0] if first else y[0], x[1] if first else y[1], x[2] if first else y[2])


@compiled
def _pick4(first: bool, x: Row, y: Row) -> Row:
    return _pick2(first, x, y) + _pick2(first, (x[2], x[3]), (y[2], y[3]))


@compiled
def _pick5(first: bool, x: Row, y: Row) -> Row:
    return _pick2(first, x, y) + _pick3(first, (x[2], x[3], x[4]), (y[2], y[3], y[4]))


@compiled
def _pick6(first: bool, x: Row, y: Row) -> Row:
    return _pick3(first, x, y) + _pick3(first, (x[3], x[4], x[5]), (y[3], y[4], y[5]))


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


READ = {2: read2, 3: read3, 4: _read4, 5: _read5, 6: _read6}
WRITE = {2: _write2, 3: _write3, 4: _write4, 5: _write5, 6: _write6}
PICK = {2: _pick2, 3: _pick3, 4: _pick4, 5: _pick5, 6: _pick6}
SQUARED_NORM = {2: _squared_norm2, 3: _squared_norm3}
SQUARED_GAP = {2: squared_gap2, 3: squared_gap3}
