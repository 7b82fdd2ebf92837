import math

import pytest
from photo_builders import exif, photo
from PIL import Image

from climatenerf.sfm.exif import read_exif


def test_a_phones_photo(tmp_path):
    data = exif(focal=4.25, equivalent=26, place=(-33.8568, 151.2153, 12.5))
    photo(tmp_path / "a.jpg", (400, 300), data)
    found = read_exif(Image.open(tmp_path / "a.jpg"))
    assert found.camera == "Maker Model 5 4.25mm"
    # 26 mm on a frame of 43.27 mm across; the picture is 500 pixels across, 400 wide.
    assert found.focal == pytest.approx(26 / 43.2666 * 500 / 400, rel=1e-4)
    assert found.place == pytest.approx((-33.8568, 151.2153, 12.5), abs=1e-6)


def test_nothing_and_nonsense(tmp_path):
    photo(tmp_path / "plain.jpg")
    found = read_exif(Image.open(tmp_path / "plain.jpg"))
    assert (found.camera, found.focal, found.place) == ("", None, None)
    photo(tmp_path / "odd.jpg", data=exif(equivalent=0, place=(0.0, 0.0, 0.0)))
    found = read_exif(Image.open(tmp_path / "odd.jpg"))
    assert found.focal is None and found.place is None
    photo(tmp_path / "far.jpg", data=exif(equivalent=60000))
    assert read_exif(Image.open(tmp_path / "far.jpg")).focal is None


def test_altitude_that_is_missing_is_nan(tmp_path):
    data = exif(place=(10.0, 20.0, 1.0))
    from PIL import ExifTags

    del data.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSAltitude]
    photo(tmp_path / "a.jpg", data=data)
    place = read_exif(Image.open(tmp_path / "a.jpg")).place
    assert place is not None and place[:2] == pytest.approx((10, 20)) and math.isnan(place[2])
