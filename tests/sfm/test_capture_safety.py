"""Captures never harm the user's files, and scenes contain the given photos only."""

import contextlib
import json
import os
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.command_line import STREET, run_cli
from support.photo_builders import exif, photo
from support.processes import holder

from climatenerf.scene import load_scene, read_scene
from climatenerf.scene.export import export_colmap
from climatenerf.sfm.photo_import import import_photos
from climatenerf.sfm.reconstruct import read_result
from climatenerf.sfm.scene_folder import OLD_RECORD, RECORD


def snapshot(folder):
    """Content of every file below a folder; of links the target."""
    return {
        path.relative_to(folder).as_posix(): os.readlink(path)
        if path.is_symlink()
        else path.read_bytes()
        for path in folder.rglob("*")
        if path.is_symlink() or path.is_file()
    }


@pytest.fixture
def posed(tmp_path):
    """Six photos, and a COLMAP model of them in another folder."""
    truth = read_scene(STREET, holdout="0")
    export_colmap(truth, tmp_path / "model")
    lines = (tmp_path / "model" / "sparse" / "0" / "images.txt").read_text().splitlines()
    (tmp_path / "model" / "sparse" / "0" / "images.txt").write_text("\n".join(lines[:13]) + "\n")
    (tmp_path / "photos").mkdir()
    for view in truth.views[:6]:
        shutil.copy(view.path, tmp_path / "photos" / view.name)
    return tmp_path


def capture(here, out, *more):
    return run_cli(
        "capture", here / "photos", "--from-colmap", here / "model", "-o", out, *more
    )  # fmt: skip


def test_a_second_capture_into_a_folder_is_refused_in_one_sentence(posed, capsys):
    for out in (posed / "new", posed / "scene"):
        if out.name == "scene":
            assert capture(posed, out) == 0
            capsys.readouterr()
        with holder(out):
            before = snapshot(out)
            assert capture(posed, out) == 2
            err = capsys.readouterr().err
            assert f"another process is writing into {out}; wait until it ends" in err
            assert len(err.strip().splitlines()) == 1 and snapshot(out) == before
    assert capture(posed, posed / "scene") == 0, "the lock of a dead process does not count"
    assert not list((posed / "scene").glob(".*.tmp.*")), "nor does its half of a file stay"


@pytest.mark.parametrize("name", ["images", "sparse", "labels", "scene.json", "work", "mark.html"])
def test_capture_refuses_folders_of_other_origin(posed, capsys, name):
    out = posed / "mine"
    if "." in name:
        photo(out / "other.jpg")
        (out / name).write_text("mine")
    else:
        photo(out / name / "logo.png")
    before = snapshot(out)
    assert capture(posed, out) == 2
    assert "already contains" in capsys.readouterr().err and snapshot(out) == before


def test_linked_photos_are_never_deleted(posed, capsys):
    out = posed / "mine"
    out.mkdir()
    (out / "images").symlink_to(posed / "photos")
    before = snapshot(posed / "photos")
    assert capture(posed, out) == 2
    assert snapshot(posed / "photos") == before
    # In place of capture's own folder the link is removed, and its target stays.
    (out / "images").unlink()
    assert capture(posed, out) == 0
    shutil.rmtree(out / "images")
    (out / "images").symlink_to(posed / "photos")
    assert capture(posed, out) == 0
    assert snapshot(posed / "photos") == before and not (out / "images").is_symlink()


@pytest.mark.parametrize("what", ["photos", "labels", "masks", "depth", "from-colmap"])
def test_inputs_inside_the_output_are_refused(posed, capsys, what):
    out = posed / "scene"
    assert capture(posed, out, "--labels", STREET / "labels") == 0
    before = snapshot(out)
    given = {"photos": posed / "photos", "from-colmap": posed / "model"}
    given[what] = out / {"photos": "images", "from-colmap": "sparse"}.get(what, "labels")
    args = [w for k, v in given.items() if k != "photos" for w in (f"--{k}", v)]
    assert run_cli("capture", given["photos"], *args, "-o", out) == 2
    assert "choose another folder" in capsys.readouterr().err and snapshot(out) == before


