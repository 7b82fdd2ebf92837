"""Labels and depths that a capture lacks: made once, and kept in the capture's folder.

`made_by.json` beside them tells of each file what made it from which photo. What is not told of
there, or was changed since, is the user's and stays as it is.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from jaxtyping import Shaped
from PIL import Image

import climatenerf
from climatenerf.core.errors import UserError
from climatenerf.core.storage import check_schema, explain, read_json, write_bytes, write_json
from climatenerf.perception.heuristic import shows_sky, simple_labels
from climatenerf.perception.heuristic_ground import ground_points
from climatenerf.perception.models import Network, check_name, licence_of
from climatenerf.perception.monocular import DEFAULT as DEPTH_ANYTHING
from climatenerf.perception.monocular import load_depth
from climatenerf.perception.segmentation import load_segmentation
from climatenerf.scene.images import load_image
from climatenerf.scene.label_spaces import TRAIN_IDS
from climatenerf.scene.scene import Scene, View

LABELS, DEPTHS = "labels", "depth_relative"
RECORD = "made_by.json"
SCHEMA_VERSION = 1
NONE, SIMPLE = "none", "simple"

Track = Callable[[str, list[View]], Iterable[View]]
"""Goes through photos and shows how far it is: title, photos."""
Say = Callable[[str], None]
"""Tells the user a line."""


@dataclass(frozen=True)
class Source:
    """Where files of one kind come from.

    Attributes:
        kind: Name of their folder.
        suffix: Of their names.
        model: Name of the network, or "simple".
        load: Gets it ready; it may take long, so it is called only if something is to be made.
        encode: From what is seen in a photo to a file's bytes.
    """

    kind: str
    suffix: str
    model: str
    load: Callable[[], tuple[str | None, Callable[[View], np.ndarray]]]
    encode: Callable[[np.ndarray], bytes]


def prepare_labels(scene: Scene, model: str | None, spare: Path, track: Track, say: Say) -> Scene:
    """The scene with class labels of its photos, those made that it lacks.

    Args:
        scene: The levelled capture.
        model: A network's name or folder; "simple" for sky and ground without a network; "none"
            for no labels at all; None for the labels that the capture has, or else those of
            "simple" if photos surely show sky.
        spare: Folder that takes the files of "simple" if nobody asked for it or the capture's may
            not be written.
        track: Told of progress.
        say: Told what the user should know.

    Raises:
        UserError: The network cannot be used, or its files cannot be written.
    """
    if model == NONE:
        return replace(scene, views=tuple(replace(v, label_path=None) for v in scene.views))
    folder = scene.root / LABELS
    entries = _entries(folder)
    names = [_within(v.label_path, folder) for v in scene.views if v.label_path is not None]
    if all(name in entries for name in names):
        scene = replace(scene, label_space=TRAIN_IDS)
    unasked = False
    if model is None:
        simple = all(name in entries and entries[name]["model"] == SIMPLE for name in names)
        if not simple or (names and not _writable(folder)):
            return scene
        if not names and not shows_sky(scene):
            say("The capture has no class labels, and no sky is found for sure: none are used.")
            return scene
        say(
            "The capture has no class labels; as a fall-back sky is found by its looks, and ground"
            " by its points."
            " Labels of a network are better: --labels MODEL, or files in labels/ (--labels none"
            " does without)."
        )
        model, unasked = SIMPLE, not names
    if scene.label_space != TRAIN_IDS:
        raise UserError(
            f"the capture's own labels are {scene.label_space}, which labels of {model} cannot"
            " stand beside; leave --labels out to use its own, or take them away"
        )
    if model != SIMPLE:
        check_name(model)  # also where every photo has labels already
    source = _simple(scene) if model == SIMPLE else _segmentation(scene, model)
    if unasked or (model == SIMPLE and not _writable(folder)):
        folder = spare / LABELS  # nobody said that the capture may be written into
    elif not _writable(folder):
        raise _read_only(folder)
    paths = _prepare(scene, source, folder, track, say)
    views = tuple(replace(v, label_path=v.label_path or paths.get(v.name)) for v in scene.views)
    return replace(scene, views=views)


def prepare_depth(scene: Scene, model: str, track: Track, say: Say) -> dict[str, Path]:
    """Files of relative inverse depth, one for each photo, by the photo's name.

    Args:
        scene: The capture.
        model: A Depth Anything's name or folder; "depth-anything" is the default one.
        track: Told of progress.
        say: Told what the user should know.

    Raises:
        UserError: The network cannot be used, or its files cannot be written.
    """
    source = _monocular(scene, _depth_model(model))
    folder = scene.root / DEPTHS
    if not _writable(folder):
        raise _read_only(folder)
    return _prepare(scene, source, folder, track, say)


def check_depth_model(model: str) -> None:
    """Refuses what cannot be a network for `prepare_depth`, before anything is loaded."""
    check_name(_depth_model(model))


def _depth_model(model: str) -> str:
    return DEPTH_ANYTHING if model == "depth-anything" else model


def _simple(scene: Scene) -> Source:
    def load():
        ground = ground_points(scene)
        return None, lambda view: simple_labels(view, scene, ground)

    return Source(LABELS, ".png", SIMPLE, load, _png)


def _segmentation(scene: Scene, model: str) -> Source:
    return Source(LABELS, ".png", model, lambda: _looking(load_segmentation(model), scene), _png)


def _monocular(scene: Scene, model: str) -> Source:
    return Source(DEPTHS, ".npz", model, lambda: _looking(load_depth(model), scene), _npz)


def _looking(network: Network, scene: Scene):
    return network.revision, lambda view: network.predict(load_image(view, scene))


def _prepare(scene: Scene, source: Source, folder: Path, track: Track, say: Say) -> dict[str, Path]:
    """Makes what is missing or out of date; returns where each photo's file is."""
    entries = _entries(folder)
    paths, photos, theirs = {}, {}, 0
    for view, target in _targets(scene, folder, source.suffix):
        there = _there(view, target, source)
        entry = None if there is None else entries.get(_within(there, folder) or "")
        if there is not None and (entry is None or _digest(there) != entry["sha256"]):
            paths[view.name] = there
            theirs += 1
            continue
        paths[view.name] = there or target
        digest = _digest(view.path)
        if entry is None or (entry["model"], entry["photo_sha256"]) != (source.model, digest):
            photos[view.name] = digest
    if theirs:
        say(f"{theirs} files in {folder} are not by {source.model}; they stay and are used.")
    if not photos:
        return paths
    licence = None if source.model == SIMPLE else licence_of(source.model)
    if licence and not any(entry["model"] == source.model for entry in entries.values()):
        say(f"Licence of {source.model}: {licence}")  # before its weights are fetched
    revision, look = source.load()
    for view in track(source.kind, [v for v in scene.views if v.name in photos]):
        path = paths[view.name]
        data = source.encode(look(view))
        entry = {
            "model": source.model,
            "revision": revision,
            "licence": licence,
            "climatenerf": climatenerf.__version__,
            "sha256": hashlib.sha256(data).hexdigest(),
            "photo_sha256": photos[view.name],
        }
        name = path.relative_to(folder).as_posix()
        before, entries[name] = entries.get(name), entry
        try:
            write_bytes(path, data)
        except BaseException:
            if before is not None and path.is_file() and _digest(path) == before["sha256"]:
                entries[name] = before  # the earlier file is still there
            raise
        finally:
            # Also when stopped just here: a file that nothing tells of would count as the user's.
            write_json(folder / RECORD, {"schema_version": SCHEMA_VERSION, "files": entries})
    return paths


def _targets(scene: Scene, folder: Path, suffix: str) -> Iterator[tuple[View, Path]]:
    """Photos and where their file is to be, named so that a reader finds it."""
    stems = [PurePath(view.name).with_suffix("") for view in scene.views]
    for view, stem in zip(scene.views, stems, strict=True):
        name = PurePath(view.name)
        # Photos outside the capture have no name by which a file in it could be found.
        if not name.is_absolute() and ".." not in name.parts:
            shared = stems.count(stem) > 1
            yield view, folder / (f"{name}{suffix}" if shared else f"{stem}{suffix}")


def _there(view: View, target: Path, source: Source) -> Path | None:
    """The file that a photo has already."""
    if source.kind == LABELS and view.label_path is not None:
        return view.label_path
    longer = target.with_name(f"{PurePath(view.name).name}{source.suffix}")
    return next((path for path in (target, longer) if path.is_file()), None)


def _entries(folder: Path) -> dict[str, dict[str, Any]]:
    """What is told of the files in a folder, by their names within it."""
    path = folder / RECORD
    if not path.is_file():
        return {}
    record = read_json(path, "record of what was made")
    check_schema(record.get("schema_version"), SCHEMA_VERSION, f"the record {path}")
    files = record.get("files")
    needed = {"model", "sha256", "photo_sha256"}
    if not isinstance(files, dict) or not all(
        isinstance(entry, dict) and needed <= entry.keys() for entry in files.values()
    ):
        raise UserError(f"{path} is damaged; delete it, and the files beside it that were made")
    return files


def _within(path: Path, folder: Path) -> str | None:
    """The path as seen from a folder; None outside of it."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else None


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise explain(error, path) from error


def _writable(folder: Path) -> bool:
    """Whether a folder, which need not be there yet, may be written to."""
    return os.access(folder if folder.exists() else folder.parent, os.W_OK)


def _read_only(folder: Path) -> UserError:
    return UserError(
        f"{folder} may not be written, and what the model sees is kept there: copy the capture to"
        " where you may write, or change its permissions"
    )


def _png(labels: Shaped[np.ndarray, "h w"]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(labels).save(buffer, "PNG")
    return buffer.getvalue()


def _npz(depth: Shaped[np.ndarray, "h w"]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, inverse_depth=depth.astype(np.float32))
    return buffer.getvalue()
