"""Gaussian noise from a counter: the same numbers for the same (seed, step, sample, robot, time), on any engine, in any
order, on any number of threads, with nothing stored.

A 64-bit stream key stands for (seed, step, robot, time, pair of components). The sample number is the counter: it is
shared between samples (see :func:`turned`), mixed with the key by a 32-bit integer hash (three multiplications,
xor-shifts between them, with full avalanche), and the Box-Muller transform turns the hash into two independent normals.
Written in scalar style like the models.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core.portable import Real
from d4orm_env.dynamics.robot_model import N

Word: TypeAlias = Any
"""32 bits as a library has them: a whole number, or an array of them."""


class BitOps(NamedTuple):
    """Bit operations that the noise needs from whichever library compiles it."""

    uint32: Callable[..., Word]
    """Wrap to 32 bits."""
    int32: Callable[..., Word]
    """The same bits as a signed number."""
    to_float: Callable[..., Real]
    """Convert an int32 to float32."""
    float_bits: Callable[..., Word]
    """The int32 with the bits of a float32."""
    bits_float: Callable[..., Real]
    """The float32 with the bits of an int32."""
    sqrt: Callable[..., Real]


def _u(value: int) -> np.uint32:
    return np.uint32(value)


MULTIPLIER_1, MULTIPLIER_2, MULTIPLIER_3 = _u(0xED5AD4BB), _u(0xAC4C1B51), _u(0x31848BAB)
MULTIPLIER_ANGLE, GOLDEN = _u(0x846CA68B), _u(0x9E3779B9)
S9, S11, S14, S15, S16, S17 = _u(9), _u(11), _u(14), _u(15), _u(16), _u(17)
SIGN_BIT, S30, S31 = _u(0x80000000), _u(30), _u(31)
S4, S5, S6, LOW_BIT, LOW_4_BITS = _u(4), _u(5), _u(6), _u(1), _u(15)
TURNS = 4
DRAWS = 16
"""Samples that share a pair of normals, and pairs drawn for every 64 samples."""

HALF, ONE, MINUS_TWO = np.float32(0.5), np.float32(1), np.float32(-2)
TWO_TO_MINUS_23 = np.float32(2.0**-23)
SQRT_HALF_BITS = np.int32(0x3F3504F3)
EXPONENT_SHIFT = np.int32(23)
LN2 = np.float32(np.log(2))

# Fitted: log(1 + f) = f * P(f) on [sqrt(1/2) - 1, sqrt(2) - 1] to 5e-7, sin(pi/2 t) = t * Q(t^2) on [0, 1] to 2e-6.
P0, P1, P2, P3 = (
    np.float32(1.0000017240),
    np.float32(-0.5000243878),
    np.float32(0.3330756453),
    np.float32(-0.2485827128),
)
P4, P5, P6 = np.float32(0.2055282466), np.float32(-0.1910518105), np.float32(0.1220986040)
Q0, Q1, Q2, Q3 = (
    np.float32(1.5707963253),
    np.float32(-0.6459270505),
    np.float32(0.0794877072),
    np.float32(-0.0043569856),
)


def xor_shift(x: Word, positions: np.uint32, ops: BitOps) -> Word:
    """``x ^ (x >> positions)``; wrapped after every operation, because numba widens 32-bit integers to 64."""
    return ops.uint32(x ^ ops.uint32(x >> positions))


def hash32(x: Word, key: Word, ops: BitOps) -> Word:
    """A bijection of 32-bit ``x`` for every ``key``, with full avalanche."""
    x = ops.uint32(xor_shift(x, S17, ops) * MULTIPLIER_1)
    x = ops.uint32(x ^ key)
    x = ops.uint32(xor_shift(x, S11, ops) * MULTIPLIER_2)
    x = ops.uint32(xor_shift(x, S15, ops) * MULTIPLIER_3)
    return xor_shift(x, S14, ops)


def stream_key(
    seed_low: Word, seed_high: Word, step: Word, robot: Word, time: Word, pair: Word, ops: BitOps
) -> tuple[Word, Word]:
    """The two 32-bit keys of one stream; the arguments are uint32."""
    a = hash32(ops.uint32(seed_low + GOLDEN), seed_high, ops)
    a = hash32(ops.uint32(a + step), robot, ops)
    a = hash32(ops.uint32(a ^ time), pair, ops)
    b = hash32(ops.uint32(a + GOLDEN), ops.uint32(seed_low ^ step), ops)
    return a, b


def normal_pair(sample: Word, key: tuple[Word, Word], ops: BitOps) -> tuple[Real, Real]:
    """Two independent standard normals for sample number ``sample`` (uint32) of a stream."""
    first = hash32(ops.uint32(ops.uint32(sample * GOLDEN) ^ key[0]), key[1], ops)
    second = xor_shift(ops.uint32(xor_shift(first, S16, ops) * MULTIPLIER_ANGLE), S15, ops)
    radius = ops.sqrt(MINUS_TWO * log_unit(unit_interval(first, ops), ops))
    # A point of the first quarter of the circle, and two more bits for the signs.
    turn = unit_interval(second, ops)
    x = with_sign(radius * quarter_sine(turn), ops.uint32(second << S30), ops)
    y = with_sign(radius * quarter_sine(ONE - turn), ops.uint32(second << S31), ops)
    return x, y


def turned(sample: Word, ops: BitOps) -> tuple[Word, Real, Real]:
    """``(counter, cosine, sine)`` of a sample (uint32): of every 64 samples the first 16 draw pairs of normals, and
    the others turn them by 180, 90 and 270 degrees.

    The pair of a sample is ``(cosine * x - sine * y, sine * x + cosine * y)`` of the normals ``(x, y)`` of its counter,
    which is as normal as they are. So a sample costs a quarter of the noise; the deformations that share it are
    mirrored (the odd part of the sampling error cancels) or at right angles to each other.
    """
    counter = ops.uint32(ops.uint32(ops.uint32(sample >> S6) << S4) + ops.uint32(sample & LOW_4_BITS))
    mirrored = ops.to_float(ops.int32(ops.uint32(sample >> S4) & LOW_BIT))
    upright = ops.to_float(ops.int32(ops.uint32(sample >> S5) & LOW_BIT))
    sign = ONE + MINUS_TWO * mirrored
    return counter, sign * (ONE - upright), sign * upright


def unit_interval(bits: Word, ops: BitOps) -> Real:
    """The centre of one of 2^23 equal cells of (0, 1), chosen by the upper bits."""
    return (ops.to_float(ops.int32(bits >> S9)) + HALF) * TWO_TO_MINUS_23


def quarter_sine(t: N) -> N:
    """``sin(pi / 2 * t)`` for ``t`` from 0 to 1."""
    t2 = t * t
    return t * (Q0 + t2 * (Q1 + t2 * (Q2 + t2 * Q3)))


def with_sign(magnitude: N, bits: Word, ops: BitOps) -> N:
    """``magnitude`` with the sign in the highest of ``bits``."""
    return ops.bits_float(ops.int32(ops.float_bits(magnitude) ^ ops.int32(bits & SIGN_BIT)))


def log_unit(u: N, ops: BitOps) -> N:
    """Natural logarithm of ``u`` in (0, 1)."""
    bits = ops.float_bits(u)
    exponent = ops.int32(ops.int32(bits - SQRT_HALF_BITS) >> EXPONENT_SHIFT)
    mantissa = ops.int32(bits - ops.int32(exponent << EXPONENT_SHIFT))
    f = ops.bits_float(mantissa) - ONE
    polynomial = P0 + f * (P1 + f * (P2 + f * (P3 + f * (P4 + f * (P5 + f * P6)))))
    return ops.to_float(exponent) * LN2 + f * polynomial


def seed_words(seed: int) -> tuple[np.uint32, np.uint32]:
    """A non-negative seed folded into two 32-bit words."""
    low, high = np.random.SeedSequence(seed).generate_state(2, np.uint32)
    return low, high