def test_files_that_the_user_adds_are_kept_and_used(posed, capsys):
    out = posed / "scene"
    assert capture(posed, out, "--labels", STREET / "labels") == 0
    first, second = (view.name for view in load_scene(out).views[:2])
    mine = {
        out / "labels" / "more" / "notes.txt": b"mine",
        (out / "labels" / second).with_suffix(".png"): None,  # replaces capture's file
        (out / "masks" / first).with_suffix(".png"): None,
        out / "depth" / f"{first}.npy": b"mine",
        out / "readme.txt": b"mine",
        out / "marks.toml": b"",
    }
    for path, content in mine.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if content is None:
            Image.new("L", (384, 216), 10).save(path)
        else:
            path.write_bytes(content)
    kept = {path: path.read_bytes() for path in mine}
    for args in ((), ("--camera-height", "1.7 m"), ()):
        assert capture(posed, out, *args) == 0
        assert {path: path.read_bytes() for path in mine} == kept
        assert f"Files of yours stay in {out / 'masks'}: 1 (masks/" in capsys.readouterr().err
    used = {view.name: view for view in read_scene(out).views}
    assert used[first].mask_path is not None
    assert used[second].label_path is not None
    assert used[first].label_path is None, "capture's own file is removed"


@pytest.mark.parametrize(
    ("name", "args", "message"),
    [
        ("images/extra.jpg", (), "was not written by capture"),
        ("images/0000.jpg", (), "has changed since"),
        ("sparse/1/notes.txt", (), "was not written by capture"),
        ("report.md", (), "has changed since"),
        ("labels", (), "was not written by capture"),
        ("labels/mine.png", ("--labels", STREET / "labels"), "is your file"),
    ],
)
def test_files_that_would_be_lost_are_named_before_any_work(posed, capsys, name, args, message):
    out = posed / "scene"
    assert capture(posed, out) == 0
    name = name.replace("0000.jpg", load_scene(out).views[0].name)
    (out / name).parent.mkdir(exist_ok=True)
    (out / name).write_bytes(b"mine")
    before = snapshot(out)
    capsys.readouterr()
    assert capture(posed, out, *args) == 2
    err = capsys.readouterr().err
    assert message in err and str(out / name) in err and len(err.strip().splitlines()) == 1
    assert snapshot(out) == before


def test_files_added_during_a_capture_are_not_lost(posed, capsys, monkeypatch):
    from climatenerf.sfm import pipeline

    out = posed / "scene"
    assert capture(posed, out) == 0
    before = {k: v for k, v in snapshot(out).items() if not k.startswith("work/")}
    real = pipeline.write_report

    def meanwhile(*arguments):
        (out / "images" / "late.jpg").write_bytes(b"mine")
        return real(*arguments)

    monkeypatch.setattr(pipeline, "write_report", meanwhile)
    assert capture(posed, out) == 2
    assert "late.jpg was not written by capture" in capsys.readouterr().err
    after = {k: v for k, v in snapshot(out).items() if not k.startswith("work/")}
    assert after == {**before, "images/late.jpg": b"mine"}


def test_record_of_earlier_versions_is_read(posed, capsys):
    out = posed / "scene"
    assert capture(posed, out, "--labels", STREET / "labels") == 0
    (out / RECORD).unlink()
    (out / "work" / OLD_RECORD).write_text('{"places": ["images"]}')
    mine = out / "labels" / "mine.png"
    Image.new("L", (384, 216), 10).save(mine)
    assert capture(posed, out) == 0
    assert [path.name for path in (out / "labels").iterdir()] == ["mine.png"]
    (out / RECORD).unlink()
    (out / "images" / "extra.jpg").write_bytes(b"mine")
    assert capture(posed, out) == 2
    assert "extra.jpg was not written by capture" in capsys.readouterr().err


def test_capture_works_after_deleting_work_or_copying_the_scene(posed):
    out = posed / "scene"
    assert capture(posed, out) == 0
    shutil.rmtree(out / "work")
    assert capture(posed, out) == 0
    assert json.loads((out / "scene.json").read_text())["root_absolute"] == str(out)
    shutil.copytree(out, posed / "copy", copy_function=shutil.copyfile)  # new modification times
    assert capture(posed, posed / "copy") == 0


def test_interrupted_installation_can_be_repeated(posed, monkeypatch):
    from climatenerf.sfm import scene_folder

    out = posed / "scene"
    assert capture(posed, out) == 0
    real, moved = os.replace, []

    def interrupted_replace(source, target):
        if Path(source).parent.name == "new":
            moved.append(source)
            if len(moved) == 3:
                raise KeyboardInterrupt
        real(source, target)

    monkeypatch.setattr(scene_folder.os, "replace", interrupted_replace)
    assert capture(posed, out, "--camera-height", "1.7 m") == 130
    monkeypatch.undo()
    assert capture(posed, out) == 0 and len(load_scene(out).views) == 6


