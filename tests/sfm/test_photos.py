"""Search for the user's photos below a folder."""

import pytest
from support.photo_builders import photo

from climatenerf.core.errors import UserError
from climatenerf.sfm.photos import find_photos
from climatenerf.sfm.scene_folder import OLD_RECORD, RECORD


def names(found):
    return [path.relative_to(found.folder).as_posix() for path in found.files]


@pytest.fixture
def folder(tmp_path):
    for i in range(3):
        photo(tmp_path / "in" / f"{i}.jpg")
    return tmp_path / "in"


@pytest.mark.parametrize("mark", ["scene.json", RECORD, f"work/{OLD_RECORD}"])
def test_pictures_of_scene_folders_are_skipped(folder, mark):
    scene = folder / "more" / "scene"
    photo(scene / "images" / "a.jpg")
    photo(scene / "work" / "pictures" / "a.jpg")
    (scene / mark).write_text("{}")
    found = find_photos(folder, [])
    assert names(found) == ["0.jpg", "1.jpg", "2.jpg"]
    assert found.notes == ("Scene folders among the photos are skipped: more/scene.",)
    assert find_photos(folder, [scene]).notes == (), "no note about an excluded scene"


def test_photos_of_a_scene_folder_are_its_images(folder):
    for i in range(3):
        photo(folder / "images" / f"{i}.jpg")
        photo(folder / "work" / "pictures" / f"{i}.jpg")
    (folder / "scene.json").write_text("{}")
    found = find_photos(folder, [])
    assert found.folder == folder / "images" and names(found) == ["0.jpg", "1.jpg", "2.jpg"]
    assert len(found.notes) == 1 and "is a scene folder" in found.notes[0]


def test_sidecar_folders_beside_images_are_skipped(tmp_path):
    for kind in ("images", "labels", "masks", "depth"):
        for i in range(3):
            photo(tmp_path / "in" / kind / f"{i}.png")
    found = find_photos(tmp_path / "in", [])
    assert names(found) == ["images/0.png", "images/1.png", "images/2.png"]
    assert f"--labels {tmp_path / 'in' / 'labels'}" in found.notes[0]
    assert "--masks" in found.notes[0] and "--depth" in found.notes[0]
    given = [tmp_path / "in" / kind for kind in ("labels", "masks", "depth")]
    assert find_photos(tmp_path / "in", given).notes == ()


def test_excluded_folders_are_skipped(folder):
    photo(folder / "classes" / "0.png")
    assert len(find_photos(folder, [folder / "classes"]).files) == 3
    assert len(find_photos(folder, []).files) == 4


def test_circular_links_are_visited_once(folder, tmp_path):
    (folder / "loop").symlink_to(".")
    (folder / "sub").mkdir()
    (folder / "sub" / "up").symlink_to("..")
    for i in range(2):
        photo(tmp_path / "elsewhere" / f"{i}.jpg")
    (folder / "a").symlink_to(tmp_path / "elsewhere")
    (folder / "b").symlink_to(tmp_path / "elsewhere")
    assert names(find_photos(folder, [])) == ["0.jpg", "1.jpg", "2.jpg", "a/0.jpg", "a/1.jpg"]


def test_too_few_photos_name_a_remedy(tmp_path):
    (tmp_path / "in").mkdir()
    with pytest.raises(UserError, match="contains no photos .*; give the folder with photos"):
        find_photos(tmp_path / "in", [])
    (tmp_path / "in" / "walk.mp4").write_bytes(b"x")
    with pytest.raises(UserError, match="give the video itself, such as .*walk.mp4"):
        find_photos(tmp_path / "in", [])
    photo(tmp_path / "in" / "a.jpg")
    with pytest.raises(UserError, match="1 usable .* take more"):
        find_photos(tmp_path / "in", [])
