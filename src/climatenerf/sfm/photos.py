"""Which files below a folder are the user's photos: not those of scenes, labels or hidden ones."""

import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from climatenerf.core.errors import UserError
from climatenerf.sfm.scene_folder import SIDECAR_KINDS, is_scene, walk_once

PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".heic", ".heif", ".tif", ".tiff", ".webp", ".bmp"}
VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp"}
MIN_PHOTOS = 3


@dataclass(frozen=True)
class Photos:
    """The photos below a folder.

    Attributes:
        folder: that their names are relative to.
        files: sorted.
        notes: sentences about what was left out though it holds pictures.
    """

    folder: Path
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def find_photos(source: Path, excluded: Collection[Path]) -> Photos:
    """The photos of a place: those of a folder, or the pictures of a scene that is there already.

    Args:
        source: folder to look in.
        excluded: folders whose files are none.

    Raises:
        UserError: fewer than a place needs.
    """
    notes = []
    if is_scene(source) and (source / "images").is_dir():
        notes.append(f"{source} is a scene; the pictures in {source / 'images'} are the photos.")
        source = source / "images"
    found = photos_in(source, excluded)
    if not found.files:
        videos = sorted(p for p in source.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
        remedy = f"the video itself, such as {videos[0]}" if videos else "the folder that has them"
        said = " ".join(("", *found.notes))
        raise UserError(
            f"{source} holds no photos (JPEG, PNG, HEIC, TIFF, WebP); give {remedy}{said}"
        )
    if len(found.files) < MIN_PHOTOS:
        raise too_few_photos(source, len(found.files), "")
    return Photos(source, found.files, (*notes, *found.notes))


def too_few_photos(source: Path, count: int, why: str) -> UserError:
    """The sentence for `count` pictures that can be used, and the reason for those that cannot."""
    return UserError(
        f"{source} holds {count} usable pictures, and a place needs at least {MIN_PHOTOS}"
        f" (40 to 100 are good); take more{why}"
    )


def is_video(source: Path) -> bool:
    """Whether what the user gave is a video and not a folder.

    Raises:
        UserError: it is neither, or does not exist.
    """
    if not source.exists():
        raise UserError(f"{source} does not exist; give a folder of photos or a video")
    if not source.is_file():
        return False
    if source.suffix.lower() not in VIDEO_SUFFIXES:
        kinds = ", ".join(sorted(suffix[1:] for suffix in VIDEO_SUFFIXES))
        raise UserError(
            f"{source} is neither a folder of photos nor a video ({kinds}); give the folder that"
            " holds the photos"
        )
    return True


def photos_in(folder: Path, excluded: Collection[Path]) -> Photos:
    """All photos below a folder, through linked folders too, each real folder once.

    Hidden ones, those of scenes, and labels, masks and depths beside `images` are left out.

    Args:
        folder: to look in.
        excluded: folders whose files are none.
    """
    none = {path.resolve() for path in excluded}
    files: list[Path] = []
    scenes: list[Path] = []
    extras: list[Path] = []
    for here, folders, names in walk_once(folder):
        seen = [here / name for name in folders if not name.startswith(".")]
        seen = [path for path in seen if path.resolve() not in none]
        scenes += [path for path in seen if is_scene(path)]
        if "images" in folders:
            extras += [path for path in seen if path.name in SIDECAR_KINDS]
        folders[:] = [path.name for path in seen if path not in scenes and path not in extras]
        files += [here / name for name in names if _is_photo(name)]
    return Photos(folder, tuple(sorted(files)), tuple(_notes(folder, scenes, extras)))


def _is_photo(name: str) -> bool:
    return not name.startswith(".") and Path(name).suffix.lower() in PHOTO_SUFFIXES


def _notes(folder: Path, scenes: list[Path], extras: list[Path]) -> Iterator[str]:
    if scenes:
        listed = ", ".join(os.path.relpath(path, folder) for path in sorted(scenes))
        yield f"Scenes among the photos are left out: {listed}."
    if extras:
        flags = " ".join(f"--{path.name} {path}" for path in sorted(extras))
        yield f"What lies beside images/ is left out of the photos; to use it, give {flags}."
