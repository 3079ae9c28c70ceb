"""Weights of samples, and weighted means of the noise that scoring has kept, with the same bits on every processor.

In NumPy a softmax takes a dozen calls, which for few samples cost more than what they compute, and the last bits of
NumPy's exponential depend on the processor.
"""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import ONE, OPTIONS, ZERO, aligned_zeros, compiled
from d4orm_env.engine.noise import DRAWS
from d4orm_env.engine.simd import add_turned, add_turned_squares, use_wide_registers

LANES = 16  #: Sums run over as many parts side by side, whatever the width of registers

# exp(x) = 2^n exp(r), with n the nearest whole number to x / ln 2 and a minimax polynomial for r (Cephes, expf).
_LOWEST = np.float32(-87)
_ONE_OVER_LN2, _LN2_HIGH, _LN2_LOW = np.float32(1.44269504), np.float32(0.693359375), np.float32(-2.12194440e-4)
_E2, _E3, _E4 = np.float32(5.0000001201e-1), np.float32(1.6666665459e-1), np.float32(4.1665795894e-2)
_E5, _E6, _E7 = np.float32(8.3334519073e-3), np.float32(1.3981999507e-3), np.float32(1.9875691500e-4)
_HALF, _BIAS, _MANTISSA = np.float32(0.5), np.int32(127), np.int32(23)
_LEAST_SPREAD = np.float32(1e-6)  #: Below this spread samples are as good as equal; amplified, rounding is noise
_LEAST_SUM = np.float32(1e-30)
_NOTHING = np.float32(-np.inf)


@compiled
def _exponential(x: np.float32) -> np.float32:
    """``exp(x)`` of ``x`` from -87 to 0, and zero below."""
    n = np.floor(x * _ONE_OVER_LN2 + _HALF)
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    tail = _E2 + r * (_E3 + r * (_E4 + r * (_E5 + r * (_E6 + r * _E7))))
    power = np.int32(np.int32(np.int32(n) + _BIAS) << _MANTISSA).view(np.float32)
    return (ONE + (r + r * r * tail)) * power if x >= _LOWEST else ZERO


@compiled
def _total(values: FloatArray, sums: FloatArray) -> np.float32:
    """The sum of ``values``, lane by lane and then by halves; ``sums`` ``(LANES,)`` is overwritten."""
    for lane in range(LANES):
        sums[lane] = ZERO
    whole = values.shape[0] // LANES * LANES
    for first in range(0, whole, LANES):
        for lane in range(LANES):
            sums[lane] += values[first + lane]
    for i in range(whole, values.shape[0]):
        sums[i - whole] += values[i]
    half = LANES // 2
    while half > 0:
        for lane in range(half):
            sums[lane] += sums[lane + half]
        half //= 2
    return sums[0]


@compiled
def _largest(values: FloatArray) -> np.float32:
    """The largest of ``values``, or zero where none is more than minus infinity."""
    best = _NOTHING
    for i in range(values.shape[0]):
        best = values[i] if values[i] > best else best
    return best if best > _NOTHING else ZERO


@compiled
def _spread(rewards: FloatArray, row: FloatArray, sums: FloatArray) -> np.float32:
    """Standard deviation of the rewards that are more than minus infinity; ``row`` is overwritten."""
    count = np.float32(0)
    for i in range(row.shape[0]):
        usable = rewards[i] > _NOTHING
        row[i] = rewards[i] if usable else ZERO
        count += ONE if usable else ZERO
    count = max(count, ONE)
    mean = _total(row, sums) / count
    for i in range(row.shape[0]):
        deviation = rewards[i] - mean if rewards[i] > _NOTHING else ZERO
        row[i] = deviation * deviation
    return max(np.sqrt(_total(row, sums) / count), _LEAST_SPREAD)


@compiled
def _weigh(
    rewards: FloatArray, log_ratio: FloatArray, scale: np.float32, cutoff: np.float32, row: FloatArray, sums: FloatArray
) -> None:
    """Fill ``row`` with the weights of one row of rewards, whose logarithms are ``scale`` times them."""
    best = _largest(rewards)
    for i in range(row.shape[0]):
        row[i] = (rewards[i] - best) * scale
    if log_ratio.shape[0] > 0:
        for i in range(row.shape[0]):
            row[i] = row[i] + log_ratio[i] if rewards[i] > _NOTHING else _NOTHING
        best = _largest(row)
        for i in range(row.shape[0]):
            row[i] -= best
    for i in range(row.shape[0]):
        weight = _exponential(row[i])
        row[i] = weight if weight >= cutoff else ZERO
    share = ONE / max(_total(row, sums), _LEAST_SUM)
    for i in range(row.shape[0]):
        row[i] *= share


@cached_kernel(**OPTIONS)
def _softmax(
    rewards: FloatArray, log_ratio: FloatArray, temperature: np.float32, cutoff: np.float32, weights: FloatArray
) -> None:
    sums = np.empty(LANES, np.float32)
    for k in range(rewards.shape[0]):
        scale = ONE / (temperature * _spread(rewards[k], weights[k], sums))
        _weigh(rewards[k], log_ratio[min(k, log_ratio.shape[0] - 1)], scale, cutoff, weights[k], sums)


