import sqlite3

from climatenerf.sfm.diagnose import diagnose, verified_matches
from climatenerf.sfm.exif import Exif
from climatenerf.sfm.intake import Intake, Picture

PAIR = 2147483647


def picture(name, sharp=100.0, bright=0.5):
    return Picture(f"{name}.jpg", f"{name}.HEIC", 640, 480, Exif(), sharp, bright)


def database(path, pairs):
    """As COLMAP lays its database out: images are numbered, pairs by their two numbers."""
    names = sorted({name for pair in pairs for name in pair})
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
        connection.execute("CREATE TABLE two_view_geometries (pair_id INTEGER, rows INTEGER)")
        for number, name in enumerate(names, 1):
            connection.execute("INSERT INTO images VALUES (?, ?)", (number, f"{name}.jpg"))
        for (a, b), rows in pairs.items():
            first, second = sorted((names.index(a) + 1, names.index(b) + 1))
            row = (first * PAIR + second, rows)
            connection.execute("INSERT INTO two_view_geometries VALUES (?, ?)", row)
    return path


def test_each_reason(tmp_path):
    pairs = {
        ("a", "b"): 500, ("soft", "a"): 12, ("dark", "a"): 3, ("lone", "b"): 9,
        ("far1", "far2"): 200, ("odd", "a"): 90,
    }  # fmt: skip
    path = database(tmp_path / "d.db", pairs)
    assert verified_matches(path)["a.jpg", "b.jpg"] == 500
    pictures = (
        picture("a"), picture("b"), picture("soft", sharp=10), picture("dark", bright=0.03),
        picture("lone"), picture("far1"), picture("far2"), picture("odd"),
    )  # fmt: skip
    lost = diagnose(Intake(tmp_path, pictures, {}, False), ("a.jpg", "b.jpg"), path)
    reasons = {one.name.removesuffix(".jpg"): one for one in lost}
    assert set(reasons) == {"soft", "dark", "lone", "far1", "far2", "odd"}
    assert "blurred (10%" in reasons["soft"].reason and "still" in reasons["soft"].remedy
    assert "dark" in reasons["dark"].reason and "exposure" in reasons["dark"].remedy
    assert "too little in common" in reasons["lone"].reason and "b.jpg" in reasons["lone"].reason
    assert "cut off" in reasons["far1"].reason and "far2.jpg" in reasons["far1"].reason
    assert "ambiguous" in reasons["odd"].reason
    assert reasons["far2"].neighbours == (("far1.jpg", 200),)
    assert reasons["soft"].source == "soft.HEIC"
