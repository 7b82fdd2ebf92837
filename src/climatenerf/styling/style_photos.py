"""Photos of another place as the source of a style: their colours by class. No torch.

Classes come from label files beside the photos, from regions that the user names, or from a
network. Without any, all pixels stand for vegetation and for terrain.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from climatenerf.core.classes import (
    CLASS_NAMES,
    MERGED,
    TERRAIN,
    UNKNOWN,
    VEGETATION,
)
from climatenerf.core.errors import UserError
from climatenerf.core.listing import visible
from climatenerf.core.srgb import to_linear
from climatenerf.scene.image_files import PHOTO_SUFFIXES
from climatenerf.scene.images import read_labels, read_rgb
from climatenerf.weather.style import Source

MAX_PIXELS = 40_000  # of one photo that are used
MAX_LICENCE = 2000  # characters
MIN_SPREAD = 1e-3  # of linear values; below it a photo has one colour
DARK = 1e-3  # mean linear value of a black photo

MIN_PIXELS = 500  # of a class, so that it counts as shown

Labeller = Callable[[UInt8[np.ndarray, "h w 3"]], UInt8[np.ndarray, "h w"]]
"""Maps a picture to Cityscapes train ids."""


@dataclass(frozen=True)
class Region:
    """A rectangle of the photos that shows one class.

    Attributes:
        kind: the class, see `core.classes`.
        box: left, top, right and bottom, as fractions of width and height.
    """

    kind: int
    box: tuple[float, float, float, float]


@dataclass(frozen=True)
class StylePhotos:
    """Linear colours of photos by class.

    Attributes:
        colours: of each class that the photos show, in [0, 1].
        sources: the files.
        notes: what was assumed, one sentence each.
    """

    colours: dict[int, Float[np.ndarray, "n 3"]]
    sources: tuple[Source, ...]
    notes: tuple[str, ...] = field(default=())


def is_shown(colours: Float[np.ndarray, "n 3"] | None) -> bool:
    """Return whether photos show enough of a class, and show it neither black nor absent."""
    return colours is not None and len(colours) >= MIN_PIXELS and bool(colours.mean() >= DARK)


def parse_region(text: str) -> Region:
    """Return a region given as "vegetation=0,0.5,1,1".

    Raises:
        UserError: it has another form, or names no class.
    """
    name, _, numbers = text.partition("=")
    try:
        box = tuple(float(word) for word in numbers.split(","))
    except ValueError:
        box = ()
    kinds = {each: index for index, each in enumerate(CLASS_NAMES)}
    if len(box) == 4 and name in kinds:
        left, top, right, bottom = box
        if 0 <= left < right <= 1 and 0 <= top < bottom <= 1:
            return Region(kinds[name], (left, top, right, bottom))
    raise UserError(
        "--style-region must be a class and left,top,right,bottom as fractions of the photo, such"
        f" as vegetation=0,0.5,1,1, with a class of {', '.join(CLASS_NAMES)}; got"
        f' "{text[:60]}"'
    )


def photo_files(paths: Sequence[Path]) -> list[Path]:
    """Return the photos among files and folders; a folder may hold them in `images`.

    Raises:
        UserError: a path does not exist, or holds no photo.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_file():
            files.append(path)
            continue
        if not path.is_dir():
            raise UserError(f"there is no style photo {path}; name a photo or a folder of photos")
        inner = path / "images" if (path / "images").is_dir() else path
        found = [p for p in sorted(visible(inner.iterdir())) if p.suffix.lower() in PHOTO_SUFFIXES]
        if not found:
            raise UserError(f"{path} holds no photo; name a photo or a folder of photos")
        files += found
    return files


