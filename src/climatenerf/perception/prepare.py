"""Class labels and relative depths that a capture lacks: made once, kept in the capture's folder.

`made_by.json` beside the files records which model made each file from which photo. Files that it
does not list, or that changed since, belong to the user and are never overwritten.
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
from climatenerf.perception.heuristic import heuristic_labels, is_outdoors
from climatenerf.perception.heuristic_ground import classify_ground_points
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
NONE, HEURISTIC = "none", "heuristic"
FORMER_HEURISTIC = "simple"
"""The former name of "heuristic", still accepted as an argument and in records."""

Track = Callable[[str, list[View]], Iterable[View]]
"""Progress callback: takes a title and photos, and yields the photos."""
Say = Callable[[str], None]
"""Message callback: takes one line for the user."""


@dataclass(frozen=True)
class Source:
    """A model that makes one kind of file.

    Attributes:
        kind: Name of the folder of the files.
        suffix: Suffix of the files' names.
        model: Name of the network, or "heuristic".
        load: Returns the model's revision and its function from a photo to an image. Called only if
            a file is missing, since loading can take long.
        encode: Maps that image to the bytes of a file.
    """

    kind: str
    suffix: str
    model: str
    load: Callable[[], tuple[str | None, Callable[[View], np.ndarray]]]
    encode: Callable[[np.ndarray], bytes]


def prepare_labels(
    scene: Scene, model: str | None, run_folder: Path, track: Track, say: Say
) -> Scene:
    """Return the scene with a class label file for each photo, and make those that are missing.

    Args:
        scene: The capture with z up.
        model: A network's name or folder; "heuristic" for labels without a network; "none"
            for no labels; None for the capture's label files, or "heuristic" if it has none and its
            photos certainly show sky.
        run_folder: Takes the files of "heuristic" if it was not asked for, or if the capture's
            folder is read-only.
        track: Progress callback.
        say: Message callback.

    Raises:
        UserError: The network cannot be used, or its files cannot be written.
    """
    model = HEURISTIC if model == FORMER_HEURISTIC else model
    if model == NONE:
        return replace(scene, views=tuple(replace(v, label_path=None) for v in scene.views))
    folder = scene.root / LABELS
    entries = _entries(folder)
    names = [_within(v.label_path, folder) for v in scene.views if v.label_path is not None]
    if all(name in entries for name in names):
        scene = replace(scene, label_space=TRAIN_IDS)
    by_default = False
    if model is None:
        heuristic = all(name in entries and entries[name]["model"] == HEURISTIC for name in names)
        if not heuristic or (names and not _is_writable(folder)):
            return scene
        if not names and not is_outdoors(scene):
            say("The capture has no class labels and does not certainly show sky: no labels used.")
            return scene
        say(
            "The capture has no class labels: using heuristic labels, from colours and points. A"
            " network's labels are better: use --labels MODEL, or put files into labels/"
            " (--labels none uses no labels)."
        )
        model, by_default = HEURISTIC, not names
    if scene.label_space != TRAIN_IDS:
        raise UserError(
            f"the capture's own labels are {scene.label_space}, which cannot be mixed with labels"
            f" of {model}; omit --labels to use the capture's own, or remove them"
        )
    if model != HEURISTIC:
        check_name(model)  # even if no file is missing
    source = _heuristic(scene) if model == HEURISTIC else _segmentation(scene, model)
    if by_default or (model == HEURISTIC and not _is_writable(folder)):
        folder = run_folder / LABELS  # the user did not ask to write into the capture
    elif not _is_writable(folder):
        raise _read_only(folder)
    paths = _prepare(scene, source, folder, track, say)
    views = tuple(replace(v, label_path=v.label_path or paths.get(v.name)) for v in scene.views)
    return replace(scene, views=views)


def prepare_depth(scene: Scene, model: str, track: Track, say: Say) -> dict[str, Path]:
    """Return a file of relative inverse depth for each photo, by the photo's name.

    Args:
        scene: The capture.
        model: A Depth Anything network's name or folder; "depth-anything" for the default one.
        track: Progress callback.
        say: Message callback.

    Raises:
        UserError: The network cannot be used, or its files cannot be written.
    """
    source = _monocular(scene, _depth_model(model))
    folder = scene.root / DEPTHS
    if not _is_writable(folder):
        raise _read_only(folder)
    return _prepare(scene, source, folder, track, say)


def check_depth_model(model: str) -> None:
    """Check that a name can be a network for `prepare_depth`, before anything is loaded.

    Raises:
        UserError: `transformers` is missing, or the name is neither a folder nor OWNER/NAME.
    """
    check_name(_depth_model(model))


def _depth_model(model: str) -> str:
    return DEPTH_ANYTHING if model == "depth-anything" else model


def _heuristic(scene: Scene) -> Source:
    def load():
        ground = classify_ground_points(scene)
        return None, lambda view: heuristic_labels(view, scene, ground)

    return Source(LABELS, ".png", HEURISTIC, load, _png)


def _segmentation(scene: Scene, model: str) -> Source:
    return Source(LABELS, ".png", model, lambda: _predictor(load_segmentation(model), scene), _png)


def _monocular(scene: Scene, model: str) -> Source:
    return Source(DEPTHS, ".npz", model, lambda: _predictor(load_depth(model), scene), _npz)


def _predictor(network: Network, scene: Scene):
    return network.revision, lambda view: network.predict(load_image(view, scene))


def _prepare(scene: Scene, source: Source, folder: Path, track: Track, say: Say) -> dict[str, Path]:
    """Make the files that are missing or out of date; return each photo's file."""
    entries = _entries(folder)
    paths, outdated, foreign = {}, {}, 0
    for view, target in _targets(scene, folder, source.suffix):
        existing = _existing(view, target, source)
        entry = None if existing is None else entries.get(_within(existing, folder) or "")
        if existing is not None and (entry is None or _digest(existing) != entry["sha256"]):
            paths[view.name] = existing
            foreign += 1
            continue
        paths[view.name] = existing or target
        digest = _digest(view.path)
        if entry is None or (entry["model"], entry["photo_sha256"]) != (source.model, digest):
            outdated[view.name] = digest
    if foreign:
        say(f"Keeping and using {foreign} files in {folder} that were not made by {source.model}.")
    if not outdated:
        return paths
    licence = None if source.model == HEURISTIC else licence_of(source.model)
    if licence and not any(entry["model"] == source.model for entry in entries.values()):
        say(f"Licence of {source.model}: {licence}")  # before the weights are downloaded
    revision, predict = source.load()
    for view in track(source.kind, [v for v in scene.views if v.name in outdated]):
        path = paths[view.name]
        data = source.encode(predict(view))
        entry = {
            "model": source.model,
            "revision": revision,
            "licence": licence,
            "climatenerf": climatenerf.__version__,
            "sha256": hashlib.sha256(data).hexdigest(),
            "photo_sha256": outdated[view.name],
        }
        name = path.relative_to(folder).as_posix()
        previous, entries[name] = entries.get(name), entry
        try:
            write_bytes(path, data)
        except BaseException:
            if previous is not None and path.is_file() and _digest(path) == previous["sha256"]:
                entries[name] = previous  # the earlier file is unchanged
            raise
        finally:
            # Also on interruption: a file without a record would count as the user's.
            write_json(folder / RECORD, {"schema_version": SCHEMA_VERSION, "files": entries})
    return paths


