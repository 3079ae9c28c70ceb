"""Paired tests and survival curves, against numbers worked out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from examples.common import holm
from examples.denoising import penalised_steps, steps_to_solution
from hypothesis import given, settings
from hypothesis import strategies as st
from trial_support import trial

from d4orm_planners.evaluation.comparison import newcombe_interval, paired, survival
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.summary import wilson_interval


def trials(costs: list[float | None], **changes: Any) -> list[Trial]:
    """A trial per cost, with seeds from 0 on; without a cost it fails."""
    return [trial(seed, success=cost is not None, wall_time=cost, **changes) for seed, cost in enumerate(costs)]


def spent(trial: Trial) -> float:
    return 100.0 if trial.wall_time is None else trial.wall_time


def test_the_tests_are_mcnemars_and_wilcoxons() -> None:
    first = trials([1, 2, 3, 4, 5, None, 7])
    second = trials([2, 4, 6, None, None, None, 10])
    found = paired(first, second, spent)
    assert (found.pairs, found.only_first, found.only_second) == (7, 2, 0)
    # Two discordant pairs, both one way: twice a quarter. Six differences of one sign: two of 2^6.
    assert found.success_p == pytest.approx(0.5)
    assert found.cost_p == pytest.approx(2 / 64)
    assert found.difference == -3
    turned = paired(second, first, spent)
    assert (turned.only_first, turned.only_second, turned.difference) == (0, 2, 3)
    assert (turned.success_p, turned.cost_p) == (found.success_p, found.cost_p)


def test_the_interval_of_a_difference_is_newcombes() -> None:
    # Worked out by hand: Wilson's 0.8654 to 0.9890 round 0.96 and 0.6259 to 0.8570 round 0.76; phi = -24 / 209.2
    assert newcombe_interval(36, 12, 2, 0) == pytest.approx((0.05690, 0.34040), abs=1e-4)
    # Without a pair that differs both rates are the same: as wide as Wilson's two, added as squares.
    low, high = newcombe_interval(4, 0, 0, 0)
    assert (low, high) == pytest.approx((wilson_interval(4, 4)[0] - 1, 1 - wilson_interval(4, 4)[0]))
    low, high = newcombe_interval(0, 4, 0, 0)
    assert 0 < low < 1
    assert high == pytest.approx(1)


@given(st.lists(st.integers(0, 30), min_size=4, max_size=4).filter(any))
def test_the_interval_of_a_difference_holds_it_and_turns_with_it(counts: list[int]) -> None:
    both, first, second, neither = counts
    low, high = newcombe_interval(*counts)
    assert -1 - 1e-9 <= low <= (first - second) / sum(counts) + 1e-12
    assert newcombe_interval(both, second, first, neither) == pytest.approx((-high, -low))


def test_what_success_is_may_be_said() -> None:
    first, second = trials([1, 2, None]), trials([3, 4, 5])
    assert paired(first, second, spent).only_second == 1
    found = paired(first, second, spent, lambda trial: spent(trial) < 5)
    assert (found.only_first, found.only_second) == (0, 0)
    found = paired(first, second, spent, lambda trial: spent(trial) < 3)
    assert (found.only_first, found.only_second, found.success_p) == (2, 0, 0.5)


def test_only_what_both_met_counts() -> None:
    first, second = trials([1, 2, None, 3]), trials([1, 2, None])[1:] + trials([5], problem="sphere")
    found = paired(first, second, spent)
    assert (found.pairs, found.success_p, found.cost_p, found.difference) == (2, 1, 1, 0)
    with pytest.raises(ValueError, match=r"no problem, seed and noise in common"):
        paired(first, trials([1], control_noise_std=0.1), spent)


def test_the_curve_falls_where_trials_are_solved_and_ends_with_those_that_never_are() -> None:
    curve = survival([3, 1, None, 2, 2, None])
    assert curve.costs.tolist() == [1, 2, 3]
    np.testing.assert_allclose(curve.unsolved, [5 / 6, 1 / 2, 1 / 3])
    assert (curve.lower[1], curve.upper[1]) == wilson_interval(3, 6)
    assert len(survival([None]).costs) == 0
    with pytest.raises(ValueError, match="no trials"):
        survival([])


@given(st.lists(st.one_of(st.none(), st.integers(1, 5)), min_size=1, max_size=30))
def test_a_curve_never_rises(costs: list[int | None]) -> None:
    curve = survival(costs)
    assert (np.diff(curve.costs) > 0).all()
    assert (np.diff(curve.unsolved, prepend=1.0) < 0).all()
    assert ((curve.lower <= curve.unsolved) & (curve.unsolved <= curve.upper)).all()
    if len(curve.unsolved):
        assert curve.unsolved[-1] == pytest.approx(costs.count(None) / len(costs))


@settings(max_examples=20)
@given(st.lists(st.tuples(*[st.one_of(st.none(), st.integers(1, 50))] * 2), min_size=1, max_size=60))
def test_who_is_compared_with_itself_differs_in_nothing(costs: list[tuple[int | None, int | None]]) -> None:
    first, second = (trials(list(column)) for column in zip(*costs, strict=True))
    same = paired(first, first, spent)
    assert (same.success_p, same.cost_p, same.difference) == (1, 1, 0)
    found = paired(first, second, spent)
    assert 0 <= found.success_p <= 1
    assert 0 <= found.cost_p <= 1


def test_steps_are_those_of_the_iterations() -> None:
    config = '{"num_steps": 50, "max_iterations": 20}'
    (found,) = trials([1.0], config=config, status="solved", iterations=3)
    (missed,) = trials([None], config=config, status="iteration_limit", iterations=20)
    assert (steps_to_solution(found), penalised_steps(found)) == (150, 150)
    assert (steps_to_solution(missed), penalised_steps(missed)) == (None, 2000)


def test_holm_multiplies_by_the_tests_that_are_left_and_never_turns_round() -> None:
    assert holm([0.01, 0.04, 0.03, 0.5]) == pytest.approx([0.04, 0.09, 0.09, 0.5])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []
