"""Reading of votes and their scores: exclusions, duplicates, repeats and damaged files."""

import dataclasses
import json

import pytest

from climatenerf.core.errors import UserError
from climatenerf.studies.user_study.scores import score
from climatenerf.studies.user_study.votes import (
    COLUMNS,
    KeyPair,
    StudyKey,
    Vote,
    read_key,
    read_votes,
)

PAIRS = (
    KeyPair("a", "flood", "picture", "painter", "a1", "a2", False),
    KeyPair("b", "flood", "picture", "MK", "b1", "b2", False),
    KeyPair("c", "snow", "movie", "MK", "c1", "c2", False),
    KeyPair("n", "flood", "picture", None, "n1", "n2", True),
)
KEY = StudyKey("s1", "climatenerf", {pair.id: pair for pair in PAIRS})


def vote(participant, order, pair, *, first=True, left_first=True, repeat=False, choice=None):
    chosen = "left" if first == left_first else "right"
    shown = KEY.pairs[pair]
    left = shown.first if left_first else shown.second
    return Vote(participant, order, shown, left, choice or chosen, 900, repeat)


def row(vote, **other):
    right = ({vote.pair.first, vote.pair.second} - {vote.left}).pop()
    cells = [KEY.study, vote.participant, vote.order, vote.pair.id, vote.pair.kind,
             vote.pair.effect, "ditch, north", vote.left, right, vote.choice, vote.ms,
             int(vote.repeat), int(vote.pair.catch)]  # fmt: skip
    table = dict(zip(COLUMNS, cells, strict=True)) | other
    table["scene"] = '"ditch, north"'
    return ",".join(map(str, table.values()))


def write_votes(path, rows):
    path.write_bytes("\r\n".join([",".join(COLUMNS), *rows, ""]).encode())
    return path


def test_votes_count_for_their_comparison_whatever_the_side():
    votes = [
        vote(1, 1, "a"),
        vote(1, 2, "b", first=False, left_first=False),
        vote(1, 3, "c", left_first=False),
        vote(2, 1, "a", first=False),
        vote(2, 2, "b", left_first=False),
        vote(3, 1, "a", left_first=False),
    ]
    scores = score(votes, KEY, resamples=50)
    found = {(c.effect, c.kind, c.other): (c.ours.wins, c.ours.votes) for c in scores.comparisons}
    assert found == {
        ("flood", "picture", "MK"): (1, 2),
        ("flood", "picture", "painter"): (2, 3),
        ("snow", "movie", "MK"): (1, 1),
    }
    assert (scores.left.wins, scores.left.votes) == (2, 6)
    assert scores.participants == 3 and scores.unchecked == (1, 2, 3)
    strengths = {(s.effect, s.method): s.log_strength for s in scores.strengths}
    assert strengths["flood", "climatenerf"] - strengths["flood", "painter"] == pytest.approx(
        0.5108256, abs=1e-6  # log(2.5 / 1.5): two of three, and half a vote on each side
    )  # fmt: skip
    assert len(scores.strengths) == 5


def test_who_chose_noise_counts_nowhere():
    votes = [vote(1, 1, "a"), vote(1, 2, "n"), vote(1, 3, "a", repeat=True)]
    liar = [vote(2, 1, "a", first=False), vote(2, 2, "n"), vote(2, 3, "n", first=False)]
    liar.append(vote(2, 4, "a", repeat=True))
    scores = score([*votes, *liar], KEY, resamples=50)
    assert scores.participants == 2 and scores.excluded == (2,) and scores.unchecked == ()
    assert [(c.ours.votes, c.ours.wins) for c in scores.comparisons] == [(0, 0), (1, 1), (0, 0)]
    assert (scores.repeat_agreement.votes, scores.repeat_agreement.wins) == (1, 1)
    assert scores.left.votes == 1
    assert scores.comparisons[1].interval_of_participants is None, "one participant has no spread"


def test_a_catch_pair_that_no_browser_showed_excludes_nobody():
    scores = score([vote(1, 1, "a"), vote(1, 2, "n", choice="skipped")], KEY, resamples=50)
    assert scores.excluded == () and scores.unchecked == (1,)


def test_repeats_count_for_agreement_alone():
    votes = [vote(1, 1, "a"), vote(1, 2, "b"), vote(1, 3, "c")]
    again = [
        vote(1, 4, "a", left_first=False, repeat=True),
        vote(1, 5, "b", first=False, left_first=False, repeat=True),
        vote(1, 6, "c", choice="skipped", repeat=True),
    ]
    scores = score([*votes, *again], KEY, resamples=50)
    assert [c.ours.votes for c in scores.comparisons] == [1, 1, 1]
    assert (scores.repeat_agreement.votes, scores.repeat_agreement.wins) == (2, 1)
    assert scores.skipped == 1


def test_the_test_is_adjusted_for_the_comparisons_with_votes():
    votes = [vote(person, 1, "a") for person in range(1, 9)]
    votes += [vote(person, 2, "b") for person in range(1, 7)]
    scores = score(votes, KEY, resamples=50)
    by_other = {c.other: c for c in scores.comparisons if c.effect == "flood"}
    assert by_other["painter"].p == pytest.approx(2 / 2**8)
    assert by_other["painter"].p_holm == pytest.approx(2 * 2 / 2**8)
    assert by_other["MK"].p_holm == pytest.approx(2 / 2**6)


def test_no_votes_give_no_scores():
    scores = score([], KEY, resamples=50)
    assert scores.participants == 0 and scores.strengths == ()
    assert all(c.ours.share is None and c.p_holm == 1 for c in scores.comparisons)


def test_intervals_of_participants_are_repeatable_and_contain_the_share():
    votes = [vote(p, 1, "a", first=p % 3 > 0) for p in range(1, 31)]
    found = score(votes, KEY, seed=5).comparisons[1]
    assert found == score(votes, KEY, seed=5).comparisons[1]
    assert found != score(votes, KEY, seed=6).comparisons[1]
    low, high = found.interval_of_participants
    assert 0.4 < low < found.ours.share < high < 0.9


def test_bootstrap_samples_without_votes_for_a_comparison_are_left_out():
    """One of three participants judged pair b, so most samples miss that vote at times."""
    votes = [vote(1, 1, "b"), vote(1, 2, "b", first=False)]
    votes += [vote(person, 3, "a") for person in (1, 2, 3)]
    scores = score(votes, KEY, resamples=200)
    assert scores.comparisons[0].interval_of_participants == (0.5, 0.5)


def test_files_are_read_in_any_number_and_repeated_lines_count_once(tmp_path):
    votes = [vote(1, 1, "a"), vote(1, 2, "b", left_first=False), vote(2, 1, "c", first=False)]
    early = write_votes(tmp_path / "early.csv", [row(votes[0])])
    late = write_votes(tmp_path / "late.csv", [row(votes[1]), row(votes[0])])
    other = write_votes(tmp_path / "other.csv", [row(votes[2])])
    assert list(read_votes([other, late, early], KEY)) == votes
    other.write_bytes(b"\xef\xbb\xbf" + other.read_bytes())  # a spreadsheet saved it again
    assert list(read_votes([other], KEY)) == votes[2:]


def test_two_people_with_one_number_are_refused(tmp_path):
    one = write_votes(tmp_path / "one.csv", [row(vote(7, 1, "a"))])
    two = write_votes(tmp_path / "two.csv", [row(vote(7, 1, "a"), ms=901)])
    with pytest.raises(UserError, match=r"one\.csv and .*two\.csv .* number 1 of participant 7"):
        read_votes([one, two], KEY)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ({"study": "s2"}, "belongs to the study 's2', and the key to 's1'"),
        ({"pair": "z"}, "a pair that the key does not have"),
        ({"left": "b1"}, "a pair that the key does not have"),
        ({"right": "a1"}, "a pair that the key does not have"),
        ({"choice": "both"}, "the choice 'both'"),
        ({"participant": "0"}, "'0' as participant"),
        ({"participant": "x"}, "'x' as participant"),
        ({"participant": "9" * 5000}, "as participant"),
        ({"order": "1.5"}, "'1.5' as order"),
        ({"ms": "-1"}, "'-1' as ms"),
        ({"repeat": "2"}, "'2' as repeat"),
        ({"repeat": "١"}, "as repeat"),
        ({"catch": "1"}, "another value of catch"),
        ({"ms": "5,5"}, "has 14 values, not 13"),
    ],
)
def test_damaged_lines_are_refused_with_their_number(tmp_path, other, expected):
    lines = [row(vote(1, 1, "b")), row(vote(1, 2, "a"), **other)]
    path = write_votes(tmp_path / "votes.csv", lines)
    with pytest.raises(UserError, match=r"line 3 of .*votes\.csv") as error:
        read_votes([path], KEY)
    assert expected in str(error.value) and len(str(error.value)) < 400


@pytest.mark.parametrize("content", [b"", b"a,b\r\n", b"\0\1\2", b'"never ended', b"\xff\xfe1\0"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "votes.csv"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"votes\.csv"):
        read_votes([path], KEY)


def key_table():
    pairs = [{**dataclasses.asdict(pair), "scene": "ditch", "view": "0"} for pair in PAIRS]
    media = {name: {} for pair in PAIRS for name in (pair.first, pair.second)}
    return {"schema_version": 1, "study": "s1", "ours": "climatenerf", "pairs": pairs,
            "media": media}  # fmt: skip


def test_a_key_is_read(tmp_path):
    path = tmp_path / "key.json"
    path.write_text(json.dumps(key_table()))
    assert read_key(path) == KEY
    assert KEY.comparisons() == [
        ("flood", "picture", "MK"), ("flood", "picture", "painter"), ("snow", "movie", "MK")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda t: t.update(schema_version=2), "upgrade"),
        (lambda t: t.pop("study"), "has no study"),
        (lambda t: t["pairs"].append(5), "should be a table"),
        (lambda t: t["pairs"].append(t["pairs"][0]), "pair 4 in"),
        (lambda t: t["pairs"][0].update(other=None), "other in pair 0"),
        (lambda t: t["pairs"][0].update(catch=1), "catch in pair 0"),
        (lambda t: t["media"].pop("a2"), "pair 0 in"),
    ],
)
def test_a_damaged_key_is_refused(tmp_path, change, expected):
    table = key_table()
    change(table)
    path = tmp_path / "key.json"
    path.write_text(json.dumps(table))
    with pytest.raises(UserError, match=r"key\.json") as error:
        read_key(path)
    assert expected in str(error.value)
