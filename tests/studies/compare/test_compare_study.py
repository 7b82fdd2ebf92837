"""A whole comparison of the toy scene: what it writes, and that it resumes."""

import json
import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support import toy_scene
from support.compared_frames import make_material

from climatenerf.core.errors import UserError
from climatenerf.paths.camera_path import CameraPath
from climatenerf.scene import load_scene
from climatenerf.scene.images import read_rgb
from climatenerf.studies.compare import cases, study
from climatenerf.studies.compare.folder import FrameFolder
from climatenerf.studies.compare.report import COLUMNS
from climatenerf.studies.compare.store import FrameStore, make_frames, store_of
from climatenerf.weather.description import KeyframedWeather, read_weather
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.weather import Weather

REFERENCE = Path(__file__).parents[3] / "reference" / "street"
SMOG = KeyframedWeather(Weather(smog=Smog(visibility=8.0, light="paper")), {})


def said(*_):
    pass


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return toy_scene.make_scene(tmp_path_factory.mktemp("toy"))


def fitted_of(scene, folder, completed=lambda progress: toy_scene.FIELD):
    folder.mkdir(exist_ok=True)
    return study.Fitted(folder, scene, "a digest", False, completed)


def plan_of(scene, **changes):
    path = cases.short_path("training", scene, 3, (48, 36), 0.5)
    return replace(study.Plan(path, 12.0, {"smog": SMOG}, 0), **changes)


def no_network(*_, **__):
    raise AssertionError("a network connection was opened")