def marks_file(path, picture="0001.jpg", pixel=(10, 20)):
    """Marks of a length D in two pictures."""
    lines = [f'[D.{end}]\n"{picture}" = {list(pixel)}\n"0002.jpg" = [1, 2]\n' for end in
             ("from", "to")]  # fmt: skip
    path.write_text("".join(lines))
    return path


@pytest.mark.parametrize(("picture", "pixel"), [("nowhere.jpg", (1, 2)), (None, (5000, 2))])
def test_unusable_marks_leave_a_finished_scene_unchanged(posed, capsys, picture, pixel):
    out = posed / "scene"
    assert capture(posed, out, "--camera-height", "1.7 m") == 0
    name = picture or load_scene(out).views[0].name
    marks = marks_file(posed / "marks.toml", name, pixel)
    before = {k: v for k, v in snapshot(out).items() if not k.startswith("work/")}
    assert capture(posed, out, "--known-length", "D=2 m", "--marks", marks) == 2
    err = capsys.readouterr().err
    assert "is unchanged" in err and "poses are kept" not in err
    assert {k: v for k, v in snapshot(out).items() if not k.startswith("work/")} == before


@pytest.mark.parametrize(
    ("text", "message"),
    [("DOOR", "a name and a length"), ("DOOR=2", "no unit"), ("DOOR=-2 m", "above 0"),
     ("DOOR=2 kg", "a length"), ("", "a name and a length"), ("=2 m", "needs a name"),
     ("DOOR=2 m", "run this once without --known-length")],
)  # fmt: skip
def test_known_lengths_are_checked_first(posed, capsys, text, message):
    assert run_cli("capture", posed / "absent", "-o", posed / "scene", "--known-length", text) == 2
    err = capsys.readouterr().err
    assert message in err and len(err.strip().splitlines()) == 1
    assert not (posed / "scene").exists()


def test_assumed_scale_names_the_flags_of_capture(posed, capsys):
    assert capture(posed, posed / "scene") == 0
    err = capsys.readouterr().err
    assert "give --camera-height or --known-length" in err and "--metric-input" not in err


def test_unusable_gps_gives_a_warning(posed, capsys):
    for path in (posed / "photos").iterdir():
        data = exif(gps=(47.3769, 8.5417, 400.0))
        Image.open(path).convert("RGB").save(path, format="JPEG", quality=95, exif=data)
    assert capture(posed, posed / "scene") == 0
    warning = "GPS of 6 photos is of no use here"
    assert warning in capsys.readouterr().err
    assert warning in (posed / "scene" / "report.md").read_text()


def test_error_names_the_users_photo_not_its_copy(posed, capsys):
    first = sorted((posed / "photos").iterdir())[0]
    Image.new("RGB", (100, 100)).save(first, format="JPEG")
    assert capture(posed, posed / "scene") == 2
    err = capsys.readouterr().err
    assert str(first) in err and "work/new" not in err


@pytest.mark.parametrize("what", ["nothing", "too few", "no model", "no video"])
def test_refused_input_creates_no_folder(posed, capsys, what):
    (posed / "in").mkdir()
    given = [posed / "in"]
    if what == "too few":
        photo(posed / "in" / "a.jpg")
    elif what == "no model":
        (posed / "none").mkdir()
        given = [posed / "photos", "--from-colmap", posed / "none"]
    elif what == "no video":
        given = [posed / "in" / "walk.mp4"]
        given[0].write_bytes(b"no video" * 100)
    assert run_cli("capture", *given, "-o", posed / "out") == 2
    err = capsys.readouterr().err
    assert "Traceback" not in err and not (posed / "out").exists()


def test_output_that_is_a_broken_link_is_refused(posed, capsys):
    (posed / "out").symlink_to("absent")
    assert capture(posed, posed / "out") == 2
    assert "is a link to absent, which does not exist" in capsys.readouterr().err


