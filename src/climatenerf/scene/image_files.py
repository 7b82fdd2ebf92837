"""Opening of image files: HEIC decoder, limit of the size, HDR signals and colour profiles."""

from __future__ import annotations

import io
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageCms

from climatenerf.core.errors import UserError
from climatenerf.core.hdr import Transfer, image_to_sdr
from climatenerf.core.regular_files import check_regular

PHOTO_SUFFIXES = {
    ".jpg", ".jpeg", ".png", ".heic", ".heif", ".hif", ".tif", ".tiff", ".webp", ".bmp",
}  # fmt: skip
"""Lower-case suffixes of photos; `.hif` is the HEIC of Canon, Fujifilm and Sony."""
MAX_PIXELS = 400_000_000  # largest image that is decoded: 1.6 GB in Pillow's memory
_HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs")
_HEIF_BRANDS = (b"mif1", b"msf1")  # HEIC or AVIF: the compatible brands tell
_GAIN_MAPS = (b"hdrgm:Version", b"HDRGainMap")  # XMP of Ultra HDR and of Apple
# Code points of ITU-T H.273.
_TRANSFERS: dict[int, Transfer] = {16: "PQ", 18: "HLG"}
_PRIMARIES = {1: "bt709", 9: "bt2020", 11: "p3", 12: "p3"}
_MAX_CHUNKS = 200  # of a PNG before its pixels
_AVIF_HEAD = 1 << 16  # bytes that hold the properties of an AVIF image
_PROGRAMS = ("EPS", "WMF")  # Pillow has Ghostscript or Windows run them
_SAME = 2  # 8-bit values by which a profile may differ from sRGB and still be left alone

_pixel_limit = threading.Lock()


class MissingDecoder(UserError):
    """The library that decodes a file is not installed."""


class Hdr(NamedTuple):
    """Signal of an HDR image: transfer function, and primaries as in `core.hdr.PRIMARIES`."""

    transfer: Transfer
    primaries: str


@contextmanager
def open_image(path: Path, name: str | None = None) -> Iterator[Image.Image]:
    """Open an image file, also HEIC, without decoding it.

    Args:
        path: the file.
        name: text that names the file in messages; None for the path.

    Raises:
        UserError: the image has more than `MAX_PIXELS`, or is a pipe or a device.
        MissingDecoder: the file is HEIC and pi-heif is not installed.
        Exception: Pillow cannot identify the file.
    """
    name = str(path) if name is None else name
    # Open the file here: Pillow corrupts rotated TIFFs that it memory-maps by name.
    check_regular(path)
    with path.open("rb") as file:
        _register_heif(file, name)
        with _without_pixel_limit():
            image = Image.open(file)
        with image:
            if image.format in _PROGRAMS:
                raise ValueError(f"{name} is a program rather than a picture")
            if image.width * image.height > MAX_PIXELS:
                raise UserError(
                    f"{name} has {image.width}x{image.height} pixels, above the limit of"
                    f" {MAX_PIXELS / 1e6:g} megapixels; make it smaller"
                )
            yield image


@contextmanager
def _without_pixel_limit() -> Iterator[None]:
    """Suspend Pillow's limit of 89 megapixels, beyond which it warns; the limit is global."""
    with _pixel_limit:
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            yield
        finally:
            Image.MAX_IMAGE_PIXELS = limit


def _register_heif(file: IO[bytes], name: str) -> None:
    """Register the HEIC decoder with Pillow if the content of the file is HEIC."""
    head = file.read(64)
    file.seek(0)
    brand = head[8:12] if head[4:8] == b"ftyp" else b""
    if brand not in _HEIC_BRANDS and (brand not in _HEIF_BRANDS or b"avif" in head[16:]):
        return
    try:
        import pi_heif
    except ImportError as error:
        raise MissingDecoder(
            f'{name} is a HEIC file; run `pip install "climatenerf[capture]"` to read it'
        ) from error
    if "HEIF" not in Image.OPEN:
        pi_heif.register_heif_opener()


def hdr_of(image: Image.Image) -> Hdr | None:
    """Return the HDR signal of an opened image; None for SDR.

    It is stated by the `nclx` box of HEIC and AVIF, the `cICP` chunk of PNG or an ICC profile.
    """
    nclx = image.info.get("nclx_profile") or {}
    primaries = int(nclx.get("color_primaries", 0))
    code = int(nclx.get("transfer_characteristics", 0))
    if code not in _TRANSFERS and (file := getattr(image, "fp", None)) is not None:
        position = file.tell()
        if image.format == "PNG":
            primaries, code = _png_code_points(file)
        elif image.format == "AVIF":
            primaries, code = _avif_code_points(file)
        file.seek(position)
    if code not in _TRANSFERS:
        primaries, code = _cicp(image.info.get("icc_profile") or b"")
    transfer = _TRANSFERS.get(code)
    return None if transfer is None else Hdr(transfer, _PRIMARIES.get(primaries, "bt2020"))


