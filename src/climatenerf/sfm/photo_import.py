"""Photos of any kind, or a video, as upright pictures in a work folder, with what EXIF says."""

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

MAX_SIDE = 2000  # pixels: more than a radiance field of a place resolves, and features need less
MAX_PIXELS = 400_000_000  # of a picture that is decoded at all: 1.2 GB
JPEG_QUALITY = 96
VIDEO_FRAMES = 100  # frames taken from a video, the sharpest of as many intervals
CANDIDATES_PER_INTERVAL = 5  # looked at in each interval


@dataclass(frozen=True)
class Picture:
    """One upright picture in the work folder.

    Attributes:
        name: File name in `pictures/`.
        source: File it was made from, relative to what the user gave.
        width: Pixels, as shown.
        height: Pixels, as shown.
        exif: What its EXIF says; the focal length is for the picture as shown.
        sharpness: Variance of the Laplacian of grey values at 640 pixels' width.
        brightness: Mean grey value, [0,1].
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
    """All usable pictures, what could not be used with the reason, and notes for the user."""

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
    """Makes upright pictures of at most `MAX_SIDE` pixels from photos or a video.

    Finished pictures are kept, so that an interrupted run goes on where it was.

    Args:
        source: folder of photos, or a video file.
        work: work folder; pictures go to `work/pictures`.
        progress: told (done, all).
        excluded: folders whose pictures are no photos; the scene that is being made is one always.

    Raises:
        UserError: nothing to read, a video that cannot be decoded, or fewer than three pictures.
    """
    video = is_video(source)
    if video:
        files, base, notes = extract_frames(source, work / "frames", progress), work / "frames", ()
    else:
        found = find_photos(source, (work.parent, *excluded))
        files, base, notes = found.files, found.folder, found.notes
    folder = make_folder(work / "pictures")
    pictures, unusable, taken = [], {}, set()
    for index, path in enumerate(files):
        name = _unique_name(path.relative_to(base), taken)
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
    """A path as text that can be printed and kept, whatever bytes its name is made of."""
    return path.as_posix().encode("utf-8", "replace").decode()


def _unique_name(path: Path, taken: set[str]) -> str:
    """A flat JPEG name of plain letters: folders become part of it; two photos never share one.

    COLMAP's lists and a page's addresses give a meaning to blanks, "#", "%" and more.
    """
    stem = re.sub(r"[^A-Za-z0-9._-]+", "_", "_".join([*path.parts[:-1], path.stem]))
    stem = stem.strip("._") or "photo"
    name, number = f"{stem}.jpg", 1
    while name.lower() in taken:
        number += 1
        name = f"{stem}_{number}.jpg"
    taken.add(name.lower())
    return name


def _read_cached(path: Path, out: Path) -> Picture | None:
    """The picture that an earlier run has made of this very photo, if it has."""
    record = out.with_suffix(".json")
    try:
        known = read_json(record)
        if known.pop("stamp") != [*_stamp(path), out.stat().st_size]:
            return None
        return picture_from_json(known)
    except (UserError, OSError, ValueError, KeyError, TypeError):
        return None  # none yet, half written or of an older version: made again


def _write_picture(path: Path, base: Path, out: Path, image: Image.Image, exif: Exif) -> Picture:
    with atomic_path(out) as temporary:
        image.save(temporary, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    grey = small_grey(image)
    source = _printable(path.relative_to(base))
    measured = sharpness(grey), float(grey.mean() / 255)
    picture = Picture(out.name, source, *image.size, exif, *measured)
    stamp = [*_stamp(path), out.stat().st_size]
    write_json(out.with_suffix(".json"), {**asdict(picture), "stamp": stamp})
    return picture


def _stamp(path: Path) -> list[int]:
    return [path.stat().st_size, path.stat().st_mtime_ns]


def picture_from_json(data: dict) -> Picture:
    """A picture from the JSON of its fields; numbers that were not finite come back as NaN."""
    exif = dict(data["exif"])
    if "place" in exif:  # a record of an earlier version
        exif["gps"] = exif.pop("place")
    for key in ("gps", "down"):
        if exif[key] is not None:
            exif[key] = tuple(math.nan if x is None else x for x in exif[key])
    return Picture(**{**data, "exif": Exif(**exif)})


def open_upright(path: Path) -> tuple[Image.Image, Exif]:
    """A photo as it is meant to be seen, in RGB of at most `MAX_SIDE` pixels, with its EXIF.

    Raises:
        UserError: empty, damaged, no picture at all, or too large to decode.
    """
    name = _printable(Path(path.name))
    if path.suffix.lower() in (".heic", ".heif"):
        _register_heif(name)
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, MAX_PIXELS
    try:
        if path.stat().st_size == 0:
            raise UserError(f"{name} is empty")
        # Through an open file: Pillow garbles turned TIFFs that it maps into memory by their name.
        with path.open("rb") as file, Image.open(file) as image:
            if image.width * image.height > MAX_PIXELS:
                raise UserError(f"{name} has {image.width}x{image.height} pixels: too large")
            exif, profile = read_exif(image), image.info.get("icc_profile")
            image.draft("RGB", (MAX_SIDE, MAX_SIDE))  # a JPEG is decoded smaller at once
            image.load()
            # A TIFF's decoder has turned the picture already and taken the tag away.
            kept = image.getexif().get(ExifTags.Base.Orientation, 1) == exif.orientation
            turn = EXIF_TRANSPOSES.get(exif.orientation) if kept else None
            # Made smaller before all else: a copy of 200 megapixels takes 600 MB.
            small = image if image.mode in ("RGB", "L") else Image.fromarray(to_rgb(image))
            small.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.LANCZOS, reducing_gap=3.0)
            small = small.convert("RGB") if turn is None else small.transpose(turn).convert("RGB")
            return _as_srgb(small, profile), exif
    except UserError:
        raise
    except Exception as error:  # decoders raise all kinds for damaged files
        raise UserError(f"{name} {_cause(error)}") from error
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _cause(error: Exception) -> str:
    """What is wrong with a photo, said of it; a decoder's own words name its internals."""
    if isinstance(error, UnidentifiedImageError):
        return "is no picture, or is damaged from its first bytes on"
    if isinstance(error, FileNotFoundError):
        return "is a link to a file that is not there"
    if isinstance(error, PermissionError):
        return "may not be read; change its permissions"
    if isinstance(error, IsADirectoryError):
        return "is a folder with the name of a picture"
    if isinstance(error, Image.DecompressionBombError):
        return f"exceeds {MAX_PIXELS / 1e6:g} megapixels: too large"
    if isinstance(error, MemoryError):
        return "takes more memory to read than there is"
    return "is damaged or cut off"


