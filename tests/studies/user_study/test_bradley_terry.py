"""Strengths against brute-force maximisation of the likelihood, and their intervals."""

import numpy as np
import pytest
from scipy import optimize, stats

from climatenerf.studies.user_study import bradley_terry
from climatenerf.studies.user_study.bradley_terry import (
    bootstrap_interval,
    log_strengths,
    resample,
    with_pseudo_votes,
)
from climatenerf.studies.user_study.preference import clopper_pearson

PLANTED = np.array([0.9, 0.2, -0.1, -0.4, -0.6])  # mean 0; the first is compared with all others
STAR = np.zeros((5, 5), bool)
STAR[0, 1:] = STAR[1:, 0] = True


def brute_force(wins):
    """Log-strengths of mean 0 that maximise the likelihood."""

    def loss(logs):
        return (wins * np.logaddexp(0, logs[None, :] - logs[:, None])).sum()

    found = optimize.minimize(loss, np.zeros(len(wins)), method="BFGS", options={"gtol": 1e-9})
    return found.x - found.x.mean()


@pytest.mark.parametrize("seed", range(4))
def test_strengths_maximise_the_likelihood(seed):
    draw = np.random.default_rng(seed)
    wins = draw.integers(1, 40, (5, 5)) * (1.0 - np.eye(5))
    assert log_strengths(wins) == pytest.approx(brute_force(wins), abs=1e-6)
    star = wins * STAR
    assert log_strengths(star) == pytest.approx(brute_force(star), abs=1e-6)


def test_two_methods_in_closed_form():
    wins = np.array([[0, 30.0], [10, 0]])
    assert log_strengths(wins) == pytest.approx([np.log(3) / 2, -np.log(3) / 2])


def test_batches_equal_single_fits():
    wins = np.random.default_rng(1).integers(1, 40, (7, 3, 3)) * (1.0 - np.eye(3))
    together = log_strengths(wins)
    for each, expected in zip(together, map(log_strengths, wins), strict=True):
        assert each == pytest.approx(expected, abs=1e-7)


def test_pseudo_votes_keep_a_method_that_wins_all_finite():
    wins = np.array([[0, 12.0, 3], [0, 0, 0], [4, 0, 0]])
    compared = wins + wins.T > 0
    smoothed = with_pseudo_votes(wins, compared)
    assert smoothed.tolist() == [[0, 12.5, 3.5], [0.5, 0, 0], [4.5, 0, 0]]
    logs = log_strengths(smoothed)
    assert logs[0] - logs[1] == pytest.approx(np.log(25))
    assert logs[0] - logs[2] == pytest.approx(np.log(3.5 / 4.5))


def test_bootstrap_samples_have_as_many_participants():
    weights = resample(9, 400, seed=3)
    assert weights.shape == (400, 9) and (weights.sum(1) == 9).all()
    assert weights.mean(0) == pytest.approx(1, abs=0.2) and weights.std() == pytest.approx(
        0.94, 0.1
    )
    assert (weights == resample(9, 400, seed=3)).all() != (weights == resample(9, 400, 4)).all()


def test_the_interval_of_a_normal_mean_equals_students():
    """Bootstrap means of n normal values spread by sqrt((n - 1) / n) of the standard error."""
    draw = np.random.default_rng(0)
    values = draw.normal(size=12)
    means = resample(12, 40_000, seed=1) @ values / 12
    low, high = bootstrap_interval(means, 12, 0.05)
    expected = stats.t.interval(0.95, 11, values.mean(), values.std(ddof=1) / np.sqrt(12))
    assert [low, high] == pytest.approx(expected, abs=0.06)
    assert high - low > 1.1 * np.subtract(*np.quantile(means, [0.975, 0.025]))
    assert bootstrap_interval(means, 1, 0.05) is None


def simulated(draw, people, votes):
    """Votes [people, 5, 5] of a study in which each judges every pair of the star `votes` times."""
    chance = 1 / (1 + np.exp(PLANTED[1:] - PLANTED[0]))
    won = draw.binomial(votes, chance, (people, 4))
    wins = np.zeros((people, 5, 5))
    wins[:, 0, 1:], wins[:, 1:, 0] = won, votes - won
    return wins


def test_intervals_cover_planted_strengths(monkeypatch):
    """37 participants with four votes on each of four comparisons, as in the paper's study."""
    monkeypatch.setattr(bradley_terry, "TOLERANCE", 1e-4)  # far below the intervals' width
    draw = np.random.default_rng(11)
    covered, errors = np.zeros(5), []
    for trial in range(100):
        wins = simulated(draw, 37, 4)
        drawn = np.einsum("bp,pij->bij", resample(37, 400, trial), wins)
        low, high = bootstrap_interval(log_strengths(with_pseudo_votes(drawn, STAR)), 37, 0.05)
        covered += (low <= PLANTED) & (high >= PLANTED)
        errors.append(log_strengths(with_pseudo_votes(wins.sum(0), STAR)) - PLANTED)
    assert (covered >= 90).all(), covered
    assert covered.sum() < 500, "intervals that always cover are too wide"
    # The difference of two strengths of the star is a logit, of variance 1 / (n p (1 - p)).
    chance = 1 / (1 + np.exp(PLANTED[1:] - PLANTED[0]))
    logits = np.hstack([np.zeros((4, 1)), -np.eye(4)])
    centred = (logits - logits.mean(1, keepdims=True)).T
    theory = (centred**2 / (148 * chance * (1 - chance))).sum(1)
    assert np.mean(np.square(errors)) == pytest.approx(theory.mean(), rel=0.2)


def test_intervals_by_participants_cover_where_those_of_votes_do_not():
    """Participants differ in their own shares (a beta distribution of mean .6)."""
    draw = np.random.default_rng(5)
    by_people = by_votes = 0
    for trial in range(100):
        won = draw.binomial(12, draw.beta(1.2, 0.8, 25))
        low, high = clopper_pearson(int(won.sum()), 300)
        by_votes += low <= 0.6 <= high
        low, high = bootstrap_interval(resample(25, 400, trial) @ won / 300, 25, 0.05)
        by_people += low <= 0.6 <= high
    assert by_people >= 90 and by_votes <= 70, (by_people, by_votes)
