"""What a photo's EXIF tells of its camera and place."""

import math
from dataclasses import dataclass

from PIL import ExifTags, Image

FULL_FRAME = math.hypot(36.0, 24.0)  # mm: the 35 mm equivalent keeps the diagonal's angle (CIPA)
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # FocalPlaneResolutionUnit in mm


@dataclass(frozen=True)
class Exif:
    """What is known of a photo before any picture is compared.

    Attributes:
        camera: Words that differ between cameras and lenses; "" if nothing is known.
        focal: Focal length over the longer side of the picture; None if unknown.
        place: (latitude deg, longitude deg, altitude m) by GPS; altitude NaN if unknown.
    """

    camera: str = ""
    focal: float | None = None
    place: tuple[float, float, float] | None = None


def read_exif(image: Image.Image) -> Exif:
    """EXIF of an opened picture; what is absent or nonsense stays unknown."""
    base = image.getexif()
    detail = base.get_ifd(ExifTags.IFD.Exif)
    words = [base.get(ExifTags.Base.Make), base.get(ExifTags.Base.Model)]
    words += [detail.get(ExifTags.Base.LensModel)]
    words += [f"{f:g}mm" for f in [_number(detail.get(ExifTags.Base.FocalLength))] if f]
    camera = " ".join(str(word).strip("\0 ") for word in words if word)
    return Exif(camera, _focal(detail, *image.size), _place(base.get_ifd(ExifTags.IFD.GPSInfo)))


def _focal(detail: dict, width: int, height: int) -> float | None:
    longer = max(width, height)
    equivalent = _number(detail.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if equivalent:
        return _sane(equivalent / FULL_FRAME * math.hypot(width, height) / longer)
    focal = _number(detail.get(ExifTags.Base.FocalLength))
    dense = _number(detail.get(ExifTags.Base.FocalPlaneXResolution))
    unit = _UNITS.get(detail.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    if focal and dense and unit:
        return _sane(focal * dense / unit / longer)
    return None


def _sane(share: float) -> float | None:
    """From fisheye (0.2) to a long tele lens (20)."""
    return share if 0.2 < share < 20 else None


def _place(gps: dict) -> tuple[float, float, float] | None:
    latitude = _degrees(gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLatitudeRef))
    longitude = _degrees(gps.get(ExifTags.GPS.GPSLongitude), gps.get(ExifTags.GPS.GPSLongitudeRef))
    if latitude is None or longitude is None or (latitude == 0 and longitude == 0):
        return None
    altitude = _number(gps.get(ExifTags.GPS.GPSAltitude))
    if altitude is not None and gps.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01"):
        altitude = -altitude
    return latitude, longitude, math.nan if altitude is None else altitude


def _degrees(parts: object, side: object) -> float | None:
    if not isinstance(parts, tuple | list) or len(parts) != 3:
        return None
    numbers = [_number(part) for part in parts]
    if any(number is None for number in numbers):
        return None
    d, m, s = (float(number or 0) for number in numbers)
    value = d + m / 60 + s / 3600
    return -value if str(side).strip("\0 ").upper() in ("S", "W") else value


def _number(value: object) -> float | None:
    """A finite number, or None for anything else (a ratio of 0/0 among it)."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None
