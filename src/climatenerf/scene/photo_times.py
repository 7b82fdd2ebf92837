"""When photos were taken, where they tell it: a clock's time without its zone does not."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

from PIL import ExifTags, Image

from climatenerf.scene.images import read_exif_of


def time_taken(path: Path) -> datetime | None:
    """Return the time of exposure, UTC; None if the photo does not tell it with its zone.

    GPS time is UTC. Without it EXIF's `DateTimeOriginal` counts if `OffsetTimeOriginal` is there.
    """
    exif = read_exif_of(path)
    if exif is None:
        return None
    return _gps_time(exif) or _clock_time(exif)


def _gps_time(exif: Image.Exif) -> datetime | None:
    tags = exif.get_ifd(ExifTags.IFD.GPSInfo)
    day, clock = tags.get(ExifTags.GPS.GPSDateStamp), tags.get(ExifTags.GPS.GPSTimeStamp)
    try:
        hours, minutes, seconds = (float(part) for part in clock or ())
        date = datetime.strptime(_text(day), "%Y:%m:%d").replace(tzinfo=UTC)
        passed = timedelta(hours=hours, minutes=minutes, seconds=seconds)
        return date + passed if timedelta(0) <= passed < timedelta(days=1) else None
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):  # a tag is missing or broken
        return None


def _clock_time(exif: Image.Exif) -> datetime | None:
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    words = tags.get(ExifTags.Base.DateTimeOriginal), tags.get(ExifTags.Base.OffsetTimeOriginal)
    try:
        clock = datetime.strptime(" ".join(map(_text, words)), "%Y:%m:%d %H:%M:%S %z")
        return clock.astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def _text(value: object) -> str:
    return str(value).strip("\0 ")
