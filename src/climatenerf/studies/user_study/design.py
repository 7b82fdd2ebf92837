"""The pairs of a user study, after the paper's protocol: ours against every other method. No torch.

What participants see goes by opaque ids. The plan of each participant (order, sides, repeats) is
computed in the page, from hashes of study and participant.
"""

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from climatenerf.core.errors import UserError, excerpt
from climatenerf.studies.user_study.compare_folder import CompareFolder, Item

VOTES = 72
"""Pairs that a participant judges by default, as in the paper."""
MAX_VOTES = 1000
REPEATS = 3
"""Hidden repeats with exchanged sides."""
CATCHES = 2
"""Pairs of a clean and a noisy picture."""


@dataclass(frozen=True)
class Pair:
    """Two pictures or movies that are compared."""

    id: str
    first: Item
    """By the method that the others are compared with."""
    second: Item

    @property
    def comparison(self) -> tuple[str, str, str]:
        """What a vote counts for: effect, kind, other method."""
        return self.second.effect, self.second.kind, self.second.method


@dataclass(frozen=True)
class Study:
    """The pairs of a study."""

    folders: tuple[CompareFolder, ...]
    pairs: tuple[Pair, ...]
    """In the order of their ids."""
    alone: int
    """Number of pictures and movies without a counterpart."""
    seed: int
    votes: int
    """Pairs that a participant judges; hidden repeats and catch pairs are added."""

    def votes_by_comparison(self) -> dict[tuple[str, str, str], float]:
        """Return each comparison's votes by one participant, on average."""
        sizes = Counter(pair.comparison for pair in self.pairs)
        return dict(zip(sizes, share_turns(list(sizes.values()), self.votes), strict=True))

    def sources(self) -> tuple[list[str], list[str]]:
        """Return scenes with their licence lines, and scenes whose line names a method."""
        shown, hidden = [], []
        for folder in self.folders:
            if folder.licence and names_a_method(folder.licence, self.folders):
                hidden.append(folder.scene)
            elif folder.licence:
                shown.append(f"{folder.scene}: {folder.licence}")
        return shown, hidden

    def media(self) -> dict[str, Item]:
        """Return all pictures and movies of the pairs by their opaque ids."""
        return {
            self.medium_id(item): item for pair in self.pairs for item in (pair.first, pair.second)
        }

    def medium_id(self, item: Item) -> str:
        """Return the opaque id of a picture or movie."""
        return opaque(self.seed, "medium", *_place(item))

    def catch_items(self) -> list[Item]:
        """Return what catch pairs are made of: our pictures, as far as there are, or movies."""
        own = {self.medium_id(pair.first): pair.first for pair in self.pairs}
        best = sorted(own.items(), key=lambda entry: (entry[1].kind != "picture", entry[0]))
        return [best[number % len(best)][1] for number in range(CATCHES)]


def share_turns(sizes: Sequence[int], votes: int) -> list[float]:
    """Return how many votes each group gets if groups of these sizes take turns.

    In the last round, which may not be complete, each group that is left is equally likely.
    """
    given = [0.0] * len(sizes)
    left = min(votes, sum(sizes))
    for turn in range(max(sizes, default=0)):
        waiting = [group for group, size in enumerate(sizes) if size > turn]
        for group in waiting:
            given[group] += min(1.0, left / len(waiting))
        left = max(0, left - len(waiting))
    return given


