"""Build photos with EXIF for tests."""

import struct
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

Base, GPS = ExifTags.Base, ExifTags.GPS


def degrees(value: float) -> tuple[float, float, float]:
    """Return degrees, minutes and seconds of an absolute angle."""
    value = abs(value)
    minutes = (value % 1) * 60
    return float(int(value)), float(int(minutes)), (minutes % 1) * 60


def apple_note(vector):
    """Return an iPhone's maker note with an acceleration vector in g, behind another entry."""
    entries = struct.pack(">HHII", 1, 9, 1, 14) + struct.pack(">HHII", 8, 10, 3, 14 + 2 + 24 + 4)
    numbers = [part for value in vector for part in (round(value * 10000), 10000)]
    head = b"Apple iOS\0\0\1MM" + struct.pack(">H", 2)
    return head + entries + struct.pack(">I", 0) + struct.pack(">6i", *numbers)


def exif(
    orientation=1,
    focal=None,
    equivalent=None,
    gps=None,
    camera=("Maker", "Model 5"),
    gravity=None,
    lens=None,
):
    """Return an EXIF block.

    Args:
        orientation: EXIF orientation, 1 to 8.
        focal: focal length, mm.
        equivalent: 35 mm equivalent focal length, mm.
        gps: (latitude deg, longitude deg, altitude m).
        camera: maker and model.
        gravity: acceleration vector of an iPhone, g.
        lens: name of the lens.
    """
    data = Image.Exif()
    data[Base.Orientation] = orientation
    if camera:
        data[Base.Make], data[Base.Model] = camera
    detail = data.get_ifd(ExifTags.IFD.Exif)
    if focal is not None:
        detail[Base.FocalLength] = focal
    if equivalent is not None:
        detail[Base.FocalLengthIn35mmFilm] = equivalent
    if gravity is not None:
        detail[Base.MakerNote] = apple_note(gravity)
    if lens is not None:
        detail[Base.LensModel] = lens
    if gps is not None:
        tags = data.get_ifd(ExifTags.IFD.GPSInfo)
        tags[GPS.GPSLatitudeRef] = "N" if gps[0] >= 0 else "S"
        tags[GPS.GPSLatitude] = degrees(gps[0])
        tags[GPS.GPSLongitudeRef] = "E" if gps[1] >= 0 else "W"
        tags[GPS.GPSLongitude] = degrees(gps[1])
        tags[GPS.GPSAltitude] = gps[2]
    return data


def photo(path: Path, size=(64, 48), data=None, seed=0, **options) -> Image.Image:
    """Save noise with a red block in the upper left corner; return the image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(60, 200, (size[1], size[0], 3), dtype=np.uint8)
    image = Image.fromarray(pixels)
    image.paste((250, 10, 10), (0, 0, size[0] // 4, size[1] // 4))
    image.save(path, **({"exif": data} if data is not None else {}), **options)
    return image
