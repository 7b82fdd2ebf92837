import os
import unicodedata

import pytest

from climatenerf.scene.file_names import FileNames

COMPOSED, DECOMPOSED = (unicodedata.normalize(f, "Gebäude/é 1.jpg") for f in ("NFC", "NFD"))


def touch(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")


def codes(files):
    return [each.code for each in files.findings()]


def test_exact_names_come_first(tmp_path):
    composed, decomposed = (unicodedata.normalize(form, "ü.jpg") for form in ("NFC", "NFD"))
    touch(tmp_path, composed, decomposed, "A.jpg", "a.jpg")
    files = FileNames(tmp_path)
    for name in (composed, decomposed, "A.jpg", "a.jpg"):
        assert files.find(name) == tmp_path / name
    assert codes(files) == []


@pytest.mark.parametrize(
    ("asked", "stored"),
    [
        (COMPOSED, DECOMPOSED),
        (DECOMPOSED, COMPOSED),
        ("images\\0001.jpg", "images/0001.jpg"),
        ("images/DSC_1.JPG", "images/dsc_1.jpg"),
        ("Screenshot 10.01\u202fAM.png", "Screenshot 10.01 AM.png"),
        ("./a.jpg", "a.jpg"),
        ("/home/someone/place/images/a.jpg", "images/a.jpg"),
        ("C:\\photos\\place\\a.jpg", "a.jpg"),
    ],
)  # fmt: skip
def test_other_spellings_are_found(tmp_path, asked, stored):
    touch(tmp_path, stored, "other.jpg")
    files = FileNames(tmp_path)
    assert files.find(asked) == tmp_path / stored
    exact = asked.replace("\\", "/").removeprefix("./") == stored
    assert codes(files) == ([] if exact else ["name-normalised"])


def test_a_name_that_matches_several_files_is_ambiguous(tmp_path):
    touch(tmp_path, "photo.JPG", "Photo.jpg")
    files = FileNames(tmp_path)
    assert files.find("PHOTO.jpg") is None
    assert codes(files) == ["name-ambiguous"]
    assert "photo.JPG" in str(files.findings()[0])


@pytest.mark.parametrize("name", ["absent.jpg", "x" * 300, "a\0b", "../secret", "", "/etc/passwd2"])
def test_names_without_a_file_are_not_found(tmp_path, name):
    touch(tmp_path / "inner", "a.jpg")
    touch(tmp_path, "secret.jpg")
    assert FileNames(tmp_path / "inner").find(name) is None


def test_cyclic_links_are_not_followed_forever(tmp_path):
    touch(tmp_path, "images/a.jpg")
    (tmp_path / "images" / "loop").symlink_to(tmp_path)
    assert FileNames(tmp_path).find("IMAGES/A.JPG") == tmp_path / "images" / "a.jpg"


def test_what_is_no_file_is_not_found_under_another_spelling(tmp_path):
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "loop.jpg").symlink_to("loop.jpg")
    files = FileNames(tmp_path)
    assert files.find("pipe.jpg") is None and files.find("loop.jpg") is None
    assert codes(files) == []


def test_several_pictures_of_a_name_without_suffix_are_told(tmp_path):
    touch(tmp_path, "a.jpg", "a.png", "b.jpg")
    os.link(tmp_path / "b.jpg", tmp_path / "b.JPG")  # one file, as on disks that ignore case
    files = FileNames(tmp_path)
    files.note_alternatives("a", ["a.png", "a.jpg", "a.heic"])
    files.note_alternatives("b", ["b.jpg", "b.JPG"])
    (finding,) = files.findings()
    assert finding.code == "name-ambiguous" and "'a' matches a.png, a.jpg" in finding.message