def _targets(scene: Scene, folder: Path, suffix: str) -> Iterator[tuple[View, Path]]:
    """Yield photos with the path of their file, named as a scene reader expects it."""
    stems = [PurePath(view.name).with_suffix("") for view in scene.views]
    for view, stem in zip(scene.views, stems, strict=True):
        name = PurePath(view.name)
        # A photo outside the capture's folder has no relative name for a file in the capture.
        if not name.is_absolute() and ".." not in name.parts:
            ambiguous = stems.count(stem) > 1
            yield view, folder / (f"{name}{suffix}" if ambiguous else f"{stem}{suffix}")


def _existing(view: View, target: Path, source: Source) -> Path | None:
    """Return the file that a photo already has, by either of its names."""
    if source.kind == LABELS and view.label_path is not None:
        return view.label_path
    longer = target.with_name(f"{PurePath(view.name).name}{source.suffix}")
    return next((path for path in (target, longer) if path.is_file()), None)


def _entries(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the record of a folder's files, by their names within it.

    Raises:
        UserError: The record is damaged, or of a newer version.
    """
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
        raise UserError(f"{path} is damaged; delete it, and the generated files beside it")
    for entry in files.values():
        if entry["model"] == FORMER_HEURISTIC:
            entry["model"] = HEURISTIC
    return files


def _within(path: Path, folder: Path) -> str | None:
    """Return the path relative to a folder; None outside it."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else None


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise explain(error, path) from error


def _is_writable(folder: Path) -> bool:
    """Return whether a folder, which need not exist yet, can be written to."""
    return os.access(folder if folder.exists() else folder.parent, os.W_OK)


def _read_only(folder: Path) -> UserError:
    return UserError(
        f"{folder} is read-only, and the model's output is stored there; copy the capture to a"
        " writable folder, or change its permissions"
    )


def _png(labels: Shaped[np.ndarray, "h w"]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(labels).save(buffer, "PNG")
    return buffer.getvalue()


def _npz(depth: Shaped[np.ndarray, "h w"]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, inverse_depth=depth.astype(np.float32))
    return buffer.getvalue()
