"""Pictures and movies as a study shows them: checked, and without metadata that names a method.

Metadata is cut out of the files. Pixels are not encoded again, except those of catch pictures.
"""

import io
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from climatenerf.core.errors import UserError, one_line
from climatenerf.core.parsing import read_bytes
from climatenerf.output.video import find_ffmpeg
from climatenerf.scene.image_files import open_image

MAX_BYTES = 512 * 2**20
"""Largest picture or movie."""
NOISE = 0.35
"""Standard deviation of the noise of a catch picture, fraction of the range."""
NOISE_CELLS = 160
"""Cells of noise across a picture: noise of single pixels would vanish on a small screen."""
FFMPEG_SECONDS = 60
SUFFIXES = {"image/jpeg": ".jpg", "image/png": ".png", "video/mp4": ".mp4"}

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHUNKS = {b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"gAMA", b"cHRM", b"sRGB", b"iCCP"}
_ORIENTATION = 0x0112
# Markers of JPEG: start of scan, JFIF, colour profile, Adobe's colour transform, comment.
_SOS, _APP0, _APP2, _APP14, _APP15, _COM = 0xDA, 0xE0, 0xE2, 0xEE, 0xEF, 0xFE
_MP4_PARENTS = (b"moov", b"trak", b"mdia")  # each inside the one before
_MP4_METADATA = {b"udta", b"meta", b"uuid", b"free", b"skip", b"ID32"}
_HANDLER_NAME = 24  # byte of a handler box at which its name begins


@dataclass(frozen=True)
class Media:
    """A picture or movie without metadata."""

    data: bytes
    type: str
    """"image/jpeg", "image/png" or "video/mp4"."""
    size: tuple[int, int]
    """Width and height, pixels."""

    @property
    def suffix(self) -> str:
        """Suffix of a file that holds it."""
        return SUFFIXES[self.type]


def read_media(path: Path, kind: str) -> Media:
    """Read a "picture" or "movie", check that it can be decoded, and remove its metadata.

    Raises:
        UserError: it cannot be read or decoded, is of another format, or is shown rotated by EXIF.
    """
    data = read_bytes(path, kind, MAX_BYTES)
    if kind == "movie":
        return Media(_without_mp4_metadata(data, path), "video/mp4", _first_frame(path).size)
    try:
        with open_image(path) as image:
            image.load()
            found, size = image.format, image.size
            turned = image.getexif().get(_ORIENTATION, 1) != 1
    except UserError:
        raise
    except Exception as error:  # Pillow's decoders raise exceptions of many types
        raise UserError(
            f"picture: {path} cannot be decoded ({one_line(str(error), 100)}); make it again"
        ) from error
    if turned:
        raise UserError(f"picture: {path} is rotated by its EXIF record; rotate its pixels instead")
    if found == "JPEG":
        return Media(_without_jpeg_metadata(data), "image/jpeg", size)
    if found == "PNG":
        return Media(_without_png_metadata(data), "image/png", size)
    raise UserError(f"picture: {path} is a {found} file; save it as JPEG or PNG")


def catch_picture(media: Media, path: Path, seed: int) -> Media:
    """Return a picture, or the first frame of a movie, under noise that nobody prefers.

    Args:
        media: the picture or movie.
        path: its file.
        seed: random seed of the noise.
    """
    picture = (
        _first_frame(path) if media.type == "video/mp4" else Image.open(io.BytesIO(media.data))
    )
    return _jpeg(with_noise(np.asarray(picture.convert("RGB")), seed))


def still_picture(path: Path) -> Media:
    """Return the first frame of a movie as a picture."""
    return _jpeg(np.asarray(_first_frame(path)))


