"""Read camera, focal length, GPS position and gravity from a photo's EXIF and XMP."""

import math
import re
import struct
from dataclasses import dataclass, replace

from PIL import ExifTags, Image

FULL_FRAME = math.hypot(36.0, 24.0)  # mm; CIPA's 35 mm equivalent keeps the diagonal angle
SUBSECONDS = ExifTags.Base.SubsecTimeOriginal
MAX_ROLL = 2.0  # degrees; a gimbal with a larger roll was moving
Down = tuple[float, float, float]
# A direction (x right, y down) in stored pixels -> the same in the picture as shown, by EXIF tag.
_ROTATE = {
    1: lambda x, y: (x, y),
    3: lambda x, y: (-x, -y),
    6: lambda x, y: (-y, x),
    8: lambda x, y: (y, -x),
}
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # FocalPlaneResolutionUnit in mm


@dataclass(frozen=True)
class Exif:
    """Metadata of a photo.

    Attributes:
        camera: text that differs between cameras and lenses; "" if unknown.
        focal: focal length over the longer side of the picture, both in pixels; None if unknown.
        gps: (latitude deg, longitude deg, altitude m); altitude NaN if unknown.
        down: direction of gravity from the camera's sensor, unit vector in the axes of the picture
            as stored (x right, y down, z forward); None if unknown.
        orientation: EXIF orientation 1 to 8, from the stored picture to the picture as shown.
        taken: time of exposure as text that sorts by time; "" if unknown.
    """

    camera: str = ""
    focal: float | None = None
    gps: tuple[float, float, float] | None = None
    down: tuple[float, float, float] | None = None
    orientation: int = 1
    taken: str = ""

    @property
    def down_as_shown(self) -> tuple[float, float, float] | None:
        """`down` in the axes of the picture as shown; None for mirrored orientations."""
        rotate = _ROTATE.get(self.orientation)
        if self.down is None or rotate is None:
            return None
        return *rotate(*self.down[:2]), self.down[2]


def read_exif(image: Image.Image) -> Exif:
    """Return the EXIF of an opened picture; missing and implausible values are unknown."""
    base = image.getexif()
    detail = base.get_ifd(ExifTags.IFD.Exif)
    words = [base.get(ExifTags.Base.Make), base.get(ExifTags.Base.Model)]
    words += [detail.get(ExifTags.Base.LensModel)]
    words += [f"{f:g}mm" for f in [_number(detail.get(ExifTags.Base.FocalLength))] if f]
    camera = " ".join(str(word).strip("\0 ") for word in words if word)
    gps = _gps(base.get_ifd(ExifTags.IFD.GPSInfo))
    orientation = base.get(ExifTags.Base.Orientation, 1)
    orientation = orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1
    down = _gimbal_gravity(image.info.get("xmp"))
    if down is None and "front" not in camera.lower():  # selfies are mirrored
        # A HEIC decoder rotates the picture itself and stores the tag that it applied.
        decoder = image.info.get("original_orientation") or 1
        upright = decoder == orientation == 1 and image.width < image.height
        # A portrait picture without a tag is an upright copy: the sensor's rows are its long side.
        down = _phone_gravity(detail.get(ExifTags.Base.MakerNote), 6 if upright else decoder)
    words = [detail.get(tag) for tag in (ExifTags.Base.DateTimeOriginal, SUBSECONDS)]
    taken = ".".join(str(word).strip("\0 ") for word in words if word) if words[0] else ""
    found = Exif(camera, _focal(detail, *image.size), gps, down, orientation, taken)
    down = found.down_as_shown
    # If gravity would point up in the picture, the orientation tag is stale: the axes are unknown.
    return replace(found, down=None) if down and down[1] < -0.5 else found