def test_failed_run_leaves_the_scene_unchanged(posed, tmp_path, capsys):
    out = posed / "scene"
    assert capture(posed, out, "--labels", STREET / "labels") == 0
    before = {k: v for k, v in snapshot(out).items() if not k.startswith("work/")}
    bad = tmp_path / "bad"
    bad.mkdir()
    (bad / "0001.png").write_text("no picture")
    marks = tmp_path / "marks.toml"
    marks.write_text('[D.from]\n"x.jpg" = [1, 2]\n"y.jpg" = [1, 2]\n[D.to]\n"x.jpg" = [1, 2]\n'
                     '"y.jpg" = [1, 2]\n')  # fmt: skip
    for args in (
        ("--camera-height", "0 m"),
        ("--labels", bad),
        ("--known-length", "DOOR 2.0"),
        ("--known-length", "DOOR=2 m", "--marks", marks),
        ("--known-length", "D=2 m", "--known-length", "D=3 m", "--marks", marks),
        ("--marks", marks),
        ("--known-length", "DOOR=2 m"),
        ("--seed", "-1"),
        ("--features", "3"),
    ):
        assert capture(posed, out, *args) == 2, args
        output = capsys.readouterr().err
        assert "Traceback" not in output
        assert {k: v for k, v in snapshot(out).items() if not k.startswith("work/")} == before


def test_unmeasurable_length_keeps_the_poses(posed, tmp_path, capsys):
    marks = tmp_path / "marks.toml"
    marks.write_text('[D.from]\n"x.jpg" = [1, 2]\n"y.jpg" = [1, 2]\n[D.to]\n"x.jpg" = [1, 2]\n'
                     '"y.jpg" = [1, 2]\n')  # fmt: skip
    out = posed / "scene"
    assert capture(posed, out, "--known-length", "D=2 m", "--marks", marks) == 2
    output = capsys.readouterr().err
    assert "poses are kept" in output and "x.jpg" in output
    assert len(load_scene(out).views) == 6 and (out / "mark.html").is_file()


def test_transforms_in_the_output_are_not_read(posed):
    out = posed / "scene"
    assert capture(posed, out) == 0
    given = load_scene(out)
    assert run_cli("export", out, "-o", posed / "exported") == 0
    data = json.loads((posed / "exported" / "transforms.json").read_text())
    for frame in data["frames"]:
        frame["transform_matrix"][0][3] *= 7
    (out / "transforms.json").write_text(json.dumps(data))
    assert capture(posed, out) == 0
    for a, b in zip(load_scene(out).views, given.views, strict=True):
        np.testing.assert_array_equal(a.c2w, b.c2w)


def test_sidecars_of_an_earlier_run_are_removed(posed):
    out = posed / "scene"
    assert capture(posed, out, "--labels", STREET / "labels") == 0
    assert load_scene(out).views[0].label_path is not None
    assert capture(posed, out) == 0
    assert load_scene(out).views[0].label_path is None and not (out / "labels").exists()


@pytest.mark.parametrize("name", ["../photos/0001.jpg", "/etc/0001.jpg"])
def test_picture_names_outside_the_photo_folder_are_refused(posed, capsys, name):
    model = posed / "model" / "sparse" / "0" / "images.txt"
    model.write_text(model.read_text().replace("0001.jpg", name))
    assert capture(posed, posed / "scene") == 2
    assert "outside the folder of photos" in capsys.readouterr().err
    assert not (posed / "scene" / "photos").exists()


def test_scene_among_the_photos_is_skipped(posed, capsys):
    out = posed / "photos" / "scene"
    for _ in range(2):
        assert capture(posed, out) == 0
        assert "6 of 6 pictures" in capsys.readouterr().out
    assert capture(posed, posed / "photos" / "another") == 0
    output = capsys.readouterr()
    assert "6 of 6 pictures" in output.out
    assert "Scene folders among the photos are skipped: scene." in output.err


def test_export_does_not_overwrite_points(posed, capsys):
    assert capture(posed, posed / "scene") == 0
    (posed / "out").mkdir()
    (posed / "out" / "points.ply").write_text("mine")
    assert run_cli("export", posed / "scene", "-o", posed / "out") == 2
    assert "already exists" in capsys.readouterr().err
    assert (posed / "out" / "points.ply").read_text() == "mine"


