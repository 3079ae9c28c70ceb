"""The counter-based noise: truly Gaussian, independent along every index, pinned, and the same on every engine."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from engine_support import ENGINE_NAMES, NUMPY_BITS, SameWeights, engine_noise, open_problem, stream
from scipy import stats

from d4orm_env.engine import noise
from d4orm_planners.engine.sampling_types import SamplingRules, SamplingTask, get_sampling_engine

NUM_DRAWS = 1_000_000


def draws(count: int, first: int = 0, **names: int) -> np.ndarray:
    """``(2, count)`` float64: both components of a stream, for consecutive counters."""
    counters = np.arange(first, first + count, dtype=np.uint32)
    return np.array(noise.normal_pair(counters, stream(**names), NUMPY_BITS), np.float64)


@pytest.fixture(scope="module")
def million() -> np.ndarray:
    return draws(NUM_DRAWS // 2, seed=1).ravel()


def test_moments(million: np.ndarray) -> None:
    # Standard errors of the first six moments of a normal: sqrt(E[x^2k] - E[x^k]^2) / sqrt(n).
    for order, expected, deviation in (
        (1, 0, 1),
        (2, 1, 2**0.5),
        (3, 0, 15**0.5),
        (4, 3, 96**0.5),
        (6, 15, 10170**0.5),
    ):
        bound = 4 * deviation / NUM_DRAWS**0.5
        assert np.mean(million**order) == pytest.approx(expected, abs=bound), f"moment {order}"


def test_kolmogorov_smirnov_at_a_million_draws(million: np.ndarray) -> None:
    assert stats.kstest(million, "norm").pvalue > 0.01
    assert stats.kstest(np.abs(million), "halfnorm").pvalue > 0.01


@pytest.mark.parametrize("names", [{}, {"seed": 12345}, {"step": 99}, {"robot": 63}, {"time": 99}, {"pair": 1}])
def test_every_stream_is_normal(names: dict[str, int]) -> None:
    for component in draws(100_000, **names):
        assert stats.kstest(component, "norm").pvalue > 1e-3


def test_streams_across_indices_are_normal_too() -> None:
    """One sample of many streams, as a robot sees them along time: the keys must be as good as the counter."""
    indices = [(s, k, t) for s in range(5) for k in range(20) for t in range(50)]
    values = [draws(4, first=7, seed=3, step=s, robot=k, time=t) for s, k, t in indices]
    assert stats.kstest(np.concatenate(values, axis=None), "norm").pvalue > 0.01


@pytest.mark.parametrize("threshold", [1.0, 2.0, 3.0, 4.0, 4.5])
def test_tails(threshold: float) -> None:
    """Counts beyond a threshold, on each side, against the 0.1% bounds of the binomial distribution."""
    count = 2 * NUM_DRAWS
    values = draws(count, first=5_000_000, seed=2).ravel()
    for beyond in (values > threshold, values < -threshold):
        low, high = stats.binom.interval(0.998, values.size, stats.norm.sf(threshold))
        assert low <= beyond.sum() <= high


def test_the_farthest_draw_is_that_of_the_smallest_uniform() -> None:
    # Radii come from the centres of 2^23 cells of (0, 1): sqrt(-2 ln 2^-24) is the largest.
    assert np.abs(draws(NUM_DRAWS, seed=2)).max() < np.sqrt(48 * np.log(2))
    assert np.abs(draws(NUM_DRAWS, seed=2)).max() > 4.5


def correlations(first: np.ndarray, second: np.ndarray) -> list[float]:
    """Of the numbers, of their squares and of one with the other's square; each times the root of the sample size."""
    pairs = [(first, second), (first**2, second**2), (first, second**2), (first**2, second), (np.abs(first), second)]
    return [float(np.corrcoef(a, b)[0, 1]) * len(first) ** 0.5 for a, b in pairs]


