"""The portable functions agree with NumPy's to a few ulp everywhere, and their bits are fixed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from d4orm_env.core import portable

TINY = 5e-324
EDGES = np.array(
    [
        *(0.0, TINY, 2.3e-308, 1e-200, 1e-9, 7 / 16, 11 / 16, 0.785398, 1.0, 19 / 16, np.pi / 2, 39 / 16, np.pi),
        *(2 * np.pi, 1e5, 1048575.9, 1048576.0, 1e22, 1e300, np.finfo(float).max),
    ]
)
SIGNED = np.concatenate([EDGES, -EDGES])


def spread(seed: int, low: float, high: float) -> np.ndarray:
    """Numbers of both signs, evenly spread over the magnitudes from 10**low to 10**high."""
    random = np.random.default_rng(seed)
    return random.choice([-1.0, 1.0], 20000) * 10 ** random.uniform(low, high, 20000)


def ulps(value: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference in units of the last place of what was expected; the same infinities and NaNs are none."""
    same = (value == expected) | (np.isnan(value) & np.isnan(expected))
    with np.errstate(invalid="ignore"):
        return float(np.max(np.where(same, 0.0, np.abs(value - expected) / np.spacing(np.abs(expected))), initial=0.0))


@pytest.mark.parametrize("name", ["sin", "cos"])
@pytest.mark.parametrize("x", [SIGNED, spread(0, -10, 2), spread(1, 0, 6), spread(2, 6, 20)[:2000]])
def test_sine_and_cosine_of_any_magnitude(name: str, x: np.ndarray) -> None:
    expected = np.array([getattr(math, name)(value) for value in x])
    assert ulps(getattr(portable, name)(x), expected) <= 2


def test_sine_and_cosine_next_to_multiples_of_half_pi() -> None:
    x = np.arange(-4000, 4000) * (np.pi / 2)
    x = np.concatenate([np.nextafter(x, -np.inf), x, np.nextafter(x, np.inf)])
    assert ulps(portable.sin(x), np.array([math.sin(value) for value in x])) <= 2
    assert ulps(portable.cos(x), np.array([math.cos(value) for value in x])) <= 2


@pytest.mark.parametrize("x", [SIGNED, spread(8, -8, 7)[:2000], np.arange(-100, 100) * (np.pi / 2)])
def test_one_number_has_the_same_sine_and_cosine_as_in_an_array(x: np.ndarray) -> None:
    alone = np.array([portable.sin_cos_of(value) for value in x.tolist()]).T
    assert alone.tobytes() == np.array(portable.sin_cos(x)).tobytes()


def test_the_number_closest_to_a_multiple_of_half_pi() -> None:
    # J.-M. Muller, Elementary Functions: the worst case of all float64 for the reduction of arguments.
    assert portable.cos(6381956970095103 * 2.0**797) == -4.68716592425462761112e-19


@pytest.mark.parametrize("x", [SIGNED, spread(3, -10, 2.84), np.linspace(-746, 710, 4001)])
def test_exponential(x: np.ndarray) -> None:
    with np.errstate(over="ignore"):
        assert ulps(portable.exp(x), np.exp(x)) <= 2


@pytest.mark.parametrize("x", [EDGES, np.abs(spread(4, -300, 300)), 1 + spread(5, -12, -0.1)])
def test_logarithm(x: np.ndarray) -> None:
    with np.errstate(divide="ignore"):
        assert ulps(portable.log(x), np.log(x)) <= 2


def test_arc_tangent_in_every_quadrant() -> None:
    y, x = spread(6, -8, 8), spread(7, -8, 8)
    assert ulps(portable.arctan2(y, x), np.arctan2(y, x)) <= 4
    corners = np.array([0.0, TINY, 1.0, 1e300, np.inf])
    corners = np.concatenate([corners, -corners])
    y, x = (side.ravel() for side in np.meshgrid(corners, corners))
    angle, expected = portable.arctan2(y, x), np.arctan2(y, x)
    assert ulps(angle, expected) <= 4
    np.testing.assert_array_equal(np.signbit(angle), np.signbit(expected))