def _phone_gravity(note: object, decoder: object) -> Down | None:
    """Return gravity from tag 8 of an iPhone's maker note (ExifTool's AccelerationVector, in g).

    The vector points down, in Core Motion's axes: x to the right of the screen, y to its top, z out
    of it. The sensor's rows run along the phone: the right of its picture is the bottom of the
    phone, its lower edge the left side.

    Args:
        note: the maker note.
        decoder: orientation tag that the decoder has already applied.

    Returns:
        Unit vector in the axes of the decoded picture; None if the note has no usable vector.
    """
    g = _apple_vector(note)
    if g is None:
        return None
    x, y, z = -g[1], -g[0], -g[2]
    rotate = _ROTATE.get(decoder)  # type: ignore[call-overload]
    length = math.hypot(x, y, z)
    if rotate is None or not 0.9 < length < 1.1:  # motion of the hand adds to gravity
        return None
    x, y = rotate(x, y)
    return x / length, y / length, z / length


def _apple_vector(note: object) -> list[float] | None:
    """Return tag 8 of Apple's maker note: a big-endian TIFF directory at byte 14."""
    if not isinstance(note, bytes) or not note.startswith(b"Apple iOS\0") or note[12:14] != b"MM":
        return None
    try:
        (count,) = struct.unpack_from(">H", note, 14)
        for entry in range(16, 16 + 12 * count, 12):
            tag, kind, number, offset = struct.unpack_from(">HHII", note, entry)
            if (tag, kind, number) == (8, 10, 3):
                parts = struct.unpack_from(">6i", note, offset)
                return [a / b for a, b in zip(parts[::2], parts[1::2], strict=True)]
    except (struct.error, ZeroDivisionError):
        pass
    return None


def _gimbal_gravity(xmp: object) -> Down | None:
    """Return gravity from the pitch of a DJI drone's gimbal in the XMP; None if it rolls."""
    if not isinstance(xmp, bytes | str):
        return None
    text = xmp if isinstance(xmp, str) else xmp.decode(errors="replace")
    found = {}
    for name in ("Pitch", "Roll"):
        match = re.search(rf"drone-dji:Gimbal{name}Degree(?:=.|>)([+-]?\d+(\.\d+)?)", text)
        found[name] = _number(match.group(1)) if match else None
    pitch, roll = found["Pitch"], found["Roll"]
    if pitch is None or abs(pitch) > 90 or abs(roll or 0.0) > MAX_ROLL:
        return None
    return 0.0, math.cos(math.radians(pitch)), -math.sin(math.radians(pitch))


def _focal(detail: dict, width: int, height: int) -> float | None:
    """Return the focal length over the longer side; None if unknown or implausible."""
    longer = max(width, height)
    equivalent = _number(detail.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if equivalent:
        return _plausible(equivalent / FULL_FRAME * math.hypot(width, height) / longer)
    focal = _number(detail.get(ExifTags.Base.FocalLength))
    resolution = _number(detail.get(ExifTags.Base.FocalPlaneXResolution))
    unit = _UNITS.get(detail.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    if focal and resolution and unit:
        return _plausible(focal * resolution / unit / longer)
    return None


def _plausible(focal: float) -> float | None:
    """Return the value if it lies between a fisheye's (0.2) and a long tele lens' (20)."""
    return focal if 0.2 < focal < 20 else None


def _gps(tags: dict) -> tuple[float, float, float] | None:
    latitude = _degrees(tags.get(ExifTags.GPS.GPSLatitude), tags.get(ExifTags.GPS.GPSLatitudeRef))
    longitude = _degrees(
        tags.get(ExifTags.GPS.GPSLongitude), tags.get(ExifTags.GPS.GPSLongitudeRef)
    )
    if latitude is None or longitude is None or (latitude == 0 and longitude == 0):
        return None
    altitude = _number(tags.get(ExifTags.GPS.GPSAltitude))
    if altitude is not None and tags.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01"):
        altitude = -altitude
    return latitude, longitude, math.nan if altitude is None else altitude


def _degrees(parts: object, reference: object) -> float | None:
    """Convert degrees, minutes and seconds with N, S, E or W to signed degrees."""
    if not isinstance(parts, tuple | list) or len(parts) != 3:
        return None
    numbers = [_number(part) for part in parts]
    if any(number is None for number in numbers):
        return None
    d, m, s = (float(number or 0) for number in numbers)
    value = d + m / 60 + s / 3600
    return -value if str(reference).strip("\0 ").upper() in ("S", "W") else value


def _number(value: object) -> float | None:
    """Return a finite number; None for anything else, such as a ratio 0/0."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None
