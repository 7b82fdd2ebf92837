"""Import photos or frames of a video as upright JPEG pictures with their EXIF metadata."""

import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

from PIL import ExifTags, Image, UnidentifiedImageError

from climatenerf.core.errors import UserError
from climatenerf.core.storage import atomic_path, make_folder, read_json, write_json
from climatenerf.scene.image_files import (
    MissingDecoder,
    has_gain_map,
    hdr_of,
    hdr_to_srgb,
    open_image,
    profile_to_srgb,
)
from climatenerf.scene.images import ALPHA_MODES, EXIF_TRANSPOSES, wide_grey_to_8_bits
from climatenerf.sfm.exif import Exif, read_exif
from climatenerf.sfm.photos import MIN_PHOTOS, find_photos, is_video, too_few_photos
from climatenerf.sfm.video import extract_frames, sharpness, small_grey

MAX_SIDE = 2000  # pixels; more than a radiance field resolves and than features need
JPEG_QUALITY = 96
GAIN_MAP = "gain map"
CONVERSION = 2  # version of the conversion of photos; pictures of another are made anew


@dataclass(frozen=True)
class Picture:
    """One upright picture in the work folder.

    Attributes:
        name: file name in `pictures/`.
        source: original file, relative to the folder that the user gave.
        width: width as shown, pixels.
        height: height as shown, pixels.
        exif: metadata of the original file.
        sharpness: variance of the Laplacian of grey values at a width of 640 pixels.
        brightness: mean grey value, [0, 1].
        hdr: "HLG" or "PQ" if the photo was tone-mapped, `GAIN_MAP` if it has one; "" for SDR.
    """

    name: str
    source: str
    width: int
    height: int
    exif: Exif
    sharpness: float
    brightness: float
    hdr: str = ""


class Upright(NamedTuple):
    """A photo upright in sRGB, its metadata, and `Picture.hdr`."""

    image: Image.Image
    exif: Exif
    hdr: str


@dataclass(frozen=True)
class PhotoImport:
    """Result of an import.

    Attributes:
        folder: folder of the pictures.
        pictures: all usable pictures.
        unusable: cause for each original file that cannot be used.
        is_video: True if the pictures are frames of a video, in order.
        notes: sentences for the user.
    """

    folder: Path
    pictures: tuple[Picture, ...]
    unusable: dict[str, str]
    is_video: bool
    notes: tuple[str, ...] = ()


def import_photos(
    source: Path,
    work: Path,
    progress: Callable[[int, int], None],
    excluded: Collection[Path] = (),
) -> PhotoImport:
    """Convert photos or a video to upright pictures of at most `MAX_SIDE` pixels per side.

    Pictures from an earlier run are reused if their original has not changed.

    Args:
        source: folder of photos, or a video file.
        work: work folder; pictures are written to `work/pictures`.
        progress: callback with (done, total).
        excluded: folders whose pictures are not photos. The parent of `work` is always excluded.

    Raises:
        UserError: no photos, a video that cannot be decoded, fewer than three usable pictures, or
            no decoder for HEIC.
    """
    video = is_video(source)
    if video:
        frames = extract_frames(source, work / "frames", MAX_SIDE, progress)
        files, base, notes = frames.files, work / "frames", frames.notes
    else:
        found = find_photos(source, (work.parent, *excluded))
        files, base, notes = found.files, found.folder, found.notes
    folder = make_folder(work / "pictures")
    pictures, unusable, used_names = [], {}, set()
    for index, path in enumerate(files):
        name = _unique_name(path.relative_to(base), used_names)
        picture = _read_cached(path, folder / name)
        if picture is None:
            try:
                upright = open_upright(path)
            except MissingDecoder:
                raise
            except UserError as error:
                unusable[_printable(path.relative_to(base))] = str(error)
            else:
                picture = _write_picture(path, base, folder / name, upright)
        if picture is not None:
            pictures.append(picture)
        progress(index + 1, len(files))
    if len(pictures) < MIN_PHOTOS:
        why = f"; unusable: {next(iter(unusable.values()))}" if unusable else ""
        raise too_few_photos(source, len(pictures), why)
    notes = (*notes, *_hdr_notes(pictures))
    return PhotoImport(folder, tuple(pictures), unusable, video, notes)


def _hdr_notes(pictures: Sequence[Picture]) -> Iterator[str]:
    counts = Counter(picture.hdr for picture in pictures)
    for transfer in ("HLG", "PQ"):
        if counts[transfer]:
            yield (
                f"{counts[transfer]} of {len(pictures)} photos are HDR ({transfer}); they are"
                " tone-mapped to sRGB."
            )
    if counts[GAIN_MAP]:
        yield (
            f"{counts[GAIN_MAP]} of {len(pictures)} photos have an HDR gain map, which is not"
            " used; their SDR pictures are."
        )


def _printable(path: Path) -> str:
    """Return a path as printable text; bytes that are not UTF-8 are replaced."""
    return path.as_posix().encode("utf-8", "replace").decode()


