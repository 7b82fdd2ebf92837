"""Import photos or frames of a video as upright JPEG pictures with their EXIF metadata."""

import contextlib
import errno
import io
import math
import re
import shutil
import subprocess
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image, ImageCms, UnidentifiedImageError

from climatenerf.core.errors import UserError
from climatenerf.core.storage import atomic_path, explain, make_folder, read_json, write_json
from climatenerf.scene.images import EXIF_TRANSPOSES, to_rgb
from climatenerf.sfm.exif import Exif, read_exif
from climatenerf.sfm.photos import MIN_PHOTOS, find_photos, is_video, too_few_photos

MAX_SIDE = 2000  # pixels; more than a radiance field resolves and than features need
MAX_PIXELS = 400_000_000  # largest picture that is decoded: 1.2 GB in memory
JPEG_QUALITY = 96
VIDEO_FRAMES = 100  # intervals of a video; the sharpest frame of each is used
CANDIDATES_PER_INTERVAL = 5  # decoded frames per interval


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
    """

    name: str
    source: str
    width: int
    height: int
    exif: Exif
    sharpness: float
    brightness: float


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
        UserError: no photos, a video that cannot be decoded, or fewer than three usable pictures.
    """
    video = is_video(source)
    if video:
        files, base, notes = extract_frames(source, work / "frames", progress), work / "frames", ()
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
                image, exif = open_upright(path)
            except UserError as error:
                unusable[_printable(path.relative_to(base))] = str(error)
            else:
                picture = _write_picture(path, base, folder / name, image, exif)
        if picture is not None:
            pictures.append(picture)
        progress(index + 1, len(files))
    if len(pictures) < MIN_PHOTOS:
        why = f"; unusable: {next(iter(unusable.values()))}" if unusable else ""
        raise too_few_photos(source, len(pictures), why)
    return PhotoImport(folder, tuple(pictures), unusable, video, notes)


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
        if record.pop("stamp") != [*_stamp(path), out.stat().st_size]:
            return None
        return picture_from_json(record)
    except (UserError, OSError, ValueError, KeyError, TypeError):
        return None  # missing, incomplete or of an unknown version: convert the photo again


def _write_picture(path: Path, base: Path, out: Path, image: Image.Image, exif: Exif) -> Picture:
    """Write a picture and its JSON record to the work folder."""
    with atomic_path(out) as temporary:
        image.save(temporary, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    grey = small_grey(image)
    source = _printable(path.relative_to(base))
    brightness = float(grey.mean() / 255)
    picture = Picture(out.name, source, *image.size, exif, sharpness(grey), brightness)
    stamp = [*_stamp(path), out.stat().st_size]
    write_json(out.with_suffix(".json"), {**asdict(picture), "stamp": stamp})
    return picture


def _stamp(path: Path) -> list[int]:
    """Return size and modification time of a file, to detect changes."""
    return [path.stat().st_size, path.stat().st_mtime_ns]


def picture_from_json(data: dict) -> Picture:
    """Return a picture from the JSON of its fields; null in a vector becomes NaN."""
    exif = dict(data["exif"])
    if "place" in exif:  # a record of an earlier version
        exif["gps"] = exif.pop("place")
    for key in ("gps", "down"):
        if exif[key] is not None:
            exif[key] = tuple(math.nan if x is None else x for x in exif[key])
    return Picture(**{**data, "exif": Exif(**exif)})


def open_upright(path: Path) -> tuple[Image.Image, Exif]:
    """Return a photo upright, in sRGB, with at most `MAX_SIDE` pixels per side; and its EXIF.

    Raises:
        UserError: the file is empty, damaged, not a picture, or too large to decode.
    """
    name = _printable(Path(path.name))
    if path.suffix.lower() in (".heic", ".heif"):
        _register_heif(name)
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, MAX_PIXELS
    try:
        if path.stat().st_size == 0:
            raise UserError(f"{name} is empty")
        # Open the file here: Pillow corrupts rotated TIFFs that it memory-maps by name.
        with path.open("rb") as file, Image.open(file) as image:
            if image.width * image.height > MAX_PIXELS:
                raise UserError(
                    f"{name} has {image.width}x{image.height} pixels, above the limit of"
                    f" {MAX_PIXELS / 1e6:g} megapixels; make it smaller"
                )
            exif, profile = read_exif(image), image.info.get("icc_profile")
            image.draft("RGB", (MAX_SIDE, MAX_SIDE))  # decodes a JPEG at a reduced size
            image.load()
            # A TIFF decoder rotates the picture itself and removes the tag.
            pending = image.getexif().get(ExifTags.Base.Orientation, 1) == exif.orientation
            transpose = EXIF_TRANSPOSES.get(exif.orientation) if pending else None
            # Reduce the size first: each full copy of 200 megapixels takes 600 MB.
            small = image if image.mode in ("RGB", "L") else Image.fromarray(to_rgb(image))
            small.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.LANCZOS, reducing_gap=3.0)
            upright = small if transpose is None else small.transpose(transpose)
            return _to_srgb(upright.convert("RGB"), profile), exif
    except UserError:
        raise
    except Exception as error:  # decoders raise any exception for damaged files
        raise UserError(f"{name} {_cause(error)}") from error
    finally:
        Image.MAX_IMAGE_PIXELS = limit


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
    if isinstance(error, Image.DecompressionBombError):
        return f"exceeds {MAX_PIXELS / 1e6:g} megapixels; make it smaller"
    if isinstance(error, MemoryError):
        return "needs more memory to decode than available; make it smaller"
    return "is damaged or cut off"


