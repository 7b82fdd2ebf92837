"""EXIF of phones and drones: focal length, GPS, gravity; damaged and implausible values."""

import math

import pytest
from PIL import Image
from support.photo_builders import exif, photo

from climatenerf.sfm.exif import read_exif


def test_metadata_of_a_phone(tmp_path):
    data = exif(focal=4.25, equivalent=26, gps=(-33.8568, 151.2153, 12.5))
    photo(tmp_path / "a.jpg", (400, 300), data)
    found = read_exif(Image.open(tmp_path / "a.jpg"))
    assert found.camera == "Maker Model 5 4.25mm"
    # 26 mm on a frame of 43.27 mm across; the picture is 500 pixels across, 400 wide.
    assert found.focal == pytest.approx(26 / 43.2666 * 500 / 400, rel=1e-4)
    assert found.gps == pytest.approx((-33.8568, 151.2153, 12.5), abs=1e-6)


def test_missing_and_implausible_values_are_unknown(tmp_path):
    photo(tmp_path / "plain.jpg")
    found = read_exif(Image.open(tmp_path / "plain.jpg"))
    assert (found.camera, found.focal, found.gps) == ("", None, None)
    photo(tmp_path / "odd.jpg", data=exif(equivalent=0, gps=(0.0, 0.0, 0.0)))
    found = read_exif(Image.open(tmp_path / "odd.jpg"))
    assert found.focal is None and found.gps is None
    photo(tmp_path / "far.jpg", data=exif(equivalent=60000))
    assert read_exif(Image.open(tmp_path / "far.jpg")).focal is None


def test_missing_altitude_is_nan(tmp_path):
    data = exif(gps=(10.0, 20.0, 1.0))
    from PIL import ExifTags

    del data.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSAltitude]
    photo(tmp_path / "a.jpg", data=data)
    gps = read_exif(Image.open(tmp_path / "a.jpg")).gps
    assert gps is not None and gps[:2] == pytest.approx((10, 20)) and math.isnan(gps[2])


# Vectors written by phones in known positions; see docs/physics.md.
@pytest.mark.parametrize(
    ("vector", "size", "orientation", "shown"),
    [
        ((-0.9878, -0.0050, 0.0294), (400, 300), 1, (0.005, 1.0, -0.03)),  # on its left side
        ((0.0799, -0.8649, -0.4764), (400, 300), 6, (0.08, 0.87, 0.48)),  # upright, looking down
        ((0.0799, -0.8649, -0.4764), (300, 400), 1, (0.08, 0.87, 0.48)),  # stored upright
        ((0.99, 0.0, -0.1), (400, 300), 3, (0.0, 1.0, 0.1)),  # on its right side
        ((0.0, 0.99, -0.1), (400, 300), 8, (0.0, 1.0, 0.1)),  # upside down
    ],
)
def test_gravity_of_a_phone(tmp_path, vector, size, orientation, shown):
    photo(tmp_path / "a.jpg", size, exif(orientation, gravity=vector))
    found = read_exif(Image.open(tmp_path / "a.jpg"))
    assert found.orientation == orientation
    assert found.down_as_shown == pytest.approx(shown, abs=0.02)
    assert math.hypot(*found.down) == pytest.approx(1)


@pytest.mark.parametrize(
    "data",
    [
        exif(3, gravity=(-0.99, 0.0, 0.0)),  # gravity would point up
        exif(1, gravity=(-0.6, 0.0, 0.0)),  # shaken
        exif(1, gravity=(-0.99, 0.0, 0.0), lens="iPhone front camera 2.87mm f/2.2"),
        exif(2, gravity=(-0.99, 0.0, 0.0)),  # mirrored
        exif(1),
    ],
)
def test_unreliable_gravity_is_unknown(tmp_path, data):
    photo(tmp_path / "a.jpg", (400, 300), data)
    assert read_exif(Image.open(tmp_path / "a.jpg")).down_as_shown is None


def test_damaged_maker_notes_are_ignored(tmp_path):
    whole = exif(1, gravity=(-0.99, 0.0, 0.0))
    note = whole.get_ifd(0x8769)[0x927C]
    for damaged in (note[:20], note[:50], note[:16] + b"\xff" * 40, note.replace(b"MM", b"XX")):
        whole.get_ifd(0x8769)[0x927C] = damaged
        photo(tmp_path / "a.jpg", (400, 300), whole)
        assert read_exif(Image.open(tmp_path / "a.jpg")).down is None


def test_gravity_of_a_drone_gimbal(tmp_path):
    xmp = '<rdf:Description drone-dji:GimbalRollDegree="{}" drone-dji:GimbalPitchDegree="{}"/>'
    for roll, pitch, down in (
        ("+0.00", "-90.00", (0, 0, 1)),
        ("+0.00", "-30.00", (0, math.cos(math.radians(30)), 0.5)),
        ("+25.00", "-30.00", None),
    ):
        photo(tmp_path / "a.jpg", xmp=xmp.format(roll, pitch).encode())
        found = read_exif(Image.open(tmp_path / "a.jpg")).down_as_shown
        assert found == (None if down is None else pytest.approx(down, abs=1e-6))
