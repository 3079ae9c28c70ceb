"""Random numbers of disturbances: every disturbance of every world has its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.lazy import LazyModule

if TYPE_CHECKING:
    from d4orm_env.engine import sample_noise
else:
    sample_noise = LazyModule("d4orm_env.engine.sample_noise")

Keys = NDArray[np.uint32]
Steps = NDArray[np.int64]
Ahead = dict[tuple[int, int, int, tuple[int, ...]], tuple[int, FloatArray]]
"""Numbers that a single world has drawn ahead in its episode: by kind of number, stream, call and shape the first step,
and rows of numbers, one for each step from there on."""

_NORMAL, _UNIFORM = range(2)
"""Kinds of number."""

_AHEAD = 16
"""Steps that a single world draws for at once: calling a kernel takes longer than what it does there."""


def episode_keys(seeds: Sequence[int]) -> Keys:
    """``(B, 2)`` keys of episodes, of the 63 bits that each draws from its environment's generator."""
    words = np.array(seeds, np.uint64)
    return np.stack([words & np.uint64(0xFFFFFFFF), words >> np.uint64(32)], axis=1).astype(np.uint32)


_NOTHING: FloatArray = np.empty((0,), np.float32)


class Draws:
    """Random numbers of one disturbance at one moment of ``B`` worlds.

    They are a function of the world's episode, its step, the disturbance and the number of the call, and of nothing
    else: a world draws the same alone and in any batch, and a disturbance the same whatever others there are.

    Args:
        keys: ``(B, 2)`` keys of the episodes, see :func:`episode_keys`.
        steps: ``(B,)`` steps taken.
        stream: Number of the disturbance.
        purpose: Number of the occasion on which it draws, from 0 to 255.
        ahead: Numbers that a single world has drawn ahead, which this adds to; ``None`` draws as it is asked.
    """

    def __init__(self, keys: Keys, steps: Steps, stream: int, purpose: int, ahead: Ahead | None = None) -> None:
        self._keys, self._stream, self._first, self._ahead = keys, stream, purpose << 16, ahead
        self.turn_to(steps)

    def turn_to(self, steps: Steps) -> None:
        """Begin anew at another moment, ``(B,)`` steps."""
        self._steps, self._call = steps, self._first

    def of(self, worlds: NDArray[np.intp]) -> Draws:
        """The same for some of the worlds: they draw what they would draw here."""
        part = Draws(self._keys[worlds], self._steps[worlds], self._stream, 0)
        part._call = self._call
        return part

    def normal(self, *shape: int) -> FloatArray:
        """``(B, *shape)`` independent standard normals."""
        return self._filled(_NORMAL, shape)

    def uniform(self, *shape: int) -> FloatArray:
        """``(B, *shape)`` independent numbers, uniform between 0 and 1, neither of which occurs."""
        return self._filled(_UNIFORM, shape)

    def whole(self, low: int, high: int, *shape: int) -> NDArray[np.int64]:
        """``(B, *shape)`` independent whole numbers, uniform from ``low`` to ``high``, both included."""
        numbers: NDArray[np.int64] = low + np.floor(self.uniform(*shape) * (high - low + 1)).astype(np.int64)
        return np.minimum(numbers, high)

    def direction(self, *shape: int) -> FloatArray:
        """``(B, *shape)`` unit vectors along the last axis, uniform on the circle or the sphere."""
        vectors = self.normal(*shape)
        length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
        return vectors / np.maximum(length, np.float32(1e-12))

    def _filled(self, kind: int, shape: tuple[int, ...]) -> FloatArray:
        if self._ahead is None:
            out = self._drawn(kind, self._keys, self._steps, shape)
        else:
            out = self._taken(kind, shape, self._ahead)
        self._call += 1
        return out

    def _drawn(self, kind: int, keys: Keys, steps: Steps, shape: tuple[int, ...]) -> FloatArray:
        """``(R, *shape)`` numbers, a row for each of the keys ``(R, 2)`` at its step ``(R,)``."""
        rows = len(keys)
        out: FloatArray = np.empty((rows, *shape), np.float32)
        draw = sample_noise.draw_uniforms if kind else sample_noise.draw_normals
        draw(keys, steps, np.uint32(self._stream), np.uint32(self._call), out.reshape(rows, -1))
        return out

    def _taken(self, kind: int, shape: tuple[int, ...], ahead: Ahead) -> FloatArray:
        """``(1, *shape)`` numbers of a single world, drawn ahead if they are not yet."""
        step, key = int(self._steps[0]), (kind, self._stream, self._call, shape)
        first, rows = ahead.get(key, (0, _NOTHING))
        if not first <= step < first + len(rows):
            first, steps = step, np.arange(step, step + _AHEAD)
            rows = self._drawn(kind, self._keys.repeat(_AHEAD, axis=0), steps, shape)
            ahead[key] = first, rows
        return rows[step - first : step - first + 1].copy()  # the caller's to change
