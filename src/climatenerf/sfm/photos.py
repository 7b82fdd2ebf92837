"""Find the user's photos below a folder; skip scenes, sidecars and hidden files."""

import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from climatenerf.core.errors import UserError
from climatenerf.core.listing import is_passed_over, visible
from climatenerf.scene.image_files import PHOTO_SUFFIXES
from climatenerf.sfm.scene_folder import SIDECAR_KINDS, is_scene, walk_once

VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp"}
MIN_PHOTOS = 3


@dataclass(frozen=True)
class Photos:
    """The photos below a folder.

    Attributes:
        folder: base folder of the files.
        files: paths of the photos, sorted.
        notes: sentences for the user about folders with pictures that were skipped.
    """

    folder: Path
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def find_photos(source: Path, excluded: Collection[Path]) -> Photos:
    """Find the photos of a folder. For a scene folder, these are the pictures in `images`.

    Args:
        source: folder to search.
        excluded: folders whose files are not photos.

    Raises:
        UserError: fewer than `MIN_PHOTOS` photos.
    """
    notes = []
    if is_scene(source) and (source / "images").is_dir():
        notes.append(
            f"{source} is a scene folder; the pictures in {source / 'images'} are used as photos."
        )
        source = source / "images"
    found = photos_in(source, excluded)
    if not found.files:
        videos = sorted(p for p in visible(source.iterdir()) if p.suffix.lower() in VIDEO_SUFFIXES)
        remedy = f"the video itself, such as {videos[0]}" if videos else "the folder with photos"
        details = " ".join(("", *found.notes))
        raise UserError(
            f"{source} contains no photos (JPEG, PNG, HEIC, TIFF, WebP); give {remedy}{details}"
        )
    if len(found.files) < MIN_PHOTOS:
        raise too_few_photos(source, len(found.files), "")
    return Photos(source, found.files, (*notes, *found.notes))


def too_few_photos(source: Path, count: int, why: str) -> UserError:
    """Return the error for `count` usable pictures; `why` is the cause for the unusable ones."""
    return UserError(
        f"{source} contains {count} usable pictures, and a scene needs at least {MIN_PHOTOS}"
        f" (40 to 100 are good); take more{why}"
    )


def is_video(source: Path) -> bool:
    """Return True if the source is a video and False if it is a folder.

    Raises:
        UserError: the source is neither, or does not exist.
    """
    if not source.exists():
        raise UserError(f"{source} does not exist; give a folder of photos or a video")
    if not source.is_file():
        return False
    if source.suffix.lower() not in VIDEO_SUFFIXES:
        kinds = ", ".join(sorted(suffix[1:] for suffix in VIDEO_SUFFIXES))
        raise UserError(
            f"{source} is neither a folder of photos nor a video ({kinds}); give the folder with"
            " the photos"
        )
    return True


def photos_in(folder: Path, excluded: Collection[Path]) -> Photos:
    """Return all photos below a folder.

    Linked folders are followed, each real folder once. Hidden files, scene folders, and labels,
    masks and depths beside `images` are skipped.

    Args:
        folder: folder to search.
        excluded: folders whose files are not photos.
    """
    excluded_folders = {path.resolve() for path in excluded}
    files: list[Path] = []
    scenes: list[Path] = []
    sidecars: list[Path] = []
    for here, folders, names in walk_once(folder):
        candidates = [here / name for name in folders if not is_passed_over(name)]
        candidates = [path for path in candidates if path.resolve() not in excluded_folders]
        scenes += [path for path in candidates if is_scene(path)]
        if "images" in folders:
            sidecars += [path for path in candidates if path.name in SIDECAR_KINDS]
        skipped = {*scenes, *sidecars}
        folders[:] = [path.name for path in candidates if path not in skipped]
        files += [here / name for name in names if _is_photo(name)]
    return Photos(folder, tuple(sorted(files)), tuple(_notes(folder, scenes, sidecars)))


def _is_photo(name: str) -> bool:
    return not is_passed_over(name) and Path(name).suffix.lower() in PHOTO_SUFFIXES


def _notes(folder: Path, scenes: list[Path], sidecars: list[Path]) -> Iterator[str]:
    if scenes:
        listed = ", ".join(os.path.relpath(path, folder) for path in sorted(scenes))
        yield f"Scene folders among the photos are skipped: {listed}."
    if sidecars:
        flags = " ".join(f"--{path.name} {path}" for path in sorted(sidecars))
        yield f"Folders beside images/ are not searched for photos; to use them, add {flags}."
