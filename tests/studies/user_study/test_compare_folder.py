"""Reading of what `climatenerf compare` writes: types, names, and files inside the folder alone."""

import json
import os

import pytest
from support.compare_folders import METHODS, write_compare_folder

from climatenerf.core.errors import UserError
from climatenerf.studies.user_study.compare_folder import read_compare_folder


@pytest.fixture
def folder(tmp_path):
    return write_compare_folder(tmp_path / "compare", effects=("flood",), views=1)


def edited(folder, change):
    file = folder / "compare.json"
    table = json.loads(file.read_text())
    change(table)
    file.write_text(json.dumps(table))
    return folder


def test_a_folder_is_read(folder):
    found = read_compare_folder(folder)
    assert found.scene == "ditch" and found.ours == "climatenerf"
    assert found.licence == "photos of ditch, CC0"
    assert tuple(method.name for method in found.methods) == METHODS
    assert [item.method for item in found.items] == list(METHODS)
    assert all(item.path.is_file() and item.view == "0" for item in found.items)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda t: t.update(schema_version=2), "upgrade"),
        (lambda t: t.pop("schema_version"), "no schema version"),
        (lambda t: t.update(scene=""), "scene in"),
        (lambda t: t.update(scene="a\nb"), "scene in"),
        (lambda t: t.update(scene="x" * 201), "scene in"),
        (lambda t: t.update(licence=5), "licence in"),
        (lambda t: t.update(methods={}), "methods in"),
        (lambda t: t["methods"].append(None), "method 5 in"),
        (lambda t: t["methods"][1].update(kind="best"), "kind in method 1"),
        (lambda t: t["methods"][1].update(kind="ours"), "2 methods of kind ours"),
        (lambda t: t["methods"][0].update(kind="model"), "0 methods of kind ours"),
        (lambda t: t["methods"][1].update(name="ARF-9"), "repeat 'ARF-9'"),
        (lambda t: t["items"][0].update(method="other"), "which methods does not list"),
        (lambda t: t["items"][0].update(kind="movie"), "is no movie"),
        (lambda t: t["items"][0].update(view=3), "view in item 0"),
        (lambda t: t["items"].append(t["items"][2]), "repeat"),
        (lambda t: t.update(items=t["items"][:1] * 10_001), "more than 10000"),
        (lambda t: t["items"][0].update(file="flood/none.jpg"), "is missing or no file"),
        (lambda t: t["items"][0].update(file="flood"), "is missing or no file"),
        (lambda t: t["items"][0].update(file="compare.json"), "is no picture"),
        (lambda t: t["items"][0].update(file="../compare/flood/m0/0.jpg"), "inside the folder"),
        (lambda t: t["items"][0].update(file="/etc/passwd.jpg"), "inside the folder"),
        (lambda t: t["items"][0].update(file="flood\\m0\\0.jpg"), "inside the folder"),
        (lambda t: t["items"][0].update(file="a\0.jpg"), "inside the folder"),
        (lambda t: t["items"][0].update(file="n" * 300 + ".jpg"), "item 0"),
        (lambda t: t["items"][0].update(file="\ud800.jpg"), "is missing or no file"),
        (lambda t: t["items"][0].update(file=""), "inside the folder"),
    ],
)
def test_a_damaged_description_is_refused(folder, change, expected):
    with pytest.raises(UserError) as error:
        read_compare_folder(edited(folder, change))
    assert expected in str(error.value) and len(str(error.value)) < 1000


def test_links_and_pipes(folder, tmp_path):
    picture = folder / "flood/m0/0.jpg"
    moved = folder / "moved.jpg"
    picture.rename(moved)
    picture.symlink_to(moved)
    assert read_compare_folder(folder).items[0].path == picture, "a link inside the folder"
    outside = tmp_path / "outside.jpg"
    moved.rename(outside)
    picture.unlink()
    picture.symlink_to(outside)
    with pytest.raises(UserError, match="is a link out of the folder"):
        read_compare_folder(folder)
    picture.unlink()
    picture.symlink_to(picture)
    with pytest.raises(UserError, match="item 0"):
        read_compare_folder(folder)
    picture.unlink()
    os.mkfifo(picture)
    with pytest.raises(UserError, match="is a pipe"):
        read_compare_folder(folder)


def test_what_is_no_comparison(tmp_path):
    with pytest.raises(UserError, match="is no folder; give the folder that"):
        read_compare_folder(tmp_path / "absent")
    with pytest.raises(UserError, match=r"has no compare\.json"):
        read_compare_folder(tmp_path)
