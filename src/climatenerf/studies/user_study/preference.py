"""Statistics of votes between two: shares, their intervals, tests and sizes. No torch.

A vote prefers one of two pictures. Under the null hypothesis each is preferred with probability
one half.
"""

from collections.abc import Sequence

import numpy as np
from scipy import stats

LEVEL = 0.05
"""Significance level of tests; intervals have one minus it."""
POWER = 0.8
MAX_VOTES = 1_000_000
_SPAN = 4


def clopper_pearson(wins: int, votes: int, level: float = LEVEL) -> tuple[float, float]:
    """Return the exact interval of a binomial share; (0, 1) without votes.

    Args:
        wins: votes for, 0 to `votes`.
        votes: number of votes.
        level: probability that the interval misses the share, at most.
    """
    low = 0.0 if wins == 0 else float(stats.beta.ppf(level / 2, wins, votes - wins + 1))
    high = 1.0 if wins == votes else float(stats.beta.ppf(1 - level / 2, wins + 1, votes - wins))
    return low, high


def binomial_p(wins: int, votes: int) -> float:
    """Return the two-sided p-value of the exact binomial test against one half."""
    return min(1.0, 2 * float(stats.binom.cdf(min(wins, votes - wins), votes, 0.5)))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number by Holm's step-down method, in the same order."""
    order = sorted(range(len(p_values)), key=lambda index: p_values[index])
    adjusted = [1.0] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted


def power_of(share: float, votes: int, level: float = LEVEL) -> float:
    """Return the probability that the two-sided binomial test against one half is significant.

    Args:
        share: true probability of a vote for, 0 to 1.
        votes: number of independent votes, > 0.
        level: significance level.
    """
    return float(_power(share, np.array([votes]), level)[0])


def votes_needed(share: float, level: float = LEVEL) -> int | None:
    """Return the number of votes that show a share with a power of `POWER`.

    The power of the exact test rises in a saw-tooth with the number of votes, mostly between odd
    and even ones. The result is the least number that reaches it along with the next three.

    Args:
        share: true probability of a vote for, 0 to 1.
        level: significance level.

    Returns:
        None if `MAX_VOTES` are not enough, such as for a share of one half.
    """
    effect = abs(share - 0.5)
    # The normal approximation bounds the search. An effect below this needs more than MAX_VOTES.
    if effect < 1e-3:
        return None
    z = stats.norm.ppf(1 - level / 2) + stats.norm.ppf(POWER)
    numbers = np.arange(1, int((z / (2 * effect)) ** 2 * 1.2) + 100)
    reached = _power(share, numbers, level) >= POWER
    runs = np.lib.stride_tricks.sliding_window_view(reached, _SPAN).all(1)
    return int(numbers[np.argmax(runs)]) if runs.any() and numbers[-1] <= MAX_VOTES else None


def share_shown(votes: float, level: float = LEVEL) -> float | None:
    """Return the least share above one half, in whole percents, that so many votes can show.

    Args:
        votes: number of independent votes.
        level: significance level.

    Returns:
        A share that needs at most `votes` by `votes_needed`; None if none does.
    """
    for percent in range(51, 101):
        needed = votes_needed(percent / 100, level)
        if needed is not None and needed <= votes:
            return percent / 100
    return None


def _power(share: float, votes: np.ndarray, level: float) -> np.ndarray:
    """Return `power_of` for an array of numbers of votes."""
    critical = stats.binom.ppf(level / 2, votes, 0.5)  # the least c with P(X <= c) >= level / 2
    critical -= stats.binom.cdf(critical, votes, 0.5) > level / 2
    low = stats.binom.cdf(critical, votes, share)
    return low + stats.binom.sf(votes - critical - 1, votes, share)
