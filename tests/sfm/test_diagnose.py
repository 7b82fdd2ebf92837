"""Diagnosis of pictures without pose, on databases like COLMAP's."""

import sqlite3
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from climatenerf.sfm.diagnose import diagnose, is_pure_rotation, verified_matches
from climatenerf.sfm.exif import Exif
from climatenerf.sfm.photo_import import PhotoImport, Picture
from climatenerf.sfm.reconstruct import _names, group_sizes

PAIR = 2147483647


def picture(name, sharp=100.0, bright=0.5):
    return Picture(f"{name}.jpg", f"{name}.HEIC", 640, 480, Exif(), sharp, bright)


def database(path, pairs):
    """Write a database in COLMAP's layout: numbered images, and pairs by their two numbers."""
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


def test_each_cause_is_diagnosed(tmp_path):
    pairs = {
        ("a", "b"): 500, ("soft", "a"): 12, ("dark", "a"): 3, ("lone", "b"): 9,
        ("far1", "far2"): 200, ("odd", "a"): 90, ("plain", "b"): 4,
    }  # fmt: skip
    path = database(tmp_path / "d.db", pairs)
    assert verified_matches(path)["a.jpg", "b.jpg"] == 500
    pictures = (
        picture("a"), picture("b"), picture("soft", sharp=5), picture("dark", bright=0.03),
        picture("lone"), picture("far1"), picture("far2"), picture("odd"),
        picture("plain", sharp=20),
    )  # fmt: skip
    unposed = diagnose(PhotoImport(tmp_path, pictures, {}, False), ("a.jpg", "b.jpg"), path)
    reasons = {one.name.removesuffix(".jpg"): one for one in unposed}
    assert set(reasons) == {"soft", "dark", "lone", "far1", "far2", "odd", "plain"}
    # Sharp, but of a subject with less detail: not blurred.
    assert "few matches" in reasons["plain"].reason and "20%" in reasons["plain"].reason
    assert "blurred" not in reasons["plain"].reason
    assert "blurred (5%" in reasons["soft"].reason and "steady" in reasons["soft"].remedy
    assert "dark" in reasons["dark"].reason and "exposure" in reasons["dark"].remedy
    assert "too little overlap" in reasons["lone"].reason and "b.HEIC" in reasons["lone"].reason
    assert "not connected" in reasons["far1"].reason and "far2.HEIC" in reasons["far1"].reason
    assert "ambiguous" in reasons["odd"].reason
    assert reasons["far2"].neighbours == (("far1.jpg", 200),)
    assert reasons["soft"].source == "soft.HEIC"


@pytest.mark.parametrize("name", ["a#b", "what?", "50%20off"])
def test_folder_names_with_url_characters(tmp_path, monkeypatch, name):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / name).mkdir()
    path = database(tmp_path / name / "d.db", {("a", "b"): 500})
    assert verified_matches(path) == {("a.jpg", "b.jpg"): 500}
    assert sorted(_names(path)) == ["a.jpg", "b.jpg"]
    imported = homography_database(tmp_path / name / "flat.db", plane_maps(0.0))
    assert is_pure_rotation(*imported)
    assert not list((tmp_path / "here").iterdir())


def homography_database(path, maps, general=0):
    """Write pairs with a homography each, and `general` pairs without; return them and the file."""
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
        connection.execute(
            "CREATE TABLE two_view_geometries"
            " (pair_id INTEGER, rows INTEGER, config INTEGER, H BLOB)"
        )
        for i in range(len(maps) + general + 1):
            connection.execute("INSERT INTO images VALUES (?, ?)", (i + 1, f"{i}.jpg"))
        for i, h in enumerate(maps):
            row = (PAIR + i + 2, 90, 6, np.ascontiguousarray(h).tobytes())
            connection.execute("INSERT INTO two_view_geometries VALUES (?, ?, ?, ?)", row)
        for i in range(len(maps), len(maps) + general):
            row = (PAIR + i + 2, 90, 3, np.zeros((3, 3)).tobytes())
            connection.execute("INSERT INTO two_view_geometries VALUES (?, ?, ?, ?)", row)
    pictures = tuple(picture(str(i)) for i in range(len(maps) + general + 1))
    pictures = tuple(replace(p, name=f"{i}.jpg") for i, p in enumerate(pictures))
    return PhotoImport(path.parent, pictures, {}, False), path


def plane_maps(step, count=8, focal=1.3):
    """Homographies between views of a plane 5 m away, from positions `step` metres apart."""
    rng = np.random.default_rng(0)
    k = np.array([[focal * 640, 0, 320], [0, focal * 640, 240], [0, 0, 1.0]])
    maps = []
    for _ in range(count):
        rotation = Rotation.from_rotvec(rng.normal(0, 0.15, 3)).as_matrix()
        direction = rng.normal(size=3)
        shift = np.outer(step * direction / np.linalg.norm(direction), [0, 0.3, 0.95]) / 5.0
        maps.append(3.7 * k @ (rotation + shift) @ np.linalg.inv(k))
    return maps


def test_pure_rotation_is_distinguished_from_motion_along_a_wall(tmp_path):
    assert is_pure_rotation(*homography_database(tmp_path / "a.db", plane_maps(0.0)))
    assert is_pure_rotation(*homography_database(tmp_path / "b.db", plane_maps(0.02)))
    assert not is_pure_rotation(*homography_database(tmp_path / "c.db", plane_maps(0.5)))
    assert not is_pure_rotation(*homography_database(tmp_path / "d.db", plane_maps(0.0), general=4))
    assert not is_pure_rotation(*homography_database(tmp_path / "e.db", []))


def test_groups_exclude_pictures_of_larger_models():
    assert group_sizes([set("abc"), set("abcdefg"), set("defgx"), set("uvwa")]) == [7, 3]
    assert group_sizes([set("abcd")]) == [4]
