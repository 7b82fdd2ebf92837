"""Files of operating systems and hidden files beside a capture's own change nothing."""

import shutil

import pytest
from support.photo_builders import photo
from support.scene_builders import names_of, ring, write_colmap, write_images

from climatenerf.core.errors import UserError
from climatenerf.scene import read_scene
from climatenerf.scene.readers.tanks_temples import is_tanks_temples, read_tanks_temples
from climatenerf.sfm.photos import photos_in

NOISE = ("._{}", ".DS_Store", "Thumbs.db", "desktop.ini")


def add_noise(folder, like):
    for pattern in NOISE:
        (folder / pattern.format(like)).write_bytes(b"\0\5\x16\7 not an image")


def test_photos(tmp_path):
    for i in range(3):
        photo(tmp_path / f"{i}.jpg")
    add_noise(tmp_path, "0.jpg")
    photo(tmp_path / "__MACOSX" / "0.jpg")
    photo(tmp_path / "@eaDir" / "0.jpg" / "SYNOPHOTO_THUMB_M.jpg")
    found = photos_in(tmp_path, [])
    assert [path.name for path in found.files] == ["0.jpg", "1.jpg", "2.jpg"]


def test_colmap_with_sidecars(tmp_path):
    names, poses = names_of(8), ring(8)
    write_images(tmp_path / "images", names)
    write_colmap(tmp_path / "sparse" / "0", poses, names)
    clean = read_scene(tmp_path)
    shutil.copytree(tmp_path / "sparse" / "0", tmp_path / "sparse" / "__MACOSX")
    for folder in ("images", "sparse", "sparse/0", "labels", "masks", "depth"):
        (tmp_path / folder).mkdir(exist_ok=True)
        add_noise(tmp_path / folder, names[0])
    found = read_scene(tmp_path)
    assert found.warnings == clean.warnings
    assert [view.name for view in found.views] == names


def test_folder_with_noise_alone_has_no_images(tmp_path):
    add_noise(tmp_path, "0.png")
    with pytest.raises(UserError, match="neither images nor poses"):
        read_scene(tmp_path)


def test_tanks_and_temples(tmp_path):
    names = names_of(4)
    write_images(tmp_path / "rgb", names)
    (tmp_path / "pose").mkdir()
    (tmp_path / "pose" / "._000.txt").write_bytes(b"\0\5\x16\7")
    assert not is_tanks_temples(tmp_path)
    row = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    for name in names:
        (tmp_path / "pose" / name.replace("png", "txt")).write_text(row)
    (tmp_path / "intrinsics.txt").write_text("30 0 16 0\n0 30 12 0\n0 0 1 0\n0 0 0 1\n")
    add_noise(tmp_path / "rgb", "000.png")
    add_noise(tmp_path / "pose", "000.txt")
    assert [view.name for view in read_tanks_temples(tmp_path).views] == names
