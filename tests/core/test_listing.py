"""Names that are passed over wherever a folder is listed."""

from pathlib import Path

import pytest

from climatenerf.core.listing import is_passed_over, is_system_file, visible

SYSTEM = ["._a.jpg", ".DS_Store", "Thumbs.db", "desktop.ini", "Desktop.ini", "__MACOSX", "@eaDir"]


@pytest.mark.parametrize("name", SYSTEM)
def test_system_files_are_passed_over(name):
    assert is_system_file(name) and is_passed_over(name)


def test_hidden_files_are_passed_over_but_are_not_system_files():
    assert is_passed_over(".notes") and not is_system_file(".notes")
    assert not is_passed_over("a._b.jpg") and not is_passed_over("thumbs.db.jpg")


def test_parents_of_the_listed_folder_do_not_matter():
    top = Path("/x/.cache/scene")
    paths = [top / "a.png", top / "__MACOSX" / "a.png", top / "b" / "._a.png", top / "b" / "c.png"]
    assert list(visible(paths, top)) == [top / "a.png", top / "b" / "c.png"]
    assert list(visible([top / "__MACOSX" / "a.png"])) == [top / "__MACOSX" / "a.png"]
