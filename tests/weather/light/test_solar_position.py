"""The sun's place by date, time and place, and the photos that tell them."""

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from PIL import ExifTags, Image

from climatenerf.cli.render import say_light
from climatenerf.scene.photo_times import time_taken
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.light.solar_position import almanac_sun, solar_position, sun_over


def degrees(latitude, longitude, time):
    return np.degrees(solar_position(latitude, longitude, time))


def test_example_of_nrel_spa():
    """Reda and Andreas 2004, table A5.1, without refraction: zenith 50.128, azimuth 194.340."""
    time = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    elevation, azimuth = degrees(39.742476, -105.1786, time)
    assert elevation == pytest.approx(39.872, abs=0.01)
    assert azimuth == pytest.approx(194.340, abs=0.01)


def test_highest_sun_of_the_solstices():
    for day, declination in ((datetime(2026, 6, 21), 23.44), (datetime(2026, 12, 21), -23.44)):
        times = [day.replace(tzinfo=UTC) + timedelta(minutes=k) for k in range(0, 1440, 2)]
        highest = max(degrees(52.0, 13.0, time)[0] for time in times)
        assert highest == pytest.approx(90 - 52 + declination, abs=0.02)


def test_the_sun_moves_from_east_over_south_to_west():
    day = datetime(2026, 3, 20, tzinfo=UTC)
    azimuths = [degrees(45.0, 0.0, day + timedelta(hours=hour))[1] for hour in (7, 12, 17)]
    assert 90 < azimuths[0] < 120 and 170 < azimuths[1] < 190 and 240 < azimuths[2] < 270


def test_a_capture_of_a_whole_day_has_no_one_sun():
    noon = datetime(2026, 6, 21, 11, tzinfo=UTC)
    short = [noon + timedelta(minutes=k) for k in (-10, 0, 10)]
    assert sun_over(52.0, 13.0, short)[2] > 0.8
    assert sun_over(52.0, 13.0, [*short, noon + timedelta(hours=4)]) is None
    assert sun_over(52.0, 13.0, [noon + timedelta(hours=12)]) is None, "night"
    assert sun_over(52.0, 13.0, []) is None


def photo(path, gps=None, clock=None, zone=None):
    image = Image.new("RGB", (8, 8))
    exif = image.getexif()
    if gps is not None:
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(
            {ExifTags.GPS.GPSDateStamp: gps[0], ExifTags.GPS.GPSTimeStamp: gps[1]}
        )
    if clock is not None:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] = clock
    if zone is not None:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.OffsetTimeOriginal] = zone
    image.save(path, exif=exif)
    return path


def test_times_of_photos(tmp_path):
    expected = datetime(2026, 6, 21, 10, 30, 15, tzinfo=UTC)
    gps = ("2026:06:21", (10.0, 30.0, 15.0))
    assert time_taken(photo(tmp_path / "gps.jpg", gps=gps)) == expected
    zoned = photo(tmp_path / "zone.jpg", clock="2026:06:21 12:30:15", zone="+02:00")
    assert time_taken(zoned) == expected
    wrong = ("2026:06:21", (99.0, 0.0, 0.0))
    assert time_taken(photo(tmp_path / "both.jpg", wrong, "2026:06:21 10:30:15", "Z")) == expected


def test_no_time_is_guessed(tmp_path):
    """A clock without its zone tells no time; nor do broken tags, or a file that is no photo."""
    assert time_taken(photo(tmp_path / "a.jpg", clock="2026:06:21 12:30:15")) is None
    assert time_taken(photo(tmp_path / "b.jpg", clock="yesterday", zone="+02:00")) is None
    assert time_taken(photo(tmp_path / "c.jpg", gps=("2026:99:21", (1.0, 2.0, 3.0)))) is None
    (tmp_path / "d.jpg").write_bytes(b"no photo")
    assert time_taken(tmp_path / "d.jpg") is None


def test_the_sun_of_a_capture(tmp_path):
    noon = ("2026:06:21", (11.0, 10.0, 0.0))
    names = ["a.jpg", "b.jpg", "c.jpg"]
    paths = [photo(tmp_path / name, gps=noon if name != "c.jpg" else None) for name in names]
    views = tuple(View(name, path, 0, np.eye(4)) for name, path in zip(names, paths, strict=True))
    place = {"latitude": 52.0, "longitude": 13.0}
    sun = almanac_sun(Scene(tmp_path, "test", (), views, georeference=place))
    assert sun is not None and sun[2] == pytest.approx(np.sin(np.radians(61.4)), abs=0.005)
    assert sun[1] < -0.4 and abs(sun[0]) < 0.1, "it stands in the south"
    assert almanac_sun(Scene(tmp_path, "test", (), views)) is None, "no place"


def test_the_difference_is_printed(capsys):
    facts = {"elevation": 40.0, "azimuth": 218.0, "error": 1.0, "from_almanac": 2.34, "width": 0.0}
    sidecar = {f"photos_sun_{name}_deg": value for name, value in facts.items()}
    say_light(sidecar)
    printed = " ".join("".join(capsys.readouterr()).split())
    assert printed.startswith("sun of the photos") and "shadows" not in printed
    assert "40 deg high at azimuth 218 deg (+-1 deg); 2.3 deg from the sun of their date" in printed
    say_light(sidecar | {"photos_sun_width_deg": 20.0, "weather": {"sky": {"kind": "overcast"}}})
    printed = " ".join("".join(capsys.readouterr()).split())
    assert (
        "no sun was found by shadows" in printed and "brightest part of the photos' sky" in printed
    )
    say_light({"photos_light_known": 0.0})
    assert "do not tell their light" in "".join(capsys.readouterr())
