"""The CPU engine's second pass: weighted means of the noise that the first pass has kept."""

from __future__ import annotations

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, ZERO, aligned_zeros, compiled
from d4orm_env.engine.noise import DRAWS
from d4orm_env.engine.simd import add_turned, add_turned_squares, use_wide_registers


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