def read_style_photos(
    paths: Sequence[Path], regions: Sequence[Region] = (), labeller: Labeller | None = None
) -> StylePhotos:
    """Read photos and sort their colours by class.

    Args:
        paths: photos, or folders of photos.
        regions: rectangles of known class; they replace labels.
        labeller: finds classes of photos without label file; None: none does.

    Raises:
        UserError: a file cannot be read, a photo is black or of one colour, or labels do not fit.
    """
    found: dict[int, list[Float[np.ndarray, "n 3"]]] = {}
    sources, unlabelled = [], 0
    files = photo_files(paths)
    for path in files:
        photo = read_labelled_photo(path, regions, labeller)
        sources.append(photo.source)
        unlabelled += not photo.labelled
        for kind, mask in photo.masks.items():
            pixels = photo.linear[mask]
            every = max(1, len(pixels) // MAX_PIXELS)
            found.setdefault(kind, []).append(pixels[::every])
    notes = (unlabelled_note(unlabelled, len(files)),) if unlabelled else ()
    colours = {kind: np.concatenate(parts) for kind, parts in sorted(found.items())}
    return StylePhotos(colours, tuple(sources), notes)


def unlabelled_note(unlabelled: int, photos: int) -> str:
    """Return what a user should know about style photos without classes."""
    return (
        f"{unlabelled} of {photos} style photos have no labels: all their pixels stand for"
        " vegetation and terrain; name classes with --style-region or --labels"
    )


@dataclass(frozen=True)
class LabelledPhoto:
    """A style photo and where each class is in it.

    Attributes:
        linear: its linear colours, in [0, 1].
        masks: the classes that it shows.
        labelled: whether the classes are known; if not, all pixels stand for plants and for ground.
        source: the file.
    """

    linear: Float[np.ndarray, "h w 3"]
    masks: dict[int, Bool[np.ndarray, "h w"]]
    labelled: bool
    source: Source


def read_labelled_photo(
    path: Path, regions: Sequence[Region] = (), labeller: Labeller | None = None
) -> LabelledPhoto:
    """Read one style photo with its classes; see `read_style_photos`.

    Raises:
        UserError: it cannot be read, is black or of one colour, or its labels do not fit.
    """
    picture = read_rgb(path)
    linear = to_linear(picture / 255)
    check_photo(path, linear)
    source = Source(path.name, _sha256(path), licence_beside(path))
    masks: dict[int, Bool[np.ndarray, "h w"]] = {}
    if regions:
        for each in regions:
            mask = masks.setdefault(each.kind, np.zeros(linear.shape[:2], bool))
            mask[_inside(linear.shape[:2], each)] = True
        return LabelledPhoto(linear, masks, True, source)
    labels = _labels(path, picture, labeller)
    if labels is None:
        masks = {kind: np.ones(linear.shape[:2], bool) for kind in (VEGETATION, TERRAIN)}
    else:
        masks = {int(k): labels == k for k in set(np.unique(labels).tolist()) - {UNKNOWN}}
    return LabelledPhoto(linear, masks, labels is not None, source)


def check_photo(path: Path, linear: Float[np.ndarray, "h w 3"]) -> None:
    """Refuse a photo that has no colours to give.

    Raises:
        UserError: it is black or of one colour.
    """
    if linear.mean() < DARK:
        raise UserError(f"the style photo {path} is black; give another photo")
    if np.ptp(linear.reshape(-1, 3), axis=0).max() < MIN_SPREAD:
        raise UserError(f"the style photo {path} has one colour only; give another photo")


def licence_beside(path: Path) -> str:
    """Return the text of a licence file in the photo's folder or the one above, shortened."""
    for folder in (path.parent, path.parent.parent):
        for name in ("LICENSE.md", "LICENSE.txt", "LICENSE", "LICENCE.md", "LICENCE.txt"):
            if (folder / name).is_file():
                text = (folder / name).read_text("utf-8", errors="replace")[: 4 * MAX_LICENCE]
                words = " ".join(text.split())
                # A long text ends with a sentence, so that no address is cut.
                end = words.rfind(". ", 0, MAX_LICENCE) + 1
                return words if len(words) <= MAX_LICENCE else words[: end or MAX_LICENCE]
    return ""


def label_file(path: Path) -> Path | None:
    """Return the label file beside a style photo; None if there is none."""
    for folder in (path.parent / "labels", path.parent.parent / "labels"):
        file = folder / f"{path.stem}.png"
        if file.is_file():
            return file
    return None


def _labels(
    path: Path, picture: UInt8[np.ndarray, "h w 3"], labeller: Labeller | None
) -> UInt8[np.ndarray, "h w"] | None:
    """Return the classes of a photo; None if they are not known."""
    file = label_file(path)
    if file is not None:
        labels = read_labels(file)
        if labels.shape != picture.shape[:2]:
            raise UserError(f"the labels {file} have another size than their photo; make them anew")
        return MERGED[labels]
    return None if labeller is None else MERGED[labeller(picture)]


def _inside(size: tuple[int, int], region: Region) -> tuple[slice, slice]:
    """Return rows and columns of a region, at least one of each."""
    height, width = size
    left, top, right, bottom = region.box
    rows = slice(int(top * height), max(int(bottom * height), int(top * height) + 1))
    columns = slice(int(left * width), max(int(right * width), int(left * width) + 1))
    return rows, columns


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
