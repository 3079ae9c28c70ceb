"""Noise from counters, compiled: of a tile of samples, and of many worlds at once.

Of a tile's pairs of normals four samples each take a turn. What a world draws depends on nothing but its own key and
the moment, so that it is the same alone and in any batch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.engine import noise
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined, register
from d4orm_env.engine.elementary import sqrt
from d4orm_env.engine.noise import DRAWS
from d4orm_env.engine.simd import copy_chunk, use_wide_registers
from d4orm_env.engine.stepping import Row


class Drawing(NamedTuple):
    """Distribution of the samples of a denoising step."""

    offset: FloatArray  #: ``(H, K, m)`` base controls plus mean deformation
    scale: FloatArray  #: ``(H, K, m)`` standard deviation of the noise
    seed: NDArray[np.uint32]  #: Two uint32 words
    step: int  #: Number of the denoising step


register(noise)


@compiled
def _uint32(x: int) -> np.uint32:
    return np.uint32(x)


@compiled
def _int32(x: int) -> np.int32:
    return np.int32(x)


@compiled
def _to_float(x: np.int32) -> np.float32:
    return np.float32(x)


@compiled
def _float_bits(x: np.float32) -> np.int32:
    return np.float32(x).view(np.int32)


@compiled
def _bits_float(x: np.int32) -> np.float32:
    return np.int32(x).view(np.float32)


BIT_OPS = noise.BitOps(_uint32, _int32, _to_float, _float_bits, _bits_float, sqrt)


@compiled
def fill_keys(
    seed: NDArray[np.uint32], step: int, num_robots: int, num_steps: int, num_pairs: int, keys: NDArray[np.uint32]
) -> None:
    """Fill ``keys`` ``(2, K H P)`` with those of the noise streams of a denoising step."""
    for k in range(num_robots):
        for pair in range(num_pairs):
            for t in range(num_steps):
                key = noise.stream_key(
                    seed[0], seed[1], np.uint32(step), np.uint32(k), np.uint32(t), np.uint32(pair), BIT_OPS
                )
                stream = (k * num_steps + t) * num_pairs + pair
                keys[0, stream] = key[0]
                keys[1, stream] = key[1]


@compiled
def _draw(key: tuple[np.uint32, np.uint32], first: int, draws: FloatArray) -> None:
    """Fill two rows with normals, from counter number ``first`` on."""
    use_wide_registers()
    for s in range(DRAWS):
        x, y = noise.normal_pair(np.uint32(first + s), key, BIT_OPS)
        draws[s] = x
        draws[DRAWS + s] = y


@inlined
def draw_block(
    keys: NDArray[np.uint32], first: int, begin: int, count: int, num_pairs: int, kept: FloatArray, draws: FloatArray
) -> None:
    """Draw a robot's noise of a block of ``count`` steps, with ``keys`` ``(2, K H P)`` of :func:`fill_keys`.

    ``first`` is the tile's first counter number, ``begin`` the number of the robot's stream at the first step, and
    ``num_pairs`` is ``P``. Filled are ``kept`` ``(T K H P 2 DRAWS,)`` and with the same noise ``draws``
    ``(BLOCK 4 DRAWS,)``, two rows for each of up to two pairs of components.
    """
    # Of all tiles before this one.
    before = first // DRAWS * keys.shape[1]
    for i in range(count):
        for pair in range(num_pairs):
            stream, row = begin + i * num_pairs + pair, (2 * i + pair) * 2 * DRAWS
            _draw((keys[0, stream], keys[1, stream]), first, draws[row : row + 2 * DRAWS])
            for half in range(2):
                copy_chunk(draws, row + half * DRAWS, kept, (2 * (before + stream) + half) * DRAWS)


@compiled
def _turn2(o: Row, c: Row, d: FloatArray, s: int) -> tuple[Row, Row, Row, Row]:
    x, y = d[s], d[DRAWS + s]
    a, b, across, along = c[0] * x, c[1] * y, c[0] * y, c[1] * x
    return (o[0] + a, o[1] + b), (o[0] - a, o[1] - b), (o[0] - across, o[1] + along), (o[0] + across, o[1] - along)


@compiled
def _turn3(o: Row, c: Row, d: FloatArray, s: int) -> tuple[Row, Row, Row, Row]:
    first, second, third, fourth = _turn2(o, c, d, s)
    # Of the second pair one component is left over.
    a, across = c[2] * d[2 * DRAWS + s], c[2] * d[3 * DRAWS + s]
    z = o[2]
    return (*first, z + a), (*second, z - a), (*third, z - across), (*fourth, z + across)


@compiled
def _vector2(x: FloatArray) -> Row:
    return (x[0], x[1])


@compiled
def _vector3(x: FloatArray) -> Row:
    return (x[0], x[1], x[2])


TURN = {2: _turn2, 3: _turn3}
VECTOR = {2: _vector2, 3: _vector3}


@cached_kernel(**OPTIONS)
def draw_normals(
    keys: NDArray[np.uint32], steps: IntArray, stream: np.uint32, call: np.uint32, out: FloatArray
) -> None:
    """Fill ``out`` ``(B, N)`` with independent standard normals.

    Of each world there are a key ``(2,)`` uint32 and the steps taken since the episode began; ``stream`` is the number
    of the purpose, and ``call`` that of the call in the step.
    """
    num_pairs = out.shape[1] // 2
    for b in range(out.shape[0]):
        key = noise.stream_key(
            keys[b, 0], keys[b, 1], np.uint32(steps[b]), np.uint32(stream), np.uint32(call), np.uint32(0), BIT_OPS
        )
        for j in range(num_pairs):  # without a branch, so that the compiler takes several at once
            x, y = noise.normal_pair(np.uint32(2 * j), key, BIT_OPS)
            out[b, 2 * j] = x
            out[b, 2 * j + 1] = y
        if 2 * num_pairs < out.shape[1]:
            out[b, 2 * num_pairs] = noise.normal_pair(np.uint32(2 * num_pairs), key, BIT_OPS)[0]


@cached_kernel(**OPTIONS)
def draw_uniforms(
    keys: NDArray[np.uint32], steps: IntArray, stream: np.uint32, call: np.uint32, out: FloatArray
) -> None:
    """Fill ``out`` ``(B, N)`` with independent numbers, uniform in (0, 1); arguments as for :func:`draw_normals`."""
    for b in range(out.shape[0]):
        key = noise.stream_key(
            keys[b, 0], keys[b, 1], np.uint32(steps[b]), np.uint32(stream), np.uint32(call), np.uint32(1), BIT_OPS
        )
        for i in range(out.shape[1]):
            counter = np.uint32(np.uint32(i) * noise.GOLDEN)
            bits = noise.hash32(np.uint32(counter ^ key[0]), key[1], BIT_OPS)
            out[b, i] = noise.unit_interval(bits, BIT_OPS)
