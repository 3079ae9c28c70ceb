"""Random numbers of many worlds at once, from counters: what a world draws depends on nothing but its own key and the
moment, so that it is the same alone and in any batch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.engine import noise
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS
from d4orm_env.engine.sample_noise import BIT_OPS


@cached_kernel(**OPTIONS)
def draw_normals(
    keys: NDArray[np.uint32], steps: IntArray, stream: np.uint32, call: np.uint32, out: FloatArray
) -> None:
    """Fill ``out`` ``(B, N)`` with independent standard normals.

    Args:
        keys: ``(B, 2)`` uint32, one key per world.
        steps: ``(B,)`` int64 steps taken since the episode began.
        stream: uint32 number of the purpose.
        call: uint32 number of the call in that step.
        out: float32, output.
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
