"""A user study as one HTML page that needs no network, and the key to its votes. No torch.

The page has pictures under opaque ids. `key.json`, which stays with the maker, names their methods.
"""

import base64
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import climatenerf
from climatenerf.core.errors import UserError
from climatenerf.core.locks import only_writer
from climatenerf.core.storage import make_folder, read_json, write_bytes, write_json
from climatenerf.studies.user_study.compare_folder import Item
from climatenerf.studies.user_study.design import REPEATS, Pair, Study, digest, opaque
from climatenerf.studies.user_study.media import (
    SUFFIXES,
    Media,
    catch_picture,
    read_media,
    still_picture,
)

SCHEMA_VERSION = 1
PAGE, KEY, MEDIA = "index.html", "key.json", "media"
MAX_INLINE_BYTES = 50_000_000
"""Largest total of media that the page holds itself."""

Entry = dict[str, Any]
"""A pair or a medium as `key.json` lists it."""
Progress = Callable[[int, int], None]
"""Takes the numbers of pictures and movies done and in all."""


@dataclass(frozen=True)
class WrittenStudy:
    """What `write_study` wrote."""

    id: str
    inline: bool
    """Whether the page holds all media itself."""
    unequal: int
    """Number of pairs whose sides differ in size."""


@dataclass(frozen=True)
class Contents:
    """The pairs and media of a study as read."""

    pairs: list[Entry]
    media: dict[str, Entry]
    held: dict[str, Media]
    """Media that the page holds, by id."""


def write_study(
    study: Study, out: Path, progress: Progress, max_inline: int = MAX_INLINE_BYTES
) -> WrittenStudy:
    """Write `index.html` and `key.json`.

    The same study may be written again. Media are in the page, or in the folder `media` if they
    have more than `max_inline` bytes in all.

    Raises:
        UserError: a picture or movie cannot be used, the folder holds another study or other files
            of these names, or it cannot be written.
    """
    with only_writer(out):
        known = _known_study(out)
        items = study.media()
        inline = sum(item.path.stat().st_size for item in items.values()) <= max_inline
        contents = _read(study, items, inline, progress)
        name = _study_id(study, contents.media)
        if known not in (None, name):
            raise UserError(
                f"{out} holds another study ({known}), whose votes need its {KEY}; choose another"
                " folder with -o"
            )
        write_json(out / KEY, _key(study, name, contents))
        if not inline:
            _write_media(items, contents, out, progress)
        write_bytes(out / PAGE, page(_page_data(study, name, contents)))
    sizes = {each: tuple(entry["size"]) for each, entry in contents.media.items()}
    unequal = sum(sizes[pair["first"]] != sizes[pair["second"]] for pair in contents.pairs)
    return WrittenStudy(name, inline, unequal)


def _read(study: Study, items: Mapping[str, Item], inline: bool, progress: Progress) -> Contents:
    """Read and check all media, and make the catch pairs."""
    contents = Contents([_key_pair(study, pair) for pair in study.pairs], {}, {})
    for done, (medium, item) in enumerate(items.items(), start=1):
        found = read_media(item.path, item.kind)
        contents.media[medium] = _media_entry(item, found)
        if inline:
            contents.held[medium] = found
        progress(done, len(items) * (1 if inline else 2))
    for number, item in enumerate(study.catch_items()):
        shown = read_media(item.path, item.kind)
        clean = still_picture(item.path) if item.kind == "movie" else shown
        noisy = catch_picture(shown, item.path, study.seed + number)
        ids = [opaque(study.seed, "catch", str(number), side) for side in ("clean", "noisy")]
        for medium, found in zip(ids, (clean, noisy), strict=True):
            contents.held[medium] = found
            contents.media[medium] = {**_media_entry(item, found), "kind": "picture"}
        contents.media[ids[1]]["method"] = None
        contents.pairs.append(_catch_pair(study, number, item, ids))
    return contents


def _write_media(
    items: Mapping[str, Item], contents: Contents, out: Path, progress: Progress
) -> None:
    """Write the media that the page does not hold; they are read again, one at a time."""
    make_folder(out / MEDIA)
    for done, (medium, item) in enumerate(items.items(), start=1):
        found = read_media(item.path, item.kind)
        if hashlib.sha256(found.data).hexdigest() != contents.media[medium]["sha256"]:
            raise UserError(f"{item.path} changed while it was read; run it again")
        write_bytes(out / MEDIA / f"{medium}{found.suffix}", found.data)
        progress(len(items) + done, 2 * len(items))


