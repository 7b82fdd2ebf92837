"""Shares, tests and sizes of votes against closed forms, brute force and scipy."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from climatenerf.studies.user_study.preference import (
    binomial_p,
    clopper_pearson,
    holm,
    power_of,
    share_shown,
    votes_needed,
)


@pytest.mark.parametrize(("wins", "votes"), [(0, 1), (3, 10), (74, 148), (97, 148), (148, 148)])
def test_the_interval_and_the_test_equal_scipys(wins, votes):
    test = stats.binomtest(wins, votes, 0.5)
    expected = test.proportion_ci(0.95, method="exact")
    assert clopper_pearson(wins, votes) == pytest.approx((expected.low, expected.high), abs=1e-12)
    assert binomial_p(wins, votes) == pytest.approx(test.pvalue, rel=1e-12)


def test_the_interval_in_closed_form():
    """Without a win the upper end u has (1 - u)^n = 2.5 %."""
    low, high = clopper_pearson(0, 12)
    assert low == 0 and (1 - high) ** 12 == pytest.approx(0.025)
    low, high = clopper_pearson(12, 12)
    assert high == 1 and low**12 == pytest.approx(0.025)
    assert clopper_pearson(0, 0) == (0, 1) and binomial_p(0, 0) == 1


def test_the_binomial_test_counts_outcomes_at_least_as_far_from_half():
    for wins in range(8):
        far = [k for k in range(8) if abs(2 * k - 7) >= abs(2 * wins - 7)]
        assert binomial_p(wins, 7) == pytest.approx(sum(math.comb(7, k) for k in far) / 2**7)


def test_the_interval_misses_a_share_at_most_in_five_percent():
    """Exactly, by summing over all outcomes of 30 votes."""
    for share in (0.05, 0.31, 0.5, 0.8):
        ends = [clopper_pearson(k, 30) for k in range(31)]
        inside = [low <= share <= high for low, high in ends]
        assert np.dot(stats.binom.pmf(np.arange(31), 30, share), inside) >= 0.95


def test_holm_on_known_values():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.5]) == [1.0, 1.0]
    assert holm([0.02]) == [0.02] and holm([]) == []


def test_holm_rejects_what_the_step_down_rule_rejects():
    draw = np.random.default_rng(4)
    for _ in range(50):
        p_values = list(draw.random(6) ** 3 / 4)
        rejected = set()
        for rank, index in enumerate(np.argsort(p_values)):
            if p_values[index] > 0.05 / (6 - rank):
                break
            rejected.add(int(index))
        assert {i for i, p in enumerate(holm(p_values)) if p <= 0.05} == rejected


def test_holm_keeps_the_family_wise_error_below_its_level():
    draw = np.random.default_rng(7)
    wrong = sum(min(holm(list(draw.random(12)))) <= 0.05 for _ in range(1000))
    assert 25 <= wrong <= 75


@pytest.mark.parametrize(
    ("share", "votes"), [(0.55, 807), (0.6, 210), (0.65, 92), (0.7, 54), (0.75, 35)]
)
def test_votes_for_eighty_percent_power(share, votes):
    assert votes_needed(share) == votes == votes_needed(1 - share)
    assert all(power_of(share, votes + more) >= 0.8 for more in range(4))
    assert not all(power_of(share, votes - 1 + more) >= 0.8 for more in range(4))


def test_the_power_sums_the_significant_outcomes():
    for votes, share in itertools.product((5, 6, 35, 92), (0.5, 0.65, 0.9)):
        significant = [k for k in range(votes + 1) if stats.binomtest(k, votes).pvalue <= 0.05]
        expected = stats.binom.pmf(significant, votes, share).sum()
        assert power_of(share, votes) == pytest.approx(expected, abs=1e-12)


def test_the_share_that_a_number_of_votes_shows():
    assert share_shown(148) == 0.62
    assert votes_needed(0.62) <= 148 < votes_needed(0.61)
    assert share_shown(2) is None and votes_needed(0.5) is None
