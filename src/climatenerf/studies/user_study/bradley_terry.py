"""Strengths of methods from votes between pairs of them (Bradley and Terry 1952). No torch.

Method i is preferred to j with probability p_i / (p_i + p_j). The maximum of the likelihood is
found by the minorisation-maximisation of Hunter (Annals of Statistics 32, 2004).
"""

import numpy as np
from jaxtyping import Float
from scipy import stats

PSEUDO_VOTES = 0.5
"""Added to the votes of each ordered pair that is compared; keeps strengths finite if one method
wins all votes."""
TOLERANCE = 1e-9
"""Largest change of a log-strength in the last iteration."""
MAX_ITERATIONS = 20_000


def log_strengths(wins: Float[np.ndarray, "*batch m m"]) -> Float[np.ndarray, "*batch m"]:
    """Return the natural logarithms of the strengths, with mean 0.

    Args:
        wins: [i, j] is the number of votes for i over j, > 0 for compared pairs (see
            `with_pseudo_votes`) and 0 for others. The compared pairs must connect all methods.
    """
    total = wins + np.swapaxes(wins, -1, -2)
    won = wins.sum(-1)
    logs = np.zeros(won.shape)
    for _ in range(MAX_ITERATIONS):
        strengths = np.exp(logs)
        expected = (total / (strengths[..., :, None] + strengths[..., None, :])).sum(-1)
        new = np.log(won / expected)
        new -= new.mean(-1, keepdims=True)
        change = np.abs(new - logs).max(initial=0.0)
        logs = new
        if change < TOLERANCE:
            break
    return logs


def with_pseudo_votes(wins: Float[np.ndarray, "*batch m m"], compared: np.ndarray) -> np.ndarray:
    """Return votes plus `PSEUDO_VOTES` for each ordered pair that is compared.

    Args:
        wins: number of votes for i over j.
        compared: [m, m], whether i and j are compared; symmetric, False on the diagonal.
    """
    return wins + PSEUDO_VOTES * compared


def resample(participants: int, resamples: int, seed: int) -> Float[np.ndarray, "resamples people"]:
    """Return how often each participant occurs in each bootstrap sample of participants."""
    draw = np.random.default_rng(seed)
    equal = np.full(participants, 1 / participants)
    return draw.multinomial(participants, equal, resamples).astype(np.float64)


def bootstrap_interval(
    values: Float[np.ndarray, "resamples *shape"], participants: int, level: float
) -> Float[np.ndarray, "2 *shape"] | None:
    """Return the expanded percentile interval of a statistic's bootstrap values.

    Plain percentiles are too narrow for few participants: they lack Student's t and the factor
    n / (n - 1) of a variance. The quantiles are moved out by both (Hesterberg, The American
    Statistician 69, 2015).

    Args:
        values: the statistic of each bootstrap sample; NaN where a sample has no votes for it.
        participants: number n that was resampled.
        level: probability outside the interval.

    Returns:
        Lower and upper ends; None for fewer than two participants.
    """
    if participants < 2:
        return None
    wider = np.sqrt(participants / (participants - 1))
    tail = float(stats.norm.cdf(-wider * stats.t.ppf(1 - level / 2, participants - 1)))
    return np.nanquantile(values, [tail, 1 - tail], axis=0)