def with_noise(picture: UInt8[np.ndarray, "h w 3"], seed: int) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture with coarse Gaussian noise of `NOISE` in each channel."""
    height, width = picture.shape[:2]
    cell = max(1, round(width / NOISE_CELLS))
    shape = (-(-height // cell), -(-width // cell), 3)
    noise = np.random.default_rng(seed).normal(0.0, 255 * NOISE, shape)
    fine = noise.repeat(cell, 0).repeat(cell, 1)[:height, :width]
    return np.clip(picture + fine, 0, 255).round().astype(np.uint8)


def _jpeg(picture: UInt8[np.ndarray, "h w 3"]) -> Media:
    encoded = io.BytesIO()
    Image.fromarray(picture).save(encoded, format="JPEG", quality=85)
    return Media(encoded.getvalue(), "image/jpeg", (picture.shape[1], picture.shape[0]))


def _first_frame(path: Path) -> Image.Image:
    """Return the first frame of a movie, RGB.

    Raises:
        UserError: ffmpeg is missing or cannot decode the movie.
    """
    command = [find_ffmpeg(), "-loglevel", "error", "-nostdin", "-i", str(path.absolute())]
    command += ["-frames:v", "1", "-f", "image2pipe", "-c:v", "png", "pipe:1"]
    try:
        done = subprocess.run(command, capture_output=True, timeout=FFMPEG_SECONDS)
        return Image.open(io.BytesIO(done.stdout)).convert("RGB")
    except (OSError, subprocess.TimeoutExpired) as error:  # Pillow's error is an OSError
        raise UserError(f"movie: {path} cannot be decoded; make it again as MP4 (H.264)") from error


def _without_jpeg_metadata(data: bytes) -> bytes:
    """Return a decodable JPEG without comments, EXIF, XMP and what follows the picture."""
    kept, position = bytearray(data[:2]), 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # a filling byte
            position += 1
            continue
        if marker == _SOS:
            break
        end = position + 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        segment = data[position:end]
        profile = marker == _APP2 and segment[4:].startswith(b"ICC_PROFILE\0")
        metadata = _APP0 < marker <= _APP15 and marker != _APP14 and not profile
        if not metadata and marker != _COM:
            kept += segment
        position = end
    end = data.rfind(b"\xff\xd9")
    return bytes(kept + data[position : end + 2 if end > position else len(data)])


def _without_png_metadata(data: bytes) -> bytes:
    """Return a decodable PNG with the chunks of pixels and colour alone."""
    kept, position = bytearray(_PNG), len(_PNG)
    while position + 12 <= len(data):
        length, name = struct.unpack(">I4s", data[position : position + 8])
        end = position + 12 + length
        if name in _PNG_CHUNKS:
            kept += data[position:end]
        if name == b"IEND":
            break
        position = end
    return bytes(kept)


def _without_mp4_metadata(data: bytes, path: Path) -> bytes:
    """Return an MP4 whose boxes of metadata are blank; all offsets stay as they are."""
    if data[4:8] != b"ftyp":
        raise UserError(f"movie: {path} is no MP4 file; convert it to MP4 (H.264)")
    blank = bytearray(data)
    _blank_boxes(blank, 0, len(blank), 0)
    return bytes(blank)


def _blank_boxes(data: bytearray, position: int, end: int, depth: int) -> None:
    while position + 8 <= end:
        size, name = struct.unpack(">I4s", data[position : position + 8])
        head = 8
        if size == 1 and position + 16 <= end:  # a size of 64 bits follows
            size, head = int.from_bytes(data[position + 8 : position + 16], "big"), 16
        elif size == 0:  # up to the end
            size = end - position
        last = position + size
        if size < head or last > end:
            return
        body = position + head
        if name in _MP4_PARENTS[depth : depth + 1]:
            _blank_boxes(data, body, last, depth + 1)
        elif name in _MP4_METADATA:
            data[position + 4 : position + 8] = b"free"
            data[body:last] = bytes(last - body)
        elif name == b"hdlr" and body + _HANDLER_NAME < last:
            data[body + _HANDLER_NAME : last] = bytes(last - body - _HANDLER_NAME)
        position = last