def _to_srgb(image: Image.Image, profile: bytes | None) -> Image.Image:
    """Convert from the ICC profile's colour space (a phone's Display P3) to sRGB."""
    if not profile:
        return image
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        converted = ImageCms.profileToProfile(image, source, ImageCms.createProfile("sRGB"))
        return converted or image
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return image  # the profile is damaged or not for RGB (grey, CMYK)


def _register_heif(name: str) -> None:
    try:
        import pi_heif
    except ImportError as error:
        raise UserError(
            f'{name} is a HEIC file; run `pip install "climatenerf[capture]"` to read it'
        ) from error
    pi_heif.register_heif_opener()


def small_grey(image: Image.Image) -> UInt8[np.ndarray, "h w"]:
    """Return grey values at a width of 640 pixels, so that statistics are comparable."""
    height = max(8, round(640 * image.height / image.width))
    return np.asarray(image.convert("L").resize((640, height), Image.Resampling.BILINEAR))


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Return the variance of the 4-neighbour Laplacian, without the border pixels."""
    g = grey.astype(np.float32)
    neighbours = g[:-2, 1:-1] + g[2:, 1:-1] + g[1:-1, :-2] + g[1:-1, 2:]
    return float((neighbours - 4 * g[1:-1, 1:-1]).var())


def extract_frames(video: Path, folder: Path, progress: Callable[[int, int], None]) -> list[Path]:
    """Extract the sharpest frame of each of `VIDEO_FRAMES` intervals as numbered JPEG files.

    Args:
        video: the video file.
        folder: folder for the frames; complete frames of an earlier run are reused.
        progress: callback with (done, total).

    Raises:
        UserError: ffmpeg is missing or cannot decode the video, or the disk is full.
    """
    record_path = folder / "done.json"
    stamp = _stamp(video)
    with contextlib.suppress(UserError, KeyError):
        frames, record = sorted(folder.glob("[0-9]*.jpg")), read_json(record_path)
        if record["stamp"] == stamp and record["frames"] == len(frames):
            return frames
    try:
        import imageio_ffmpeg

        ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
        count, seconds = imageio_ffmpeg.count_frames_and_secs(str(video))
    except (ImportError, RuntimeError, OSError) as error:
        raise UserError(
            f"{video} cannot be decoded ({str(error).strip().splitlines()[-1]});"
            " convert it to MP4 (H.264), or give photos instead"
        ) from error
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    if not count or not seconds or seconds <= 0:
        raise UserError(f"{video} contains no frames; record it again, or give photos instead")
    sampled = min(count, VIDEO_FRAMES * CANDIDATES_PER_INTERVAL)
    # All frames of a short video are candidates: a higher rate would duplicate some.
    rate = [] if sampled == count else [f"fps={sampled / seconds:.6f}"]
    scale = ",".join([*rate, f"scale='min({MAX_SIDE},iw)':-2"])
    command = [ffmpeg, "-y", "-loglevel", "error", "-nostdin", "-i", str(video), "-vf", scale]
    command += ["-fps_mode", "passthrough", "-q:v", "2", str(folder / "candidate_%05d.jpg")]
    message = _run_ffmpeg(command, folder, lambda: progress(_count(folder), 2 * sampled))
    candidates = sorted(folder.glob("candidate_*.jpg"))
    if not candidates:
        raise UserError(
            f"{video} cannot be decoded ({message}); convert it to MP4 (H.264), or give photos"
            " instead"
        )
    frames = []
    intervals = min(VIDEO_FRAMES, len(candidates))
    for interval in np.array_split(np.array(candidates), intervals):
        sharpest = max(interval, key=lambda path: sharpness(small_grey(Image.open(path))))
        target = folder / f"{len(frames):04d}.jpg"
        sharpest.rename(target)
        frames.append(target)
        progress(sampled + len(frames), sampled + intervals)
    for path in folder.glob("candidate_*.jpg"):
        path.unlink()
    write_json(record_path, {"stamp": stamp, "frames": len(frames)})
    return frames


def _run_ffmpeg(command: list[str], folder: Path, on_wait: Callable[[], None]) -> str:
    """Run ffmpeg and return the last line of its messages.

    Args:
        command: program and arguments.
        folder: folder of the frames and, meanwhile, of the log.
        on_wait: called about twice a second.

    Raises:
        UserError: the disk is full.
    """
    log = folder / "ffmpeg.log"
    with log.open("wb") as file:
        process = subprocess.Popen(command, stderr=file)
    try:
        while process.poll() is None:
            on_wait()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.5)
    finally:
        process.kill()
        process.wait()
    messages = log.read_text(errors="replace").strip()
    log.unlink()
    if "No space left" in messages or (process.returncode and shutil.disk_usage(folder).free < 1e6):
        raise explain(OSError(errno.ENOSPC, ""), folder)
    return messages.splitlines()[-1] if messages else "no frame was decoded"


def _count(folder: Path) -> int:
    return sum(1 for _ in folder.glob("candidate_*.jpg"))