VARIANTS: list[dict[str, int]] = [
    {"step": 1},
    {"step": 2},
    {"step": 50},
    {"robot": 1},
    {"robot": 2},
    {"robot": 32},
    {"time": 1},
    {"time": 2},
    {"time": 64},
    {"pair": 1},
    {"seed": 1},
    {"seed": 2},
    {"seed": 2**32},
    {"seed": 2**63},
    # Indices that could cancel if they were merely added.
    {"step": 1, "robot": 1},
    {"robot": 1, "time": 1},
    {"time": 1, "pair": 1},
    {"step": 1, "robot": 1, "time": 1},
]


@pytest.mark.parametrize("names", VARIANTS, ids=str)
def test_streams_are_uncorrelated(names: dict[str, int]) -> None:
    here, there = draws(200_000), draws(200_000, **names)
    for i in range(2):
        for j in range(2):
            assert np.abs(correlations(here[i], there[j])).max() < 4.5


@pytest.mark.parametrize(("names", "other"), [({"step": 1}, {"robot": 1}), ({"time": 1}, {"robot": 1})], ids=str)
def test_indices_are_not_interchangeable(names: dict[str, int], other: dict[str, int]) -> None:
    assert np.abs(correlations(draws(200_000, **names)[0], draws(200_000, **other)[0])).max() < 4.5


def test_components_are_independent() -> None:
    x, y = draws(NUM_DRAWS, seed=4)
    assert np.abs(correlations(x, y)).max() < 4.5
    # Their angle is uniform, also within thin rings, where a poor hash would show a pattern.
    radius, angle = np.hypot(x, y), np.arctan2(y, x) / (2 * np.pi) + 0.5
    assert stats.kstest(angle, "uniform").pvalue > 0.01
    for low, high in ((0.0, 0.2), (1.0, 1.1), (3.0, 9.0)):
        assert stats.kstest(angle[(radius >= low) & (radius < high)], "uniform").pvalue > 1e-3


@pytest.mark.parametrize("lag", [1, 2, 3, 4, 8, 16, 32, 64, 1024])
def test_samples_are_uncorrelated(lag: int) -> None:
    x, y = draws(400_000, seed=5)
    for a, b in ((x, x), (y, y), (x, y)):
        assert np.abs(correlations(a[:-lag], b[lag:])).max() < 4.5


def test_of_every_sixty_four_samples_sixteen_draw_and_the_others_turn_their_pairs() -> None:
    counters, cosine, sine = noise.turned(np.arange(200, dtype=np.uint32), NUMPY_BITS)
    assert counters[:128].tolist() == [*range(16)] * 4 + [*range(16, 32)] * 4
    assert cosine[:64].tolist() == [1] * 16 + [-1] * 16 + [0] * 32
    assert sine[:64].tolist() == [0] * 32 + [1] * 16 + [-1] * 16
    assert cosine[64:128].tolist() == cosine[:64].tolist()
    assert sine[64:128].tolist() == sine[:64].tolist()
    # No two samples share all three.
    assert len({(int(c), float(x), float(y)) for c, x, y in zip(counters, cosine, sine)}) == 200


def test_the_hash_is_a_bijection_with_full_avalanche() -> None:
    generator = np.random.default_rng(0)
    inputs = generator.integers(0, 2**32, 20_000, dtype=np.uint64).astype(np.uint32)
    key = np.uint32(0x12345678)
    consecutive = noise.hash32(np.arange(NUM_DRAWS, dtype=np.uint32), key, NUMPY_BITS)
    assert len(np.unique(consecutive)) == NUM_DRAWS
    plain = noise.hash32(inputs, key, NUMPY_BITS)
    for bit in range(32):
        changed = plain ^ noise.hash32(inputs ^ np.uint32(1 << bit), key, NUMPY_BITS)
        flips = [(changed >> np.uint32(i) & np.uint32(1)).mean() for i in range(32)]
        # Each output bit flips half the time: 20 000 trials have a standard error of 0.0035.
        np.testing.assert_allclose(flips, 0.5, atol=0.025)