def never(progress):
    raise AssertionError("a finished frame is rendered again")


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    """A finished comparison with a folder of frames and true pictures."""
    folder = tmp_path_factory.mktemp("compared")
    theirs = folder / "theirs"
    for place, count in (("smog", 3), ("truth/smog", 2)):
        (theirs / place).mkdir(parents=True)
        for index in range(count):
            Image.new("RGB", (48, 36), (120, 120, 120)).save(theirs / place / f"{index:04d}.png")
    views = scene.views[:2]
    path = CameraPath(np.stack([v.c2w for v in views]), (toy_scene.CAMERA,) * 2, "test views")
    true = tuple(read_rgb(view.path) for view in views)
    truth = cases.TrueViews(path, {"smog": SMOG}, {"smog": true})
    method = FrameFolder("theirs", theirs)
    plan = plan_of(scene, methods=(method,), truth=truth, licence="CC BY 4.0")
    stale = folder / "out" / "smog" / "depth-fog" / "0009.jpg"
    stale.parent.mkdir(parents=True)
    stale.write_bytes(b"a picture of a longer movie")
    (folder / "out" / study.MARKER).write_text("{}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket.socket, "connect", no_network)
        patch.setattr(socket, "getaddrinfo", no_network)
        data = study.compare(fitted_of(scene, folder / "run"), folder / "out", plan, said, said)
    assert not stale.exists()
    return folder / "out", plan, data


def test_the_index_lists_every_method_and_existing_files(made):
    out, _, data = made
    written = json.loads((out / "compare.json").read_text())
    assert written == data and written["schema_version"] == 1
    assert written["licence"] == "CC BY 4.0" and written["simulated"] is True
    kinds = {each["name"]: each["kind"] for each in written["methods"]}
    assert kinds == {
        "climatenerf": "ours",
        "depth-fog": "stand-in",
        "global-mk": "stand-in",
        "picture-statistics": "stand-in",
        "frame-noise": "stand-in",
        "theirs": "folder",
    }
    assert all(each["licence"] for each in written["methods"])
    pairs = {(item["method"], item["kind"], item["view"]) for item in written["items"]}
    views = ("0000", "0001", "0002")
    assert pairs == {(name, "picture", view) for name in kinds for view in views} | {
        (name, "movie", "path") for name in kinds
    }
    for item in written["items"]:
        assert not item["file"].startswith("/") and (out / item["file"]).stat().st_size > 0
    shown = np.asarray(Image.open(out / "smog/theirs/0001.jpg"))
    assert np.abs(shown.astype(int) - 120).max() <= 2


def test_the_scores_are_those_of_the_frames(made):
    out, _, data = made
    rows = {row["method"]: row for row in data["scores"]}
    assert set(rows) == {each["name"] for each in data["methods"]}
    assert rows["theirs"]["warp_next"] == 0 and rows["theirs"]["edge_ssim"] < 0.8
    assert rows["frame-noise"]["warp_next"] > 1.3 * rows["depth-fog"]["warp_next"]
    assert all(row["warp_far"] is None for row in rows.values())  # three frames
    assert all(row["seconds"] >= 0 for name, row in rows.items())
    ours = [read_rgb(out / f"truth/smog/climatenerf/frames/000{i}.png") for i in range(2)]
    true = made[1].truth.pictures["smog"]
    errors = [np.mean((a / 255 - b / 255) ** 2) for a, b in zip(ours, true, strict=True)]
    assert rows["climatenerf"]["psnr"] == pytest.approx(np.mean(-10 * np.log10(errors)))
    grey = [np.mean((120 / 255 - b / 255) ** 2) for b in true]
    assert rows["theirs"]["psnr"] == pytest.approx(np.mean(-10 * np.log10(grey)))
    assert rows["global-mk"]["psnr"] > rows["theirs"]["psnr"]  # its target is the truth


def test_sheets_strips_and_the_table_are_written(made):
    out, _, data = made
    text = (out / "compare.md").read_text()
    assert "| depth-fog | stand-in |" in text and "| climatenerf | ours |" in text
    assert "- capture: CC BY 4.0" in text and text.count("- depth-fog:") == 1
    heads = {heading for heading, _ in COLUMNS.values()}
    (row,) = [line for line in text.splitlines() if line.startswith("| method")]
    used = {cell.strip() for cell in row.split("|")} & heads
    assert used == {"PSNR on truth, dB", "SSIM on truth", "warp error t+1", "edge SSIM",
                    "flicker, 1/255", "s a frame"}  # fmt: skip
    count = len(data["methods"]) + 1  # and the clean frames
    columns = Image.open(out / "smog/time-columns.png")
    assert columns.height >= count * 36 and "column" in columns.info["simulated"]
    assert Image.open(out / "smog/time-rows.png").width >= 320
    assert Image.open(out / "smog/sheet.jpg").width >= 3 * 48


def test_a_finished_comparison_renders_and_edits_nothing_again(made, scene):
    out, plan, data = made
    frames = {path: path.stat().st_mtime_ns for path in out.rglob("frames/*.png")}
    movies = {path: path.stat().st_mtime_ns for path in out.rglob("movie.mp4")}
    again = study.compare(fitted_of(scene, out.parent / "run", never), out, plan, said, said)
    assert again == data
    assert frames == {path: path.stat().st_mtime_ns for path in out.rglob("frames/*.png")}
    assert movies == {path: path.stat().st_mtime_ns for path in out.rglob("movie.mp4")}


def test_only_a_frame_that_is_missing_or_foreign_is_made_again(made, scene):
    out, plan, data = made
    folder = out / "smog" / "depth-fog" / "frames"
    kept = (folder / "0001.png").read_bytes()
    before = (folder / "0000.png").stat().st_mtime_ns
    Image.new("RGB", (48, 36)).save(folder / "0001.png")
    movie = (out / "smog" / "depth-fog" / "movie.mp4").stat().st_mtime_ns
    study.compare(fitted_of(scene, out.parent / "run", never), out, plan, said, said)
    assert (folder / "0001.png").read_bytes() == kept
    assert (folder / "0000.png").stat().st_mtime_ns == before
    assert (out / "smog" / "depth-fog" / "movie.mp4").stat().st_mtime_ns > movie


def test_folders_with_other_files_and_equal_names_are_refused(made, scene, tmp_path):
    _, plan, _ = made
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    fitted = fitted_of(scene, tmp_path / "run", never)
    with pytest.raises(UserError, match="holds files that no comparison made"):
        study.compare(fitted, mine, plan, said, said)
    assert [path.name for path in mine.iterdir()] == ["notes.txt"]
    for name in ("theirs", "depth-fog", "climatenerf"):
        twice = replace(plan, methods=(*plan.methods, FrameFolder(name, tmp_path)))
        with pytest.raises(UserError, match=f"two methods are named {name}"):
            study.compare(fitted, tmp_path / "new", twice, said, said)
    assert not (tmp_path / "new").exists()


class Counting:
    """A method that counts its frames and may fail in the middle."""

    name, kind, licence = "counting", "model", "none"

    def __init__(self, fails_at=None):
        self.fails_at, self.edited = fails_at, []

    def shows(self, material):
        return True

    def identity(self, material):
        return "one"

    def pictures(self, material, indices, work):
        for index in indices:
            if index == self.fails_at:
                raise UserError("stopped; go on")
            self.edited.append(index)
            yield np.full_like(material.clean.picture(index), index)


def test_a_method_that_stops_goes_on_where_it_was(tmp_path):
    material = make_material(tmp_path, "flood", frames=4)
    method = Counting(fails_at=2)
    store = store_of(method, material, tmp_path / "frames-of-it")
    with pytest.raises(UserError, match="go on"):
        make_frames(method, material, store, said)
    assert store.missing() == [2, 3]
    further = Counting()
    fractions = []
    make_frames(further, material, store, fractions.append)
    assert further.edited == [2, 3] and fractions == [0.5, 0.75, 1.0]
    assert store.missing() == []
    make_frames(Counting(fails_at=0), material, store, said)  # nothing is left to edit
    assert [store.picture(i)[0, 0, 0] for i in range(4)] == [0, 1, 2, 3]
    record = json.loads((store.folder / "frames.json").read_text())
    assert len(record["seconds"]) == 4 and store.mean_seconds() >= 0
    assert np.isnan(FrameStore(store.folder, "another key", 4).mean_seconds())
    other = FrameStore(store.folder, "another key", 2)
    assert other.missing() == [0, 1] and np.isnan(other.mean_seconds())
    other.remove_surplus()
    assert sorted(p.name for p in (store.folder / "frames").iterdir()) == ["0000.png", "0001.png"]


def test_a_movie_is_written_again_when_a_frame_or_the_rate_has_changed(tmp_path):
    material = make_material(tmp_path, "flood", frames=2)
    store = store_of(Counting(), material, tmp_path / "frames-of-it")
    make_frames(Counting(), material, store, said)

    def written():
        store.write_movie(material.size, 12.0)
        return (store.folder / "movie.mp4").stat().st_mtime_ns

    first = written()
    assert written() == first
    store.save(1, material.clean.picture(1), 0.1)
    second = written()
    assert second > first and written() == second
    store.write_movie(material.size, 6.0)
    assert written() > second
    (store.folder / "movie.mp4").unlink()
    assert written() > second


def test_times_are_shared_by_what_is_made_at_once(tmp_path):
    store = FrameStore(tmp_path, "key", 3)
    for index, seconds in enumerate((1.0, 2.0, 6.0)):
        store.keep_seconds(index, seconds)
    assert store.mean_seconds() == 3.0
    (tmp_path / "frames.json").write_text('{"key": "key", "seconds": [1, "x", null]}')
    assert np.isnan(store.mean_seconds())


def test_frames_depend_on_what_they_were_made_from(tmp_path):
    material = make_material(tmp_path, "smog", frames=1)
    keys = {store_of(Counting(), each, tmp_path).key for each in (
        material,
        replace(material, seed=1),
        replace(material, true=(material.clean.picture(0),)),
        replace(material, ours=replace(material.ours, job=replace(material.ours.job, fps=3.0))),
        replace(material, clean=replace(material.clean, job=replace(material.clean.job, run="b"))),
    )}  # fmt: skip
    assert len(keys) == 5


def test_the_short_path_is_the_middle_of_the_whole(scene):
    part = cases.short_path("training", scene, 10, (48, 36), 0.25)
    whole = cases.camera_path("training", scene, 40, (48, 36))
    np.testing.assert_array_equal(part.c2w, whole.c2w[15:25])
    every = cases.short_path("training", scene, 10, None, 1.0)
    assert len(every) == 10 and every.size == (48, 36)
    for frames, portion in ((10, 0.0), (10, 1.5), (0, 0.5)):
        with pytest.raises(UserError, match="--portion"):
            cases.short_path("training", scene, frames, None, portion)


def test_weather_files_belong_to_an_effect(tmp_path):
    file = tmp_path / "deep.toml"
    file.write_text('[flood]\nlevel = "2 m"\n')
    found = cases.weathers_of([f"flood={file}"], ("smog", "flood"), 5)
    assert found["flood"].base.flood.level == 2.0 and found["smog"].base.smog.visibility == 80
    assert found["smog"].base.seed == 5
    for text, message in (
        ("flood", "must be EFFECT=FILE"),
        (f"snow={file}", "must be EFFECT=FILE"),
        (f"smog={file}", "has no smog"),
    ):
        with pytest.raises(UserError, match=message):
            cases.weathers_of([text], ("smog", "flood"), 0)
    with pytest.raises(UserError, match="there is no effect 'rain'"):
        cases.check_effects(("rain",))
    with pytest.raises(UserError, match="names no effect"):
        cases.check_effects(())
    assert cases.check_effects(("snow", "smog")) == ("smog", "snow")


def test_the_licence_of_the_capture_is_one_line_of_its_file(scene, tmp_path):
    assert cases.licence_of(scene) is None
    other = replace(scene, root=tmp_path)
    (tmp_path / "LICENSE.md").write_text("# a place\n\nBy me. **Licence: CC BY 4.0**\nmore\n")
    assert cases.licence_of(other) == "By me. Licence: CC BY 4.0"
    (tmp_path / "LICENSE.md").write_text("CC0 1.0\n")
    assert cases.licence_of(other) == "CC0 1.0"


def test_true_views_come_from_the_reference_set():
    scene = load_scene(REFERENCE)
    truth = cases.true_views(scene, None, ("smog", "snow"))
    assert len(truth.path) == len(truth.pictures["smog"]) == 6
    true = read_rgb(REFERENCE / "weather" / "snow-deep" / "t01.png")
    np.testing.assert_array_equal(truth.pictures["snow"][0], true)
    assert truth.weathers["smog"] == read_weather(REFERENCE / "weather" / "smog-mid.toml")
    view = {view.name: view for view in scene.views}["t01.jpg"]
    np.testing.assert_allclose(truth.path.c2w[0], scene.c2w_world(view))