def softmax_weights(
    rewards: FloatArray, temperature: float, cutoff: float, log_ratio: FloatArray | None = None
) -> FloatArray:
    """``(..., M)`` float32 ``exp(reward / (temperature * standard deviation) + log_ratio)``, normalised to sum to one.

    Samples at minus infinity get no weight, so that all may be zero, and weights below a share ``cutoff`` of the
    largest are zero.
    """
    rows = np.ascontiguousarray(rewards, np.float32)
    num_samples = rows.shape[-1]
    added = np.empty((1, 0), np.float32)
    if log_ratio is not None:
        added = np.array(np.broadcast_to(log_ratio, rows.shape), np.float32).reshape(-1, num_samples)
    weights = np.empty((rows.size // num_samples, num_samples), np.float32)
    _softmax(rows.reshape(weights.shape), added, np.float32(temperature), np.float32(cutoff), weights)
    return weights.reshape(rows.shape)


@compiled
def _sum_lanes(sums: FloatArray, time_range: IntArray, k: int, moment: FloatArray) -> None:
    """Put the sums ``(T P 2 DRAWS,)`` of robot ``k`` over their lanes into ``moment`` ``(H, K, m)``."""
    num_controls = moment.shape[2]
    rows = num_controls + num_controls % 2
    for t in range(time_range[0], time_range[1]):
        for i in range(num_controls):
            begin = ((t - time_range[0]) * rows + i) * DRAWS
            # Halves upon halves: an order of summation that does not depend on the width of registers.
            half = DRAWS // 2
            while half > 0:
                for lane in range(begin, begin + half):
                    sums[lane] += sums[lane + half]
                half //= 2
            moment[t, k, i] = sums[begin]


@cached_kernel(**OPTIONS)
def average_noise(
    kept: FloatArray,
    odd: FloatArray,
    even: FloatArray,
    time_range: IntArray,
    first_moment: FloatArray,
    second_moment: FloatArray,
) -> None:
    """Weighted mean of the noise, and of its square.

    Args:
        kept: The noise that :func:`score_tiles` kept.
        odd: ``(2, K, M / 4)`` weights summed over the samples that share a counter, times the cosine of their turn and
            times its sine; ``(2, 1, M / 4)`` where all robots have the same weights.
        even: As many with the squares of cosine and sine.
        time_range: First time step and the one after the last.
        first_moment: ``(H, K, m)``, output.
        second_moment: ``(H, K, m)``, output, or an empty array to do without.
    """
    use_wide_registers()
    num_tiles, num_robots, num_steps, num_pairs = kept.shape[0], kept.shape[1], kept.shape[2], kept.shape[3]
    draws, count = kept.reshape(-1), (time_range[1] - time_range[0]) * num_pairs
    sums = aligned_zeros(count * 2 * DRAWS)
    squares = aligned_zeros(count * 2 * DRAWS if second_moment.size > 0 else 0)
    for k in range(num_robots):
        row = min(k, odd.shape[1] - 1)
        sums[:] = ZERO
        squares[:] = ZERO
        for tile in range(num_tiles):
            stream, lane = ((tile * num_robots + k) * num_steps + time_range[0]) * num_pairs, tile * DRAWS
            for i in range(count):
                begin = 2 * (stream + i) * DRAWS
                add_turned(sums, 2 * i * DRAWS, draws, begin, odd[0, row], lane, odd[1, row], lane)
            if second_moment.size > 0:
                for i in range(count):
                    begin = 2 * (stream + i) * DRAWS
                    add_turned_squares(squares, 2 * i * DRAWS, draws, begin, even[0, row], lane, even[1, row], lane)
        _sum_lanes(sums, time_range, k, first_moment)
        if second_moment.size > 0:
            _sum_lanes(squares, time_range, k, second_moment)


@cached_kernel(**OPTIONS)
def project_noise(kept: FloatArray, centre: FloatArray, along: FloatArray, across: FloatArray) -> None:
    """Inner products of every draw with a direction, and with that direction turned by 90 degrees.

    Args:
        kept: The noise that :func:`score_tiles` kept.
        centre: ``(H, K, P, 2)`` the direction.
        along: ``(K, T, DRAWS)``, output.
        across: ``(K, T, DRAWS)``, output.
    """
    num_tiles, num_robots, num_steps, num_pairs = kept.shape[0], kept.shape[1], kept.shape[2], kept.shape[3]
    along[:] = ZERO
    across[:] = ZERO
    for k in range(num_robots):
        for tile in range(num_tiles):
            for t in range(num_steps):
                for pair in range(num_pairs):
                    x, y = centre[t, k, pair, 0], centre[t, k, pair, 1]
                    for s in range(DRAWS):
                        first, second = kept[tile, k, t, pair, 0, s], kept[tile, k, t, pair, 1, s]
                        along[k, tile, s] += x * first + y * second
                        across[k, tile, s] += y * first - x * second