def test_the_fitted_functions_are_as_accurate_as_they_say() -> None:
    u = np.concatenate([np.geomspace(2.0**-24, 1 - 2.0**-24, 100_000), np.linspace(0.5, 1 - 2.0**-24, 100_000)])
    u = u.astype(np.float32)
    exact = np.log(u.astype(np.float64))
    np.testing.assert_allclose(noise.log_unit(u, NUMPY_BITS), exact, rtol=3e-6)
    t = np.linspace(0, 1, 100_001, dtype=np.float32)
    np.testing.assert_allclose(noise.quarter_sine(t), np.sin(np.pi / 2 * t.astype(np.float64)), atol=2e-6)


def test_the_uniform_numbers_are_never_zero_or_one() -> None:
    ends = noise.unit_interval(np.array([0, 2**32 - 1], np.uint32), NUMPY_BITS)
    assert ends.tolist() == [2.0**-24, 1 - 2.0**-24]


def test_the_first_numbers_are_pinned() -> None:
    # Plans repeat with their seed from version to version as long as these stay.
    np.testing.assert_allclose(
        draws(4), [[0.149588, -0.979832, 0.098679, -1.830897], [0.872561, -2.074528, 0.208597, 0.946392]], atol=2e-6
    )
    np.testing.assert_allclose(
        draws(4, seed=7, step=3, robot=2, time=5, pair=1),
        [[-1.040721, -0.516734, 0.252307, 0.752934], [-1.280470, -0.953578, -0.044181, -0.570331]],
        atol=2e-6,
    )
    assert [int(word) for word in noise.seed_words(0)] == [2968811710, 3677149159]


@pytest.mark.parametrize("seed", [0, 1, 2**31, 2**32 - 1, 2**32, 2**64 - 1, 2**100])
def test_seeds_of_any_size(seed: int) -> None:
    low, high = noise.seed_words(seed)
    assert low.dtype == high.dtype == np.uint32
    assert (int(low), int(high)) == tuple(int(word) for word in noise.seed_words(seed))


def test_neighbouring_seeds_share_no_word() -> None:
    words = [int(word) for seed in range(1000) for word in noise.seed_words(seed)]
    assert len(set(words)) == len(words)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize(("dimension", "num_samples"), [(2, 200), (3, 77)])
def test_engines_draw_these_very_numbers(engine: str, dimension: int, num_samples: int) -> None:
    """With all weight on one sample per robot, what an engine returns is that sample's noise."""
    problem = open_problem(4, dimension, horizon=9)
    picked = (0, 33, 63, num_samples - 1)
    zeros = np.zeros((9, 4, problem.control_size), np.float32)
    task = SamplingTask(problem, zeros, credit="robot")
    rules = SamplingRules(SameWeights.picking(picked, num_samples))
    result = get_sampling_engine(engine).denoise(task, rules, zeros, np.ones(1, np.float32), num_samples, seed=6)
    expected = engine_noise(problem, 6, 0, num_samples)
    for robot, sample in enumerate(picked):
        np.testing.assert_allclose(result.mean[:, robot], expected[sample, :, robot], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_every_step_of_a_run_draws_anew(engine: str) -> None:
    """Three steps of one sample each add up their noise, every step with its own standard deviation."""
    problem = open_problem(2, horizon=5)
    zeros = np.zeros((5, 2, 2), np.float32)
    rules = SamplingRules(SameWeights.picking((40,), 64))
    sigma = np.array([1.0, 0.5, 0.25], np.float32)
    result = get_sampling_engine(engine).denoise(SamplingTask(problem, zeros), rules, zeros, sigma, 64, seed=2**40)
    expected: Any = sum(s * engine_noise(problem, 2**40, step, 64)[40] for step, s in enumerate(sigma))
    np.testing.assert_allclose(result.mean, expected, rtol=2e-6, atol=2e-6)