def test_gravity_of_photos_posed_as_shown(posed):
    """Photos are stored rotated, poses are of pictures as shown: gravity is rotated, too."""
    truth = read_scene(STREET, holdout="0")
    for view in truth.views[:6]:
        pose = truth.c2w_world(view)
        x, y, z = pose[:3, :3].T @ np.array([0, 0, -1.0])
        stored = (y, -x, z)  # before orientation 6: (x, y) = (-y', x')
        data = exif(6, gravity=(-stored[1], -stored[0], -stored[2]), camera=("Apple", "iPhone"))
        rotated = Image.open(view.path).convert("RGB").transpose(Image.Transpose.ROTATE_90)
        rotated.save(posed / "photos" / view.name, quality=95, exif=data)
    assert capture(posed, posed / "scene") == 0
    scene = load_scene(posed / "scene")
    assert scene.up_report["gravity"] < 3 and "gravity" in scene.up_report["used"]
    up = scene.world_from_input[2, :3] / scene.scale
    assert np.degrees(np.arccos(up[2])) < 2


# The tests below run structure from motion.


def street_photos(folder, count=6):
    """Photos of the street whose names have a meaning in lists and URLs."""
    pytest.importorskip("pycolmap")
    folder.mkdir()
    names = ["#1 house.jpg", "50%20 off?.jpg", "Bild\u202f3.jpg", "a\nb.jpg", "|ü|.JPG", "6.jpeg"]
    for path, name in zip(sorted((STREET / "images").iterdir())[:count], names, strict=False):
        shutil.copy(path, folder / name)
    return folder


def sfm(photos, out):
    return run_cli("capture", photos, "-o", out, "--features", "2048")


def test_unusual_names_and_reproducible_runs(tmp_path, capsys, monkeypatch):
    photos = street_photos(tmp_path / "in")
    (photos / "broken.jpg").symlink_to("nowhere")
    (photos / os.fsdecode(b"caf\xe9.jpg")).write_bytes(b"no picture")
    poses, verified = [], []
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    for out in (tmp_path / "a", tmp_path / "b #1?x=%20y"):
        assert sfm(photos, out) == 0
        assert not list(here.iterdir()), "no files in the working directory"
        output = capsys.readouterr()
        assert "broken.jpg is skipped" in output.err and "Traceback" not in output.err
        poses.append({view.name: view.c2w for view in load_scene(out).views})
        with contextlib.closing(sqlite3.connect(out / "work" / "database.db")) as connection:
            query = "SELECT pair_id, rows, data FROM two_view_geometries ORDER BY pair_id"
            verified.append(connection.execute(query).fetchall())
    assert verified[0] == verified[1], "verification is reproducible"
    assert len(poses[0]) >= 5 and poses[0].keys() == poses[1].keys()
    for name in poses[0]:
        np.testing.assert_array_equal(poses[0][name], poses[1][name])


def test_damaged_work_folder_is_repaired(tmp_path, capsys):
    photos, out = street_photos(tmp_path / "in"), tmp_path / "scene"
    assert sfm(photos, out) == 0
    views = len(load_scene(out).views)
    work = out / "work"
    imported = import_photos(photos, work, lambda done, total: None)

    def garble(name):
        return lambda: (work / name).write_bytes(b"\x00garbled")

    shutil.copytree(work, tmp_path / "intact")
    for damage in (
        garble("poses.json"), garble("chosen/images.bin"),
        lambda: (work / "poses.json").write_text('{"groups": 5}'),
        lambda: (work / "database.db").unlink(),
        lambda: shutil.rmtree(work / "chosen"),
    ):  # fmt: skip
        assert read_result(imported, work, 2048, 0) is not None
        damage()
        assert read_result(imported, work, 2048, 0) is None
        shutil.rmtree(work)
        shutil.copytree(tmp_path / "intact", work)
    first, second = sorted((work / "pictures").glob("*.json"))[:2]
    for damages in (
        [garble("poses.json"), garble("database.json")],
        [garble("database.db"), lambda: first.write_text("3"), second.with_suffix(".jpg").unlink],
    ):
        for damage in damages:
            damage()
        assert sfm(photos, out) == 0, capsys.readouterr().err
        assert len(load_scene(out).views) == views


def test_failed_worker_gives_one_error_sentence(tmp_path, capsys):
    photos, out = street_photos(tmp_path / "in"), tmp_path / "scene"
    (out / "work" / "database.db").mkdir(parents=True)
    (out / "work" / "made-by-capture.json").write_text("{}")
    (out / "work" / "database.db" / "x").write_text("x")
    assert sfm(photos, out) in (0, 2)
    output = capsys.readouterr().err
    assert "Traceback" not in output and "memory" not in output
