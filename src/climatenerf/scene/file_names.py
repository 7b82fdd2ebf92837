"""Files found by the names that a capture's files give them, across operating systems.

macOS may store `ü` as two characters where the pose file has one, Windows ignores case and writes
back slashes, and screenshots have narrow spaces in their names.
"""

from __future__ import annotations

import contextlib
import os
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from pathlib import Path

from climatenerf.core.listing import is_passed_over
from climatenerf.scene.findings import Finding, counted, examples

MAX_FILES = 200_000
"""Files of a folder that are indexed; more are not searched for other spellings."""


def normalised(name: str) -> str:
    """Return a name with forward slashes and without a leading "./"."""
    return name.replace("\\", "/").removeprefix("./")


# From the strictest comparison to the loosest; NFKC also makes narrow spaces ordinary ones.
_FORMS: tuple[Callable[[str], str], ...] = (
    lambda name: unicodedata.normalize("NFC", name),
    lambda name: unicodedata.normalize("NFKC", name),
    lambda name: unicodedata.normalize("NFKC", name).casefold(),
)


def folded(name: str) -> str:
    """Return a name in the form in which names that look the same are equal."""
    return _FORMS[-1](normalised(name))


class FileNames:
    """The files below a folder, found by exact name, else by a name that looks the same."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.respelled: dict[str, Path] = {}
        """Files found under another spelling, by the name asked for."""
        self.ambiguous: dict[str, list[str]] = {}
        """Names that match several files, with the names of these."""
        self.alternatives: dict[str, list[str]] = {}
        """Names without a suffix that match several files, of which the first is used."""

    def find(self, name: str) -> Path | None:
        """Return the file of a name, relative to the folder; None if there is none.

        Of several files that look the same none is returned; `ambiguous` then has the name.
        """
        relative = normalised(name)
        exact = self.folder / relative
        try:
            if exact.is_file():
                return exact
        except (OSError, ValueError):  # a name that is too long, or holds a zero byte
            return None
        if _is_absolute(relative):
            return self._below(name, relative)
        if ".." in Path(relative).parts:
            return None
        for form, index in zip(_FORMS, self._indices, strict=True):
            found = index.get(form(relative), [])
            if found == [relative]:  # a pipe, or a link to nothing
                return None
            if len(found) == 1:
                self.respelled[name] = self.folder / found[0]
                return self.respelled[name]
            if found:
                self.ambiguous[name] = found
                return None
        return None

    def find_any(self, names: Iterable[str]) -> Path | None:
        """Return the file of the first name that has one; None if none has.

        Names that are ambiguous count as such only if no other name has a file.
        """
        known = dict(self.ambiguous)
        for name in names:
            if (found := self.find(name)) is not None:
                self.ambiguous = known
                return found
        return None

    def note_alternatives(self, name: str, suffixed: Iterable[str]) -> None:
        """Note which of the names with a suffix have different files."""
        found = {}
        for each in suffixed:
            with contextlib.suppress(OSError, ValueError):
                status = os.stat(self.folder / each)
                found.setdefault((status.st_dev, status.st_ino), each)
        if len(found) > 1:
            self.alternatives[name] = list(found.values())

    def _below(self, name: str, absolute: str) -> Path | None:
        """Return the file whose path ends as an absolute path of another machine does."""
        parts = [part for part in absolute.split("/") if part not in ("", ".", "..")]
        for start in range(1, len(parts)):
            file = self.folder.joinpath(*parts[start:])
            with contextlib.suppress(OSError, ValueError):
                if file.is_file():
                    self.respelled[name] = file
                    return file
        return None

    @cached_property
    def _indices(self) -> tuple[dict[str, list[str]], ...]:
        files = list(_files(self.folder))
        indices: tuple[dict[str, list[str]], ...] = tuple(defaultdict(list) for _ in _FORMS)
        for form, index in zip(_FORMS, indices, strict=True):
            for file in files:
                index[form(file)].append(file)
        return indices

    def ambiguous_paths(self) -> dict[Path, list[Path]]:
        """Return the paths that ambiguous names would have, with the files that they match."""
        return {
            self.folder / normalised(name): [self.folder / file for file in files]
            for name, files in self.ambiguous.items()
        }

    def findings(self) -> list[Finding]:
        """Return what was found under another spelling, and what is ambiguous."""
        out = []
        if self.respelled:
            pairs = [f"{n!r} is {p.name!r} on disk" for n, p in self.respelled.items()]
            message = (
                f"{counted(len(self.respelled), 'name')} matched to files on disk with another"
                f" Unicode form, case or slashes ({examples(pairs, 1)})"
            )
            out.append(Finding("name-normalised", message, severity="note", file=str(self.folder)))
        if self.ambiguous:
            name, files = next(iter(self.ambiguous.items()))
            message = (
                f"{counted(len(self.ambiguous), 'name')} in {self.folder} with several matching"
                f" files, left out (first: {name!r} matches {examples(files)})"
            )
            remedy = "rename the files as the poses name them"
            out.append(Finding("name-ambiguous", message, remedy, file=str(self.folder)))
        if self.alternatives:
            name, files = next(iter(self.alternatives.items()))
            message = (
                f"{counted(len(self.alternatives), 'name')} without a suffix in {self.folder} with"
                f" several matching files (first: {name!r} matches {examples(files)}); of each the"
                " first is used"
            )
            remedy = "remove the other files, or give the suffix"
            out.append(Finding("name-ambiguous", message, remedy, file=str(self.folder)))
        return out


def _is_absolute(name: str) -> bool:
    return name.startswith("/") or (name[1:3] == ":/" and name[0].isalpha())


def _files(folder: Path) -> Iterator[str]:
    """Return the paths of files below a folder, relative to it, with forward slashes."""
    count, visited = 0, set()
    for parent, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(parent)
        if real in visited:  # a link to a folder above
            folders.clear()
            continue
        visited.add(real)
        base = Path(parent).relative_to(folder).as_posix()
        for name in names:
            if is_passed_over(name):
                continue
            count += 1
            if count > MAX_FILES:
                return
            yield name if base == "." else f"{base}/{name}"
