"""Photos with EXIF, written by the tests themselves."""

import struct
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

Base, GPS = ExifTags.Base, ExifTags.GPS


def degrees(value: float) -> tuple[float, float, float]:
    value = abs(value)
    minutes = (value % 1) * 60
    return float(int(value)), float(int(minutes)), (minutes % 1) * 60


def apple_note(vector):
    """An iPhone's maker note with an acceleration vector, g, behind another entry."""
    entries = struct.pack(">HHII", 1, 9, 1, 14) + struct.pack(">HHII", 8, 10, 3, 14 + 2 + 24 + 4)
    numbers = [part for value in vector for part in (round(value * 10000), 10000)]
    head = b"Apple iOS\0\0\1MM" + struct.pack(">H", 2)
    return head + entries + struct.pack(">I", 0) + struct.pack(">6i", *numbers)


def exif(
    orientation=1,
    focal=None,
    equivalent=None,
    place=None,
    camera=("Maker", "Model 5"),
    gravity=None,
    lens=None,
):
    """An EXIF block: mm, 35 mm equivalent, (latitude, longitude, altitude), a phone's vector."""
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
    if place is not None:
        gps = data.get_ifd(ExifTags.IFD.GPSInfo)
        gps[GPS.GPSLatitudeRef] = "N" if place[0] >= 0 else "S"
        gps[GPS.GPSLatitude] = degrees(place[0])
        gps[GPS.GPSLongitudeRef] = "E" if place[1] >= 0 else "W"
        gps[GPS.GPSLongitude] = degrees(place[1])
        gps[GPS.GPSAltitude] = place[2]
    return data


def photo(path: Path, size=(64, 48), data=None, seed=0, **options) -> Image.Image:
    """Noise with a red block in the upper left corner as shown, stored as EXIF says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(60, 200, (size[1], size[0], 3), dtype=np.uint8)
    image = Image.fromarray(pixels)
    image.paste((250, 10, 10), (0, 0, size[0] // 4, size[1] // 4))
    image.save(path, **({"exif": data} if data is not None else {}), **options)
    return image
