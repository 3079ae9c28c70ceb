"""The rules of the sampling planners: noise schedules and weights, against numbers worked out by hand."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from d4orm_planners.sampling.settings import alpha_bar, annealed, constant
from d4orm_planners.sampling.weights import EliteWeights, GroupWeights, SoftmaxWeights

PAPER_BETAS = (1e-4, 2e-2)


def paper_product(steps: int) -> float:
    """Product of ``1 - beta`` over the first of 100 linearly rising variances."""
    product = 1.0
    for i in range(steps):
        product *= 1 - (1e-4 + i * (2e-2 - 1e-4) / 99)
    return product


def test_a_hundred_steps_are_the_plain_cumulative_product() -> None:
    expected = [paper_product(i) for i in range(1, 101)]
    np.testing.assert_allclose(alpha_bar(100, *PAPER_BETAS), expected, rtol=1e-12)


def test_the_papers_schedule_in_numbers() -> None:
    values = alpha_bar(100, *PAPER_BETAS)
    assert values[0] == pytest.approx(0.9999, abs=1e-12)
    assert values[1] == pytest.approx(0.9999 * (1 - 1e-4 - 0.0199 / 99), abs=1e-12)
    assert values[-1] == pytest.approx(0.363563, abs=1e-6)
    sigma = annealed(100, *PAPER_BETAS)
    assert sigma[0] == pytest.approx(1.3230847, abs=1e-6)
    assert sigma[-1] == pytest.approx(0.0100005, abs=1e-6)


def test_three_steps_interpolate_the_product_at_thirds() -> None:
    # A third of the way lies between the 33rd and the 34th of the hundred variances, a third of the way from the 33rd.
    first = paper_product(33) + (paper_product(34) - paper_product(33)) / 3
    second = paper_product(66) + (paper_product(67) - paper_product(66)) * 2 / 3
    np.testing.assert_allclose(alpha_bar(3, *PAPER_BETAS), [first, second, paper_product(100)], rtol=1e-12)
    np.testing.assert_allclose(alpha_bar(3, *PAPER_BETAS), [0.894113, 0.638479, 0.363563], atol=1e-6)


def test_three_steps_of_a_constant_variance_by_hand() -> None:
    # With beta = 0.01 throughout, alpha_bar after j of 100 steps is 0.99^j.
    first = 0.99**33 * (1 - 0.01 / 3)
    second = 0.99**66 * (1 - 0.02 / 3)
    np.testing.assert_allclose(alpha_bar(3, 0.01, 0.01), [first, second, 0.99**100], rtol=1e-12)
    np.testing.assert_allclose(
        annealed(3, 0.01, 0.01), [math.sqrt(1 / a - 1) for a in (0.99**100, second, first)], rtol=1e-6
    )


def test_more_steps_than_variances_interpolate_between_them() -> None:
    values = alpha_bar(200, 0.01, 0.01)
    assert values[0] == pytest.approx((1 + 0.99) / 2)
    assert values[1] == pytest.approx(0.99)
    assert values[-1] == pytest.approx(0.99**100)


@given(
    st.integers(1, 400),
    st.floats(1e-5, 1e-2, allow_subnormal=False),
    st.floats(1e-2, 0.2, allow_subnormal=False),
)
def test_sigma_falls_from_step_to_step(num_steps: int, beta_start: float, beta_end: float) -> None:
    sigma = annealed(num_steps, beta_start, beta_end)
    assert sigma.shape == (num_steps,)
    assert sigma.dtype == np.float32
    assert (sigma > 0).all()
    assert (np.diff(sigma) < 0).all()


@pytest.mark.parametrize("num_steps", [1, 3, 50, 100, 1000])
def test_the_largest_noise_does_not_depend_on_the_number_of_steps(num_steps: int) -> None:
    assert annealed(num_steps, *PAPER_BETAS)[0] == pytest.approx(math.sqrt(1 / paper_product(100) - 1), rel=1e-6)


def test_a_constant_schedule() -> None:
    np.testing.assert_array_equal(constant(3, 0.5), np.array([0.5, 0.5, 0.5], np.float32))
    assert constant(3, 0.5).dtype == np.float32


# Both libraries must satisfy every test of a rule: the engines call the same function with one or the other.
LIBRARIES = [pytest.param(np, id="numpy"), pytest.param(jnp, id="jax")]
RULES = [SoftmaxWeights(0.3), SoftmaxWeights(0.3, 1e-3), SoftmaxWeights(2.0), EliteWeights(0.05), EliteWeights(0.5)]


def weigh(rule: Any, rewards: Any, xp: Any) -> np.ndarray:
    return np.asarray(rule(xp.asarray(np.asarray(rewards, np.float32)), xp))


@pytest.mark.parametrize("xp", LIBRARIES)
def test_softmax_by_hand(xp: Any) -> None:
    # Mean 2 and deviation sqrt(2/3): the normalised rewards are -sqrt(1.5), 0 and sqrt(1.5).
    likelihoods = [math.exp(score / 0.5) for score in (-math.sqrt(1.5), 0, math.sqrt(1.5))]
    expected = [value / sum(likelihoods) for value in likelihoods]
    np.testing.assert_allclose(weigh(SoftmaxWeights(0.5), [1, 2, 3], xp), expected, rtol=1e-5)
    np.testing.assert_allclose(expected, [0.006815, 0.078934, 0.914251], atol=5e-6)


@pytest.mark.parametrize("xp", LIBRARIES)
def test_softmax_times_ratios_by_hand(xp: Any) -> None:
    # As above, times 1, 4 and 1/2; far from one the ratios must not overflow.
    ratios = np.log([1, 4, 0.5])
    expected = np.array([0.006815, 4 * 0.078934, 0.5 * 0.914251])
    for shift in (0, 200, -200):
        rewards, log_ratio = xp.asarray([[1.0, 2, 3, -np.inf]]), xp.asarray([[*(ratios + shift), 500.0]])
        weights = np.asarray(SoftmaxWeights(0.5)(rewards, xp, log_ratio))[0]
        np.testing.assert_allclose(weights, [*(expected / expected.sum()), 0], rtol=1e-4)


@pytest.mark.parametrize("xp", LIBRARIES)
def test_softmax_knows_neither_scale_nor_offset(xp: Any) -> None:
    rewards = np.array([0.1, 0.5, 0.2, 0.9], np.float32)
    plain = weigh(SoftmaxWeights(0.3), rewards, xp)
    np.testing.assert_allclose(weigh(SoftmaxWeights(0.3), 50 * rewards - 7, xp), plain, rtol=1e-4)


@pytest.mark.parametrize("xp", LIBRARIES)
def test_each_row_is_weighted_by_itself(xp: Any) -> None:
    rewards = np.random.default_rng(0).normal(size=(3, 40)).astype(np.float32)
    for rule in RULES:
        together = weigh(rule, rewards, xp)
        for row in range(3):
            np.testing.assert_allclose(together[row], weigh(rule, rewards[row], xp), rtol=1e-5)


@pytest.mark.parametrize("xp", LIBRARIES)
@pytest.mark.parametrize("rule", RULES, ids=repr)
def test_equal_rewards_share_equally(rule: Any, xp: Any) -> None:
    np.testing.assert_allclose(weigh(rule, np.full(20, 0.37), xp), np.full(20, 0.05), rtol=1e-5)


@pytest.mark.parametrize("xp", LIBRARIES)
@pytest.mark.parametrize("rule", RULES, ids=repr)
def test_a_sample_at_minus_infinity_does_not_count(rule: Any, xp: Any) -> None:
    rewards = [0.3, -np.inf, 0.9, 0.1, -np.inf, 0.7, 0.2, 0.4]
    weights = weigh(rule, rewards, xp)
    usable = np.isfinite(rewards)
    assert (weights[~usable] == 0).all()
    if isinstance(rule, SoftmaxWeights):
        np.testing.assert_allclose(weights[usable], weigh(rule, np.array(rewards)[usable], xp), rtol=1e-5)
    assert weights.sum() == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("xp", LIBRARIES)
@pytest.mark.parametrize("rule", RULES, ids=repr)
def test_when_every_sample_is_excluded_nothing_has_weight(rule: Any, xp: Any) -> None:
    np.testing.assert_array_equal(weigh(rule, np.full(8, -np.inf), xp), np.zeros(8))


@pytest.mark.parametrize("xp", LIBRARIES)
def test_the_cutoff_drops_what_is_negligible_and_nothing_else(xp: Any) -> None:
    rewards = np.linspace(0, 1, 200)
    whole, cut = weigh(SoftmaxWeights(0.3), rewards, xp), weigh(SoftmaxWeights(0.3, 0.01), rewards, xp)
    kept = whole >= 0.01 * whole.max()
    assert 0 < kept.sum() < len(rewards)
    np.testing.assert_array_equal(cut > 0, kept)
    np.testing.assert_allclose(cut[kept], whole[kept] / whole[kept].sum(), rtol=1e-4)


@pytest.mark.parametrize("xp", LIBRARIES)
def test_elite_by_hand(xp: Any) -> None:
    np.testing.assert_array_equal(weigh(EliteWeights(0.25), [5, 1, 8, 2, 3, 9, 4, 0], xp), [0, 0, 0.5, 0, 0, 0.5, 0, 0])
    # However small the share, somebody is elite.
    np.testing.assert_array_equal(weigh(EliteWeights(0.01), [5, 1, 8, 2], xp), [0, 0, 1, 0])


# Of a size that float32 tells apart whatever the order of a sum.
REWARDS = st.integers(-640, 640).map(lambda number: number / 64)


@pytest.mark.parametrize("rule", RULES, ids=repr)
@given(arrays.arrays(np.float32, (2, 16), elements=REWARDS | st.just(-np.inf)))
def test_weights_are_a_distribution_and_both_libraries_agree(rule: Any, rewards: np.ndarray) -> None:
    ours = weigh(rule, rewards, np)
    assert (ours >= 0).all()
    usable = np.isfinite(rewards).any(axis=1)
    np.testing.assert_allclose(ours.sum(axis=1), usable.astype(float), atol=1e-5)
    np.testing.assert_allclose(weigh(rule, rewards, jnp), ours, atol=1e-4)


# By groups.


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("rule", [SoftmaxWeights(0.3), EliteWeights(0.2)])
def test_a_group_weights_by_the_sum_of_its_rewards(rule: Any, xp: Any) -> None:
    rewards = np.random.default_rng(0).normal(size=(4, 50)).astype(np.float32)
    rewards[1, 7] = -np.inf
    weights = np.asarray(GroupWeights(rule, ((0, 2), (1, 3)))(xp.asarray(rewards), xp))
    together, others = (np.asarray(rule(xp.asarray(rewards[[i]] + rewards[[i + 2]]), xp))[0] for i in (0, 1))
    np.testing.assert_allclose(weights, [together, others, together, others], rtol=1e-5)
    assert weights[1, 7] == weights[3, 7] == 0 < weights[0, 7] + weights[0].sum()
    # Everybody alone is credit by robot; all in one group have the same weights, which are the team's.
    alone = GroupWeights(rule, ((0,), (1,), (2,), (3,)))(xp.asarray(rewards), xp)
    np.testing.assert_array_equal(alone, rule(xp.asarray(rewards), xp))
    team = np.asarray(GroupWeights(rule, ((0, 1, 2, 3),))(xp.asarray(rewards), xp))
    mean = xp.asarray(rewards.mean(axis=0, keepdims=True))
    np.testing.assert_allclose(team, np.tile(rule(mean, xp), (4, 1)), rtol=1e-4)