def plan_study(
    folders: Sequence[CompareFolder],
    seed: int = 0,
    votes: int = VOTES,
    without: Sequence[str] = (),
) -> Study:
    """Pair our pictures and movies with those of every other method.

    Args:
        folders: one for each scene.
        seed: changes ids, and with them order and sides.
        votes: pairs that a participant judges, at most; 1 to `MAX_VOTES`.
        without: names of other methods that are left out.

    Raises:
        UserError: a method to leave out does not exist or is ours, two folders have the same scene,
            our method has two names, nothing can be paired, or a scene or effect, which the page
            shows, names a method.
    """
    if not folders:
        raise UserError("no comparison is given; give folders that `climatenerf compare` wrote")
    if not 1 <= votes <= MAX_VOTES:
        raise UserError(f"--votes must lie between 1 and {MAX_VOTES}; got {votes}")
    for scene, count in Counter(each.scene for each in folders).items():
        if count > 1:
            raise UserError(f"{count} folders show the scene {scene}; give one for each scene")
    names = sorted({folder.ours for folder in folders})
    if len(names) > 1:
        raise UserError(
            f"the method of kind ours has several names ({', '.join(names)}); make the comparisons"
            " with the same one"
        )
    folders = _left_out(folders, without)
    _refuse_named_methods(folders)
    paired = [_pairs_of(folder, seed) for folder in folders]
    pairs = [pair for found, _ in paired for pair in found]
    alone = sum(left for _, left in paired)
    if not pairs:
        raise UserError(
            "nothing can be paired: no other method has a picture or movie of the same effect and"
            " view as ours; make the comparison with another method"
        )
    ordered = tuple(sorted(pairs, key=lambda pair: pair.id))
    return Study(tuple(folders), ordered, alone, seed, min(votes, len(ordered)))


def opaque(seed: int, *words: str) -> str:
    """Return a short id that shows nothing of what it stands for."""
    return digest([str(seed), *words])[:10]


def digest(words: Iterable[str]) -> str:
    """Return a hash of words."""
    return hashlib.sha256(json.dumps(list(words)).encode()).hexdigest()


def _left_out(folders: Sequence[CompareFolder], without: Sequence[str]) -> list[CompareFolder]:
    """Return the folders without some methods."""
    others = {method.name for folder in folders for method in folder.methods} - {folders[0].ours}
    unknown = sorted(set(without) - others)
    if unknown:
        raise UserError(
            f"--without: there is no method {excerpt(unknown[0])} to leave out; use one of"
            f" {', '.join(sorted(others))}"
        )
    return [
        replace(
            folder,
            methods=tuple(each for each in folder.methods if each.name not in without),
            items=tuple(each for each in folder.items if each.method not in without),
        )
        for folder in folders
    ]


def _pairs_of(folder: CompareFolder, seed: int) -> tuple[list[Pair], int]:
    """Return the pairs of a scene, and the number of items without a counterpart."""
    own, others = {}, []
    for item in folder.items:
        if item.method == folder.ours:
            own[item.effect, item.kind, item.view] = item
        else:
            others.append(item)
    pairs = []
    for item in others:
        first = own.get((item.effect, item.kind, item.view))
        if first is not None:
            pairs.append(Pair(opaque(seed, "pair", *_place(item)), first, item))
    used = {pair.first for pair in pairs}
    return pairs, len(others) - len(pairs) + len(own) - len(used)


def names_a_method(text: str, folders: Sequence[CompareFolder]) -> str | None:
    """Return a method whose name a text has as whole words, in any case; None if there is none."""
    for method in sorted({method.name for folder in folders for method in folder.methods}):
        if re.search(rf"(?<!\w){re.escape(method)}(?!\w)", text, re.IGNORECASE):
            return method
    return None


def _refuse_named_methods(folders: Sequence[CompareFolder]) -> None:
    """Refuse scenes and effects, which the page shows, that name a method."""
    for folder in folders:
        shown = {"scene": {folder.scene}, "effect": {item.effect for item in folder.items}}
        for what, texts in shown.items():
            for text in sorted(texts):
                method = names_a_method(text, folders)
                if method is not None:
                    raise UserError(
                        f"participants would see the method {method} in the {what} {text!r} of"
                        f" {folder.folder}; rename one of them in compare.json"
                    )


def _place(item: Item) -> tuple[str, ...]:
    return item.scene, item.effect, item.kind, item.view, item.method
