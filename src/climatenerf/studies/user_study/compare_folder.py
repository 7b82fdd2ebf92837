"""Reading of the folders that `climatenerf compare` writes: one scene by several methods. No torch.

`compare.json` names the methods and the pictures and movies that each made.
"""

from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from climatenerf.core.errors import UserError, excerpt
from climatenerf.core.parsing import items, read_json, text
from climatenerf.core.regular_files import check_regular
from climatenerf.core.storage import check_schema

FILE_NAME = "compare.json"
SCHEMA_VERSION = 1
METHOD_KINDS = ("ours", "stand-in", "model", "folder")
SUFFIXES = {"picture": (".jpg", ".jpeg", ".png"), "movie": (".mp4",)}
MAX_ITEMS = 10_000
MAX_NAME = 200


@dataclass(frozen=True)
class Method:
    """A method that is compared."""

    name: str
    kind: str
    """One of `METHOD_KINDS`."""
    licence: str | None
    """Licence line of its weights or pictures."""


@dataclass(frozen=True)
class Item:
    """A picture or movie that a method made."""

    scene: str
    method: str
    effect: str
    kind: str
    """"picture" or "movie"."""
    view: str
    path: Path


@dataclass(frozen=True)
class CompareFolder:
    """What methods made of one scene."""

    folder: Path
    scene: str
    licence: str | None
    """Licence or source line of the capture."""
    methods: tuple[Method, ...]
    items: tuple[Item, ...]

    @property
    def ours(self) -> str:
        """Name of the method that the others are compared with."""
        return next(method.name for method in self.methods if method.kind == "ours")


def read_compare_folder(folder: Path) -> CompareFolder:
    """Read and check `compare.json` and that its files exist inside the folder.

    Raises:
        UserError: the file is absent or damaged, a value is of another type or out of range, a file
            is missing or outside the folder, or not exactly one method is ours.
    """
    if not folder.is_dir():
        raise UserError(
            f"{excerpt(str(folder))} is no folder; give the folder that `climatenerf compare` wrote"
        )
    path = folder / FILE_NAME
    if not path.exists():
        raise UserError(
            f"{folder} has no {FILE_NAME}; give the folder that `climatenerf compare` wrote"
        )
    where = str(path)
    table = read_json(path, "comparison")
    check_schema(table.get("schema_version"), SCHEMA_VERSION, f"comparison {path}")
    scene = _name(table, "scene", where)
    methods = tuple(
        _method(entry, f"method {number} in {where}")
        for number, entry in enumerate(items(table, "methods", where))
    )
    names = [method.name for method in methods]
    _refuse_repeated(names, f"methods in {where}")
    ours = [method.name for method in methods if method.kind == "ours"]
    if len(ours) != 1:
        raise UserError(
            f"{where} has {len(ours)} methods of kind ours, where one is needed; correct it"
        )
    listed = items(table, "items", where)
    if len(listed) > MAX_ITEMS:
        raise UserError(f"{where} has {len(listed)} items, more than {MAX_ITEMS}; split it")
    found = tuple(
        _item(entry, folder, scene, set(names), f"item {number} in {where}")
        for number, entry in enumerate(listed)
    )
    _refuse_repeated(
        [(each.method, each.effect, each.kind, each.view) for each in found], f"items in {where}"
    )
    return CompareFolder(folder, scene, _licence(table, where), methods, found)


def _method(entry: Any, where: str) -> Method:
    name = _name(entry, "name", where)
    return Method(name, _choice(entry, "kind", where, METHOD_KINDS), _licence(entry, where))


def _item(entry: Any, folder: Path, scene: str, methods: set[str], where: str) -> Item:
    method = _name(entry, "method", where)
    if method not in methods:
        raise UserError(
            f"{where} has the method {excerpt(method)}, which methods does not list; correct it"
        )
    kind = _choice(entry, "kind", where, tuple(SUFFIXES))
    effect, view = _name(entry, "effect", where), _name(entry, "view", where)
    path = _inside(folder, text(entry, "file", where), where)
    if path.suffix.lower() not in SUFFIXES[kind]:
        raise UserError(
            f"{where}: {path} is no {kind}, which ends in {' or '.join(SUFFIXES[kind])}; correct"
            " kind or file"
        )
    return Item(scene, method, effect, kind, view, path)


def _inside(folder: Path, name: str, where: str) -> Path:
    """Return the path of a regular file inside a folder, also after links are resolved."""
    relative = PurePosixPath(name)
    outside = not name or "\\" in name or "\0" in name or relative.is_absolute()
    if outside or ".." in relative.parts:
        raise UserError(
            f"file in {where} should be a path inside the folder, with slashes, not"
            f" {excerpt(name)}; correct it"
        )
    path = folder / relative
    check_regular(path, where)
    try:
        exists = path.is_file()
        inside = exists and path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError) as error:  # a name too long; a loop of links
        raise UserError(
            f"file in {where}: {excerpt(name)} cannot be used; correct it or make it again"
        ) from error
    if exists and not inside:
        raise UserError(f"{where}: {path} is a link out of the folder; copy the file there")
    if not exists:
        raise UserError(f"{where}: {path} is missing or no file; make the comparison again")
    return path


def _name(table: Any, key: str, where: str) -> str:
    """Return a text of one line that is not empty."""
    value = text(table, key, where)
    if not value.strip() or len(value) > MAX_NAME or not value.isprintable():
        raise UserError(
            f"{key} in {where} should be a name of 1 to {MAX_NAME} printable characters, not"
            f" {excerpt(value)}; correct it"
        )
    return value


def _choice(table: Any, key: str, where: str, choices: tuple[str, ...]) -> str:
    value = text(table, key, where)
    if value not in choices:
        raise UserError(
            f"{key} in {where} should be one of {', '.join(choices)}, not {excerpt(value)};"
            " correct it"
        )
    return value


def _licence(table: Any, where: str) -> str | None:
    return text(table, "licence", where, default=None)


def _refuse_repeated(found: Sequence[Hashable], where: str) -> None:
    repeated = [each for each, count in Counter(found).items() if count > 1]
    if repeated:
        raise UserError(f"{where} repeat {excerpt(repeated[0])}; remove one of them")