def _png_code_points(file: IO[bytes]) -> tuple[int, int]:
    """Return primaries and transfer of a PNG's `cICP` chunk (PNG 3, 11.3.2.6); 0, 0 if none."""
    position = 8
    for _ in range(_MAX_CHUNKS):
        file.seek(position)
        head = file.read(12)
        if len(head) < 12 or head[4:8] == b"IDAT":
            break
        if head[4:8] == b"cICP":
            return head[8], head[9]
        position += 12 + int.from_bytes(head[:4], "big")
    return 0, 0


def _avif_code_points(file: IO[bytes]) -> tuple[int, int]:
    """Return primaries and transfer of an AVIF's `nclx` box (ISO/IEC 14496-12); 0, 0 if none."""
    file.seek(0)
    head = file.read(_AVIF_HEAD)
    at = head.find(b"colrnclx")
    if not 0 <= at <= len(head) - 12:
        return 0, 0
    primaries, transfer = struct.unpack_from(">HH", head, at + 8)
    return primaries, transfer


def _cicp(profile: bytes) -> tuple[int, int]:
    """Return primaries and transfer of an ICC profile's `cicp` tag (ICC.1:2022); 0, 0 if none."""
    try:
        (count,) = struct.unpack_from(">I", profile, 128)
        for entry in range(132, 132 + 12 * min(count, 100), 12):
            tag, offset, _ = struct.unpack_from(">4sII", profile, entry)
            if tag == b"cicp":
                kind, primaries, transfer = struct.unpack_from(">4s4xBB", profile, offset)
                return (primaries, transfer) if kind == b"cicp" else (0, 0)
    except struct.error:
        pass
    return 0, 0


def has_gain_map(image: Image.Image) -> bool:
    """Return whether an opened image says that it holds an HDR gain map beside its SDR picture."""
    xmp = image.info.get("xmp") or b""
    xmp = xmp.encode() if isinstance(xmp, str) else xmp
    kinds = image.info.get("aux") or {}  # of a HEIC
    return any(word in xmp for word in _GAIN_MAPS) or any("hdrgainmap" in str(k) for k in kinds)


def hdr_to_srgb(image: Image.Image, hdr: Hdr, side: int | None = None) -> Image.Image:
    """Return an opened HDR image as 8-bit sRGB.

    Args:
        image: the image, opened by `open_image` and not yet decoded.
        hdr: its signal.
        side: largest side of the result, pixels; None keeps the size.
    """
    values, full_scale = _signal(image)
    if side is not None and max(values.shape[:2]) > side:
        channels = []
        for index in range(3):
            channel = Image.fromarray(values[..., index].astype(np.float32))
            channel.thumbnail((side, side), Image.Resampling.LANCZOS, reducing_gap=3.0)
            channels.append(np.asarray(channel))
        values = np.stack(channels, axis=-1)
    return Image.fromarray(image_to_sdr(values, full_scale, *hdr))


def _signal(image: Image.Image) -> tuple[np.ndarray, float]:
    """Return R'G'B' [h w 3] of an HDR image with all its bits, and the value of the signal 1."""
    bits = image.info.get("bit_depth", 8)
    file = getattr(image, "fp", None)
    if image.format == "HEIF" and bits > 8 and file is not None:
        import pi_heif

        # Pillow has no mode for RGB of more than 8 bits.
        heif = pi_heif.open_heif(file, convert_hdr_to_8bit=False, hdr_to_16bit=False)
        values = np.asarray(heif)
        if values.ndim == 3 and values.shape[2] >= 3:
            return values[..., :3], 2.0**bits - 1
    return np.asarray(image.convert("RGB")), 255.0


def profile_to_srgb(image: Image.Image, profile: bytes | None) -> Image.Image:
    """Convert from the ICC profile's colour space (a phone's Display P3) to sRGB."""
    if not profile:
        return image
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        converted = ImageCms.profileToProfile(image, source, ImageCms.createProfile("sRGB"))
        return converted or image
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return image  # the profile is damaged or not for RGB (grey, CMYK)


@lru_cache(maxsize=8)
def differs_from_srgb(profile: bytes) -> bool:
    """Return whether conversion from a profile changes any 8-bit colour by more than rounding."""
    axis = np.linspace(0, 255, 5).astype(np.uint8)
    colours = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(25, 5, 3)
    converted: UInt8[np.ndarray, "25 5 3"] = np.asarray(
        profile_to_srgb(Image.fromarray(colours), profile)
    )
    return bool(np.abs(converted.astype(int) - colours).max() > _SAME)