def test_normal_numbers_are_those_of_box_and_muller() -> None:
    few = portable.standard_normal(np.random.default_rng(0), (5,))
    expected = [1.21496853, -0.62155869, -0.03716189, -0.17575347, 1.68164778]
    np.testing.assert_allclose(few, expected, rtol=1e-6)
    many = portable.standard_normal(np.random.default_rng(0), (4, 25_000))
    assert (many.shape, many.dtype) == ((4, 25_000), np.float32)
    # Moments of the normal distribution, and how much of it lies within one, two and three standard deviations.
    np.testing.assert_allclose([np.mean(many**power) for power in (1, 2, 3, 4)], [0, 1, 0, 3], atol=0.05)
    within = [np.mean(np.abs(many) < deviations) for deviations in (1, 2, 3)]
    np.testing.assert_allclose(within, [0.6827, 0.9545, 0.9973], atol=0.005)


def test_special_values() -> None:
    assert np.signbit(portable.sin(-0.0))
    assert portable.cos(0.0) == portable.exp(0.0) == portable.exp(-0.0) == 1
    assert portable.log(1.0) == 0
    assert portable.exp(np.array([np.inf, -np.inf])).tolist() == [np.inf, 0]
    assert portable.log(np.array([np.inf, 0.0])).tolist() == [np.inf, -np.inf]
    strange = [portable.sin(np.inf), portable.cos(-np.inf), portable.log(-1.0)]
    strange += [function(np.nan) for function in (portable.sin, portable.cos, portable.exp, portable.log)]
    strange += [portable.arctan2(np.nan, 1.0), portable.arctan2(1.0, np.nan)]
    assert np.isnan(strange).all()


def test_shapes_and_precisions() -> None:
    for function in (portable.sin, portable.cos, portable.exp, portable.log):
        x = np.linspace(0.1, 3, 24).reshape(2, 3, 4)
        assert function(x).shape == x.shape
        assert function(x).dtype == np.float64
        assert function(2).dtype == np.float64
        assert np.shape(function(0.5)) == ()
        assert function(x[:0]).shape == (0, 3, 4)
        np.testing.assert_array_equal(function(x[:, ::2, 1]), function(x)[:, ::2, 1])
        single = np.float32(x)
        np.testing.assert_array_equal(function(single), np.float32(function(np.float64(single))), strict=True)
    assert portable.arctan2(np.float32([1, 2]), np.float32(1)).dtype == np.float32
    assert portable.arctan2(np.float32([1, 2]), 1.0).dtype == np.float64
    assert portable.arctan2(np.ones((3, 1)), np.ones(4)).shape == (3, 4)


BITS = {
    "sin": [
        "0x1.2e9cd95baba33p-2",
        "0x1.d18f6ead1b446p-1",
        "-0x1.fb3f833470ff1p-6",
        "-0x1.687d5890974a5p-1",
        "-0x1.b453ab76bf397p-1",
    ],
    "cos": [
        "0x1.e921dd42f09bap-1",
        "-0x1.aa22657537205p-2",
        "0x1.ffc12adaecec2p-1",
        "0x1.6b94c3bbe24b8p-1",
        "0x1.0be2cef01c8f4p-1",
    ],
    "exp": ["0x1.7b4c869c37c05p-1", "0x1.152aaa3bf81ccp-3", "0x1.01a0e5643644fp-145"],
    "log": [
        "-0x1.34378fcbda721p+0",
        "0x1.62e42fefa39efp-1",
        "0x1.270cd2ff40ab2p+2",
        "0x1.2d79559791e31p+3",
        "0x1.95414621954fep+5",
    ],
    "arctan2": [
        "0x1.2a73a661eaf06p-2",
        "0x1.2d97c7f3321d2p+1",
        "0x1.ecc13312ce45ap-1",
        "0x1.9e409106b3904p-17",
        "0x1.2d97c7f3321d2p+1",
    ],
}


@pytest.mark.parametrize("name", BITS)
def test_the_bits_are_fixed(name: str) -> None:
    # Written down once: a processor on which they differ would judge plans differently.
    x = np.array([0.3, 2.0, 100.5, 12345.678, 1e22])
    arguments = {"exp": (-x[:3],), "arctan2": (x, np.array([1, -2, 70.0, 1e9, -1e22]))}.get(name, (x,))
    assert [value.hex() for value in getattr(portable, name)(*arguments).tolist()] == BITS[name]


def test_the_bits_of_arc_tangents_are_fixed_next_to_where_another_formula_begins() -> None:
    angles = {
        0.415: "0x1.92cfa0ab9bc1dp-2",
        0.44: "0x1.a8747d793c3dcp-2",
        2.427: "0x1.2e11f261169fbp+0",
        2.454: "0x1.2f1054d5d725ep+0",
    }
    assert {slope: portable.arctan2(slope, 1.0).hex() for slope in angles} == angles
