"""Reading of a study's key and of the CSV files of votes that its page exports. No torch."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from climatenerf.core.errors import UserError, excerpt
from climatenerf.core.parsing import entries, flag, items, read_bytes, read_json, text
from climatenerf.core.storage import check_schema
from climatenerf.core.text import decode
from climatenerf.studies.user_study.page import SCHEMA_VERSION

COLUMNS = ("study", "participant", "order", "pair", "kind", "effect", "scene", "left", "right",
           "choice", "ms", "repeat", "catch")  # fmt: skip
CHOICES = ("left", "right", "skipped")
MAX_BYTES = 64 * 2**20
MAX_NUMBER = 2**53
"""Of participants and milliseconds: the largest whole number that the page's numbers hold."""


@dataclass(frozen=True)
class KeyPair:
    """A pair of a study, with what is behind it."""

    id: str
    effect: str
    kind: str
    other: str | None
    """Method of `second`; None for a catch pair."""
    first: str
    """Id of our picture or movie; of a catch pair, the clean picture."""
    second: str
    catch: bool

    @property
    def comparison(self) -> tuple[str, str, str]:
        """What a vote counts for: effect, kind, other method."""
        return self.effect, self.kind, self.other or ""


@dataclass(frozen=True)
class StudyKey:
    """The key of a study."""

    study: str
    ours: str
    pairs: dict[str, KeyPair]

    def comparisons(self) -> list[tuple[str, str, str]]:
        """Return all (effect, kind, other method) of the study, sorted."""
        return sorted({pair.comparison for pair in self.pairs.values() if not pair.catch})


@dataclass(frozen=True)
class Vote:
    """One answer of a participant."""

    participant: int
    order: int
    """Position among the participant's trials, from 1."""
    pair: KeyPair
    left: str
    """Id of what was on the left, or above on an upright phone."""
    choice: str
    """"left", "right" or "skipped"."""
    ms: int
    repeat: bool

    @property
    def for_first(self) -> bool:
        """Whether the first of the pair was chosen; False if the pair was skipped."""
        return self.choice == ("left" if self.left == self.pair.first else "right")


def read_key(path: Path) -> StudyKey:
    """Read the `key.json` of a study.

    Raises:
        UserError: it cannot be read, or is no key.
    """
    where = str(path)
    table = read_json(path, "key of a study")
    check_schema(table.get("schema_version"), SCHEMA_VERSION, f"key {path}")
    media = entries(table, "media", where)
    pairs = {}
    for number, entry in enumerate(items(table, "pairs", where)):
        pair = _key_pair(entry, f"pair {number} in {where}")
        if pair.id in pairs or not {pair.first, pair.second} <= media.keys():
            raise UserError(f"pair {number} in {where} is damaged; restore the file")
        pairs[pair.id] = pair
    return StudyKey(text(table, "study", where), text(table, "ours", where), pairs)


def _key_pair(entry: Any, where: str) -> KeyPair:
    words = {name: text(entry, name, where) for name in ("id", "effect", "kind", "first", "second")}
    catch = flag(entry, "catch", where)
    other = text(entry, "other", where, default=None)
    if not catch and other is None:
        raise UserError(f"other in {where} is missing; restore the file")
    return KeyPair(other=other, catch=catch, **words)


def read_votes(paths: Sequence[Path], key: StudyKey) -> tuple[Vote, ...]:
    """Read votes from CSV files; a vote that several files hold alike counts once.

    Args:
        paths: files, each with the votes of one or more participants.
        key: of the study.

    Raises:
        UserError: a file cannot be read, is of another study, or has a value that cannot be; or two
            files have different votes under one participant's number.
    """
    found: dict[tuple[int, int], tuple[Vote, Path]] = {}
    for path in paths:
        for vote in _votes_of(path, key):
            place = (vote.participant, vote.order)
            known, source = found.setdefault(place, (vote, path))
            if known != vote:
                raise UserError(
                    f"{source} and {path} hold different votes number {vote.order} of participant"
                    f" {vote.participant}; two people had one number: leave one of them out"
                )
    return tuple(vote for _, (vote, _) in sorted(found.items(), key=lambda entry: entry[0]))


def _votes_of(path: Path, key: StudyKey) -> Iterable[Vote]:
    content = decode(read_bytes(path, "votes", MAX_BYTES), f"votes: {path}")
    rows = csv.reader(io.StringIO(content, newline=""), strict=True)
    try:
        header = next(rows, [])
        if tuple(header) != COLUMNS:
            raise UserError(
                f"votes: {path} does not begin with the columns {','.join(COLUMNS)}; give the file"
                " as the page saved it"
            )
        for row in rows:
            if row:
                yield _vote(row, key, f"line {rows.line_num} of {path}")
    except csv.Error as error:
        raise UserError(
            f"votes: {path} is no CSV file ({error}, line {rows.line_num}); give the file as the"
            " page saved it"
        ) from error


def _vote(row: Sequence[str], key: StudyKey, where: str) -> Vote:
    if len(row) != len(COLUMNS):
        raise _wrong(where, f"has {len(row)} values, not {len(COLUMNS)}")
    cell: dict[str, str] = dict(zip(COLUMNS, row, strict=True))
    if cell["study"] != key.study:
        raise UserError(
            f"{where} belongs to the study {excerpt(cell['study'])}, and the key to"
            f" {excerpt(key.study)}; give that study's key with --key"
        )
    pair = key.pairs.get(cell["pair"])
    if pair is None or {cell["left"], cell["right"]} != {pair.first, pair.second}:
        raise _wrong(where, "has a pair that the key does not have")
    if cell["choice"] not in CHOICES:
        raise _wrong(where, f"has the choice {excerpt(cell['choice'])}")
    participant, order, ms = (
        _whole(cell[name], name, where, low)
        for name, low in (("participant", 1), ("order", 1), ("ms", 0))
    )
    repeat, catch = (_whole(cell[name], name, where, 0, 1) == 1 for name in ("repeat", "catch"))
    if catch != pair.catch:
        raise _wrong(where, "has another value of catch than the key")
    return Vote(participant, order, pair, cell["left"], cell["choice"], ms, repeat)


def _whole(value: str, name: str, where: str, low: int, high: int = MAX_NUMBER) -> int:
    """Return a cell as a whole number from `low` to `high`."""
    if value.isascii() and value.isdigit() and len(value) <= 16 and low <= int(value) <= high:
        return int(value)
    raise _wrong(where, f"has {excerpt(value)} as {name}")


def _wrong(where: str, what: str) -> UserError:
    return UserError(f"{where} {what}; give the file as the page saved it")
