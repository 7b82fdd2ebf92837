"""Scores of a user study: exclusions, shares, tests, strengths, quality of the votes. No torch.

Votes of one participant depend on each other. The binomial tests ignore that; the bootstrap
intervals resample whole participants.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from climatenerf.studies.user_study.bradley_terry import (
    bootstrap_interval,
    log_strengths,
    resample,
    with_pseudo_votes,
)
from climatenerf.studies.user_study.preference import LEVEL, binomial_p, clopper_pearson, holm
from climatenerf.studies.user_study.votes import StudyKey, Vote

RESAMPLES = 2000
Interval = tuple[float, float]


@dataclass(frozen=True)
class Share:
    """A share of votes with its exact 95 % interval, which takes votes as independent."""

    votes: int
    wins: int
    share: float | None
    """None without votes."""
    interval: Interval


@dataclass(frozen=True)
class Comparison:
    """Votes for ours against one other method, for one effect and kind."""

    effect: str
    kind: str
    other: str
    ours: Share
    interval_of_participants: Interval | None
    """95 % interval of the share by bootstrap over participants; None for fewer than two."""
    p: float
    """Two-sided exact binomial test against one half."""
    p_holm: float
    """Adjusted for the number of comparisons."""


@dataclass(frozen=True)
class Strength:
    """Bradley-Terry strength of a method, for one effect and kind."""

    effect: str
    kind: str
    method: str
    log_strength: float
    """Natural logarithm; the methods of one effect and kind have mean 0."""
    interval: Interval | None
    """95 % interval by bootstrap over participants; None for fewer than two."""


@dataclass(frozen=True)
class Scores:
    """All that is known from the votes of a study."""

    study: str
    participants: int
    excluded: tuple[int, ...]
    """Participants who chose noise in a catch pair; their votes count nowhere."""
    unchecked: tuple[int, ...]
    """Counted participants who answered no catch pair."""
    skipped: int
    """Pairs that a browser could not show."""
    comparisons: tuple[Comparison, ...]
    strengths: tuple[Strength, ...]
    repeat_agreement: Share
    """Hidden repeats in which the same was chosen again."""
    left: Share
    """Votes for the left, or upper, side."""
    left_p: float
    """Two-sided exact binomial test of `left` against one half."""


def score(
    votes: Sequence[Vote], key: StudyKey, seed: int = 0, resamples: int = RESAMPLES
) -> Scores:
    """Return the scores of a study.

    Args:
        votes: all votes, also those of catch pairs and repeats.
        key: of the study.
        seed: random seed of the bootstrap.
        resamples: number of bootstrap samples.
    """
    people = sorted({vote.participant for vote in votes})
    catches = [vote for vote in votes if vote.pair.catch and vote.choice != "skipped"]
    excluded = {vote.participant for vote in catches if not vote.for_first}
    kept = [vote for vote in votes if vote.participant not in excluded and not vote.pair.catch]
    answered = [vote for vote in kept if vote.choice != "skipped"]
    counted = [vote for vote in answered if not vote.repeat]
    seen = sorted({vote.participant for vote in counted})
    lefts = share_of(counted, lambda vote: vote.choice == "left")
    checked = {vote.participant for vote in catches}
    weights = resample(len(seen), resamples, seed) if seen else np.zeros((resamples, 0))
    return Scores(
        study=key.study,
        participants=len(people),
        excluded=tuple(sorted(excluded)),
        unchecked=tuple(each for each in seen if each not in checked),
        skipped=len(kept) - len(answered),
        comparisons=_comparisons(counted, key, seen, weights),
        strengths=_strengths(counted, key, seen, weights),
        repeat_agreement=_agreement(answered),
        left=lefts,
        left_p=binomial_p(lefts.wins, lefts.votes),
    )


def share_of(votes: Sequence[Vote], wins: Callable[[Vote], bool]) -> Share:
    """Return the share of votes for which a condition holds."""
    won = sum(map(wins, votes))
    share = won / len(votes) if votes else None
    return Share(len(votes), won, share, clopper_pearson(won, len(votes)))


def _comparisons(
    counted: Sequence[Vote],
    key: StudyKey,
    people: Sequence[int],
    weights: Float[np.ndarray, "resamples people"],
) -> tuple[Comparison, ...]:
    names = key.comparisons()
    place = {each: index for index, each in enumerate(people)}
    table = np.zeros((len(people), len(names), 2))  # votes for ours, votes
    for vote in counted:
        table[place[vote.participant], names.index(vote.pair.comparison)] += (vote.for_first, 1)
    sums = np.einsum("bp,pck->bck", weights, table)
    with np.errstate(invalid="ignore"):  # a bootstrap sample without votes for a comparison: NaN
        drawn = sums[..., 0] / sums[..., 1]
    shares = [
        share_of([vote for vote in counted if vote.pair.comparison == name], lambda v: v.for_first)
        for name in names
    ]
    p_values = [binomial_p(each.wins, each.votes) for each in shares]
    tested = [index for index, each in enumerate(shares) if each.votes]
    adjusted = dict(zip(tested, holm([p_values[index] for index in tested]), strict=True))
    found = []
    for index, name in enumerate(names):
        voted = shares[index].votes > 0
        ends = bootstrap_interval(drawn[:, index], len(people), LEVEL) if voted else None
        interval = None if ends is None else (float(ends[0]), float(ends[1]))
        p = p_values[index]
        found.append(Comparison(*name, shares[index], interval, p, adjusted.get(index, 1.0)))
    return tuple(found)


def _strengths(
    counted: Sequence[Vote],
    key: StudyKey,
    people: Sequence[int],
    weights: Float[np.ndarray, "resamples people"],
) -> tuple[Strength, ...]:
    found = []
    for effect, kind in sorted({name[:2] for name in key.comparisons()}):
        votes = [vote for vote in counted if vote.pair.comparison[:2] == (effect, kind)]
        methods = [key.ours, *sorted({vote.pair.comparison[2] for vote in votes})]
        if len(methods) < 2:
            continue
        wins = _wins(votes, methods, people)
        compared = wins.sum(0) + wins.sum(0).T > 0
        logs = log_strengths(with_pseudo_votes(wins.sum(0), compared))
        drawn = np.einsum("bp,pij->bij", weights, wins)
        ends = bootstrap_interval(
            log_strengths(with_pseudo_votes(drawn, compared)), len(people), LEVEL
        )
        for index, method in enumerate(methods):
            span = None if ends is None else (float(ends[0, index]), float(ends[1, index]))
            found.append(Strength(effect, kind, method, float(logs[index]), span))
    return tuple(found)


def _wins(
    votes: Sequence[Vote], methods: Sequence[str], people: Sequence[int]
) -> Float[np.ndarray, "people m m"]:
    """Return each participant's number of votes for method i over j; ours is method 0."""
    place = {each: index for index, each in enumerate(people)}
    wins = np.zeros((len(people), len(methods), len(methods)))
    for vote in votes:
        other = methods.index(vote.pair.comparison[2])
        better, worse = (0, other) if vote.for_first else (other, 0)
        wins[place[vote.participant], better, worse] += 1
    return wins


def _agreement(answered: Sequence[Vote]) -> Share:
    first = {(vote.participant, vote.pair.id): vote for vote in answered if not vote.repeat}
    again = [vote for vote in answered if vote.repeat]
    again = [vote for vote in again if (vote.participant, vote.pair.id) in first]
    return share_of(
        again, lambda vote: vote.for_first == first[vote.participant, vote.pair.id].for_first
    )