def _as_srgb(image: Image.Image, profile: bytes | None) -> Image.Image:
    """Colours that a wider profile (a phone's Display P3) means, in sRGB."""
    if not profile:
        return image
    try:
        given = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        converted = ImageCms.profileToProfile(image, given, ImageCms.createProfile("sRGB"))
        return converted or image
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return image  # a profile of another kind (grey, CMYK) or damaged


def _register_heif(name: str) -> None:
    try:
        import pi_heif
    except ImportError as error:
        raise UserError(
            f'{name} is HEIC; run `pip install "climatenerf[capture]"` to read it'
        ) from error
    pi_heif.register_heif_opener()


def small_grey(image: Image.Image) -> UInt8[np.ndarray, "h w"]:
    """Grey values at 640 pixels' width, for measures that are to be comparable."""
    height = max(8, round(640 * image.height / image.width))
    return np.asarray(image.convert("L").resize((640, height), Image.Resampling.BILINEAR))


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Variance of the Laplacian."""
    g = grey.astype(np.float32)
    around = g[:-2, 1:-1] + g[2:, 1:-1] + g[1:-1, :-2] + g[1:-1, 2:]
    return float((around - 4 * g[1:-1, 1:-1]).var())


def extract_frames(video: Path, folder: Path, progress: Callable[[int, int], None]) -> list[Path]:
    """The sharpest frame of each of `VIDEO_FRAMES` intervals, as JPEG files named by number.

    Raises:
        UserError: ffmpeg is missing or cannot decode the video.
    """
    done = folder / "done.json"
    stamp = _stamp(video)
    with contextlib.suppress(UserError, KeyError):
        frames, known = sorted(folder.glob("[0-9]*.jpg")), read_json(done)
        if known["stamp"] == stamp and known["frames"] == len(frames):
            return frames
    try:
        import imageio_ffmpeg

        ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
        count, seconds = imageio_ffmpeg.count_frames_and_secs(str(video))
    except (ImportError, RuntimeError, OSError) as error:
        raise UserError(
            f"{video} cannot be decoded ({str(error).strip().splitlines()[-1]});"
            " convert it to MP4 (H.264), or give photos"
        ) from error
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    if not count or not seconds or seconds <= 0:
        raise UserError(f"{video} holds no frames; record it again or give photos")
    wanted = min(count, VIDEO_FRAMES * CANDIDATES_PER_INTERVAL)
    # Of a short video all frames are candidates: at a higher rate some would come twice.
    rate = [] if wanted == count else [f"fps={wanted / seconds:.6f}"]
    scale = ",".join([*rate, f"scale='min({MAX_SIDE},iw)':-2"])
    command = [ffmpeg, "-y", "-loglevel", "error", "-nostdin", "-i", str(video), "-vf", scale]
    command += ["-fps_mode", "passthrough", "-q:v", "2", str(folder / "candidate_%05d.jpg")]
    words = _run_ffmpeg(command, folder, lambda: progress(_count(folder), 2 * wanted))
    candidates = sorted(folder.glob("candidate_*.jpg"))
    if not candidates:
        raise UserError(f"{video} cannot be decoded ({words}); convert it to MP4, or give photos")
    kept = []
    for some in np.array_split(np.array(candidates), min(VIDEO_FRAMES, len(candidates))):
        best = max(some, key=lambda path: sharpness(small_grey(Image.open(path))))
        target = folder / f"{len(kept):04d}.jpg"
        best.rename(target)
        kept.append(target)
        progress(wanted + len(kept), wanted + min(VIDEO_FRAMES, len(candidates)))
    for path in folder.glob("candidate_*.jpg"):
        path.unlink()
    write_json(done, {"stamp": stamp, "frames": len(kept)})
    return kept


def _run_ffmpeg(command: list[str], folder: Path, meanwhile: Callable[[], None]) -> str:
    """Runs ffmpeg to its end; returns its last words.

    Raises:
        UserError: the disk is full.
    """
    log = folder / "ffmpeg.log"
    with log.open("wb") as file:
        process = subprocess.Popen(command, stderr=file)
    try:
        while process.poll() is None:
            meanwhile()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.5)
    finally:
        process.kill()
        process.wait()
    words = log.read_text(errors="replace").strip()
    log.unlink()
    if "No space left" in words or (process.returncode and shutil.disk_usage(folder).free < 1e6):
        raise explain(OSError(errno.ENOSPC, ""), folder)
    return words.splitlines()[-1] if words else "no frame came out"


def _count(folder: Path) -> int:
    return sum(1 for _ in folder.glob("candidate_*.jpg"))