def page(data: Mapping[str, Any]) -> bytes:
    """Return the HTML page of a study, which loads nothing but its own media."""
    assets = resources.files("climatenerf") / "assets" / "study"
    style, script = ((assets / f"page.{kind}").read_text("utf-8") for kind in ("css", "js"))
    # Escape "<": a scene named "</script>" must not end the script.
    listed = json.dumps(data, ensure_ascii=True, separators=(",", ":")).replace("<", "\\u003c")
    policy = (
        f"default-src 'none'; script-src {_source_of(script)}; style-src {_source_of(style)};"
        " img-src blob: file: 'self'; media-src blob: file: 'self'"
    )
    text = (assets / "page.html").read_text("utf-8")
    for name, value in (("policy", policy), ("style", style), ("script", script), ("data", listed)):
        text = text.replace("{{" + name + "}}", value, 1)
    return text.encode()


def _page_data(study: Study, name: str, contents: Contents) -> dict[str, Any]:
    """Return the data of the page, without anything that names a method."""

    def medium(each: str) -> dict[str, str | None]:
        kind, held = contents.media[each]["type"], contents.held.get(each)
        if held is not None:
            data = base64.b64encode(held.data).decode()
            return {"type": kind, "file": None, "data": data}
        return {"type": kind, "file": f"{MEDIA}/{each}{SUFFIXES[kind]}", "data": None}

    def shown(pair: Entry) -> Entry:
        about = {key: pair[key] for key in ("id", "kind", "effect", "scene")}
        group = opaque(study.seed, "group", pair["effect"], pair["kind"], str(pair["other"]))
        return {**about, "group": group, "media": [pair["first"], pair["second"]]}

    return {
        "id": name,
        "votes": study.votes,
        "repeats": REPEATS,
        "pairs": [shown(pair) for pair in contents.pairs if not pair["catch"]],
        "catches": [shown(pair) for pair in contents.pairs if pair["catch"]],
        "sources": study.sources()[0],
        "media": {each: medium(each) for each in sorted(contents.media)},
    }


def _key(study: Study, name: str, contents: Contents) -> dict[str, Any]:
    methods = {method.name: method for folder in study.folders for method in folder.methods}
    return {
        "schema_version": SCHEMA_VERSION,
        "climatenerf": climatenerf.__version__,
        "study": name,
        "seed": study.seed,
        "votes": study.votes,
        "ours": study.folders[0].ours,
        "methods": list(methods.values()),
        "scenes": [{"name": each.scene, "licence": each.licence} for each in study.folders],
        "pairs": contents.pairs,
        "media": contents.media,
    }


def _key_pair(study: Study, pair: Pair) -> Entry:
    return {
        "id": pair.id,
        "scene": pair.second.scene,
        "effect": pair.second.effect,
        "kind": pair.second.kind,
        "view": pair.second.view,
        "other": pair.second.method,
        "first": study.medium_id(pair.first),
        "second": study.medium_id(pair.second),
        "catch": False,
    }


def _catch_pair(study: Study, number: int, item: Item, ids: Sequence[str]) -> Entry:
    return {
        "id": opaque(study.seed, "pair", "catch", str(number)),
        "scene": item.scene,
        "effect": item.effect,
        "kind": "picture",
        "view": item.view,
        "other": None,
        "first": ids[0],
        "second": ids[1],
        "catch": True,
    }


def _media_entry(item: Item, media: Media) -> dict[str, Any]:
    return {
        "scene": item.scene,
        "effect": item.effect,
        "kind": item.kind,
        "view": item.view,
        "method": item.method,
        "type": media.type,
        "size": media.size,
        "sha256": hashlib.sha256(media.data).hexdigest(),
    }


def _known_study(out: Path) -> str | None:
    """Return the id of the study that a folder holds; None if it holds none.

    Raises:
        UserError: it holds files of these names that belong to no study.
    """
    key = out / KEY
    if key.exists():
        found = read_json(key, "key of a study").get("study")
        if isinstance(found, str):
            return found
    for name in (KEY, PAGE, MEDIA):
        if (out / name).exists():
            raise UserError(
                f"{out / name} exists and belongs to no study; choose another folder with -o"
            )
    return None


def _study_id(study: Study, entries: Mapping[str, Entry]) -> str:
    """Return an id that changes with the pairs, the media, the seed and the number of votes."""
    words = [str(study.seed), str(study.votes), *(pair.id for pair in study.pairs)]
    return digest([*words, *(f"{each} {entries[each]['sha256']}" for each in sorted(entries))])[:8]


def _source_of(text: str) -> str:
    """Return the hash by which a content security policy allows a script or style of a page."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