def _unique_name(path: Path, used_names: set[str]) -> str:
    """Return an unused JPEG file name of plain ASCII characters that includes the folders' names.

    Blanks, "#", "%" and others have a meaning in COLMAP's lists and in URLs.
    """
    stem = re.sub(r"[^A-Za-z0-9._-]+", "_", "_".join([*path.parts[:-1], path.stem]))
    stem = stem.strip("._") or "photo"
    name, number = f"{stem}.jpg", 1
    while name.lower() in used_names:
        number += 1
        name = f"{stem}_{number}.jpg"
    used_names.add(name.lower())
    return name


def _read_cached(path: Path, out: Path) -> Picture | None:
    """Return the picture that an earlier run made of the same, unchanged photo; None if none."""
    try:
        record = read_json(out.with_suffix(".json"))
        if record.pop("stamp") != _stamp(path, out):
            return None
        return picture_from_json(record)
    except (UserError, OSError, ValueError, KeyError, TypeError):
        return None  # missing, incomplete or of an unknown version: convert the photo again


def _write_picture(path: Path, base: Path, out: Path, upright: Upright) -> Picture:
    """Write a picture and its JSON record to the work folder."""
    image, exif, hdr = upright
    with atomic_path(out) as temporary:
        image.save(temporary, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    grey = small_grey(image)
    source = _printable(path.relative_to(base))
    brightness = float(grey.mean() / 255)
    picture = Picture(out.name, source, *image.size, exif, sharpness(grey), brightness, hdr)
    write_json(out.with_suffix(".json"), {**asdict(picture), "stamp": _stamp(path, out)})
    return picture


def _stamp(path: Path, out: Path) -> list[int]:
    """Return what changes if a photo, its picture or the conversion does."""
    photo = path.stat()
    return [CONVERSION, photo.st_size, photo.st_mtime_ns, out.stat().st_size]


def picture_from_json(data: dict) -> Picture:
    """Return a picture from the JSON of its fields; null in a vector becomes NaN."""
    exif = dict(data["exif"])
    if "place" in exif:  # a record of an earlier version
        exif["gps"] = exif.pop("place")
    for key in ("gps", "down"):
        if exif[key] is not None:
            exif[key] = tuple(math.nan if x is None else x for x in exif[key])
    return Picture(**{**data, "exif": Exif(**exif)})


def open_upright(path: Path) -> Upright:
    """Return a photo upright, in sRGB, with at most `MAX_SIDE` pixels per side; and its EXIF.

    Raises:
        UserError: the file is empty, damaged, not a picture, or too large to decode.
        MissingDecoder: the file is HEIC and its decoder is not installed.
    """
    name = _printable(Path(path.name))
    try:
        if path.stat().st_size == 0:
            raise UserError(f"{name} is empty")
        with open_image(path, name) as image:
            exif, profile, hdr = read_exif(image), image.info.get("icc_profile"), hdr_of(image)
            gain_map = has_gain_map(image)
            if hdr is not None:
                small, profile = hdr_to_srgb(image, hdr, MAX_SIDE), None
            else:
                image.draft("RGB", (MAX_SIDE, MAX_SIDE))  # decodes a JPEG at a reduced size
                image.load()
                small = _reduced(image)
            # A TIFF decoder rotates the picture itself and removes the tag.
            pending = image.getexif().get(ExifTags.Base.Orientation, 1) == exif.orientation
            transpose = EXIF_TRANSPOSES.get(exif.orientation) if pending else None
            upright = small if transpose is None else small.transpose(transpose)
            upright = profile_to_srgb(upright.convert("RGB"), profile)
            return Upright(upright, exif, hdr.transfer if hdr else GAIN_MAP if gain_map else "")
    except UserError:
        raise
    except Exception as error:  # decoders raise any exception for damaged files
        raise UserError(f"{name} {_cause(error)}") from error


def _reduced(image: Image.Image) -> Image.Image:
    """Return a decoded image as RGB or grey, reduced to `MAX_SIDE`; alpha is dropped.

    No second copy of the full size is made for common modes: one of 400 megapixels takes 1.6 GB.
    """
    if image.mode in ("RGB", "L"):
        return _thumbnail(image)
    if image.mode.startswith("I") or image.mode == "F":
        return _thumbnail(Image.fromarray(wide_grey_to_8_bits(image)))
    if image.mode in ALPHA_MODES or "transparency" in image.info:
        image = image if image.mode == "RGBA" else image.convert("RGBA")
        return Image.merge("RGB", [_thumbnail(image.getchannel(band)) for band in "RGB"])
    return _thumbnail(image.convert("RGB"))


def _thumbnail(image: Image.Image) -> Image.Image:
    image.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.LANCZOS, reducing_gap=3.0)
    return image


def _cause(error: Exception) -> str:
    """Return the cause of a failed decoding; decoders' own messages name their internals."""
    if isinstance(error, UnidentifiedImageError):
        return "is not a picture, or is damaged from its first bytes on"
    if isinstance(error, FileNotFoundError):
        return "is a link to a file that does not exist"
    if isinstance(error, PermissionError):
        return "may not be read; change its permissions"
    if isinstance(error, IsADirectoryError):
        return "is a folder with the name of a picture"
    if isinstance(error, MemoryError):
        return "needs more memory to decode than available; make it smaller"
    return "is damaged or cut off"
