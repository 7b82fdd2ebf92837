"""Label and depth files are made once, kept in the capture, and never replace the user's."""

import json

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import names_of, ring, write_colmap

from climatenerf.core.errors import UserError
from climatenerf.perception import prepare, prepare_depth, prepare_labels
from climatenerf.scene import read_scene
from climatenerf.scene.images import load_labels, load_relative_depth


def photo(seed, sky=True):
    """White sky over noise, 32 x 24 pixels."""
    values = np.random.default_rng(seed).integers(20, 120, (24, 32, 3), dtype=np.uint8)
    if sky:
        values[:10] = 245
    return Image.fromarray(values)


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    (folder / "images").mkdir(parents=True)
    names = names_of(9)
    for seed, name in enumerate(names):
        photo(seed).save(folder / "images" / name)
    write_colmap(folder / "sparse" / "0", ring(9), names)
    return folder


class Callbacks:
    """Records messages and processed photos; can interrupt the work."""

    def __init__(self, stop_after=None):
        self.lines, self.processed, self.stop_after = [], [], stop_after

    def say(self, line):
        self.lines.append(line)

    def track(self, title, views):
        for number, view in enumerate(views):
            if number == self.stop_after:
                raise KeyboardInterrupt
            self.processed.append(view.name)
            yield view


def labelled(capture, model, callbacks=None):
    callbacks = callbacks or Callbacks()
    scene, run = read_scene(capture), capture.parent / "run"
    return prepare_labels(scene, model, run, callbacks.track, callbacks.say), callbacks


def test_heuristic_labels_are_the_default_and_are_reused(capture):
    scene, callbacks = labelled(capture, None)
    assert len(callbacks.processed) == 9 and "--labels MODEL" in callbacks.lines[0]
    assert all(view.label_path is not None for view in scene.views)
    found = load_labels(scene.views[0], scene)
    assert (found[:5] == 10).all() and (found[10:] == 255).all()
    again, callbacks = labelled(capture, None)
    assert callbacks.processed == []
    assert [v.label_path for v in again.views] == [v.label_path for v in scene.views]
    assert not (capture / "labels").exists()  # by default the capture is left alone
    assert labelled(capture, "heuristic")[0].views[0].label_path == capture / "labels" / "000.png"
    record = json.loads((capture / "labels" / "made_by.json").read_text())
    assert record["schema_version"] == 1 and len(record["files"]) == 9
    assert record["files"]["000.png"]["model"] == "heuristic"


def test_former_name_simple_is_an_alias_of_heuristic(capture):
    """As an argument, and in the records of captures labelled by earlier versions."""
    labelled(capture, "simple")
    path = capture / "labels" / "made_by.json"
    record = json.loads(path.read_text())
    assert {entry["model"] for entry in record["files"].values()} == {"heuristic"}
    for entry in record["files"].values():
        entry["model"] = "simple"
    path.write_text(json.dumps(record))
    assert labelled(capture, "heuristic")[1].processed == []
    assert labelled(capture, None)[1].processed == []


def test_changed_photos_are_processed_again(capture):
    labelled(capture, None)
    photo(99).save(capture / "images" / "004.png")
    assert labelled(capture, None)[1].processed == ["004.png"]


def test_files_of_the_user_are_kept(capture):
    (capture / "labels").mkdir()
    user_file = capture / "labels" / "003.png"
    Image.new("L", (32, 24), 2).save(user_file)
    scene, callbacks = labelled(capture, None)
    assert callbacks.processed == [] and sum(v.label_path is not None for v in scene.views) == 1
    scene, callbacks = labelled(capture, "heuristic")
    assert len(callbacks.processed) == 8 and "Keeping and using 1 files" in callbacks.lines[0]
    assert (np.asarray(Image.open(user_file)) == 2).all()
    painted = capture / "labels" / "005.png"
    Image.new("L", (32, 24), 7).save(painted)  # replaces a generated file
    photo(99).save(capture / "images" / "005.png")
    assert labelled(capture, "heuristic")[1].processed == []
    assert (np.asarray(Image.open(painted)) == 7).all()


def test_interrupted_work_is_resumed(capture):
    with pytest.raises(KeyboardInterrupt):
        labelled(capture, "heuristic", Callbacks(stop_after=4))
    assert not list((capture / "labels").glob(".*"))
    assert labelled(capture, None)[1].processed == [
        "004.png",
        "005.png",
        "006.png",
        "007.png",
        "008.png",
    ]


def test_no_labels_on_request_and_without_sky(capture):
    labelled(capture, "heuristic")
    scene, callbacks = labelled(capture, "none")
    assert all(view.label_path is None for view in scene.views) and callbacks.lines == []
    for path in (capture / "labels").iterdir():
        path.unlink()
    for seed, path in enumerate(sorted((capture / "images").iterdir())):
        photo(seed, sky=False).save(path)
    scene, callbacks = labelled(capture, None)
    assert callbacks.processed == [] and "does not certainly show sky" in callbacks.lines[0]
    assert not list((capture / "labels").iterdir())


def test_read_only_captures(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(prepare.os, "access", lambda path, mode: False)
    scene, callbacks = labelled(capture, None)
    assert len(callbacks.processed) == 9 and not (capture / "labels").exists()
    assert scene.views[0].label_path == tmp_path / "run" / "labels" / "000.png"
    assert labelled(capture, None)[1].processed == []
    with pytest.raises(UserError, match="is read-only.*copy the capture"):
        labelled(capture, "owner/net")
    with pytest.raises(UserError, match="is read-only"):
        prepare_depth(read_scene(capture), "owner/net", callbacks.track, callbacks.say)


def test_label_spaces_are_not_mixed(capture):
    (capture / "labels").mkdir()
    Image.new("L", (32, 24), 4).save(capture / "labels" / "003.png")
    callbacks = Callbacks()
    scene = read_scene(capture, label_space="seven")
    assert prepare_labels(scene, None, capture, callbacks.track, callbacks.say) is scene
    with pytest.raises(UserError, match="seven"):
        prepare_labels(scene, "heuristic", capture, callbacks.track, callbacks.say)


def test_damaged_and_newer_records_are_refused(capture):
    (capture / "labels").mkdir()
    record = capture / "labels" / "made_by.json"
    record.write_text('{"schema_version": 1, "files": [1]}')
    with pytest.raises(UserError, match="damaged"):
        labelled(capture, None)
    record.write_text('{"schema_version": 2, "files": {}}')
    with pytest.raises(UserError, match="newer"):
        labelled(capture, None)


def test_photos_differing_only_in_suffix_have_separate_files(capture):
    for name in ("000.jpg", "001.jpg"):
        (capture / "images" / name).write_bytes(b"")
        photo(50).save(capture / "images" / name)
    names = [*names_of(9), "000.jpg", "001.jpg"]
    write_colmap(capture / "sparse" / "0", ring(11), names)
    scene, _ = labelled(capture, "heuristic")
    paths = [view.label_path for view in scene.views]
    assert len(set(paths)) == 11 and paths[0] == capture / "labels" / "000.jpg.png"
    assert [view.label_path for view in read_scene(capture).views] == paths


def test_generated_files_are_replaced_by_another_network(capture, tmp_path):
    pytest.importorskip("transformers", reason="pip install .[perception]")
    from support import networks

    one = str(networks.save_segformer(tmp_path / "segformer-tiny"))
    two = str(networks.save_segformer(tmp_path / "two", seed=1))
    labelled(capture, "heuristic")
    scene, callbacks = labelled(capture, one)
    assert len(callbacks.processed) == 9 and "non-commercial" in callbacks.lines[0]
    assert set(np.unique(load_labels(scene.views[0], scene))) <= {0, 10, 8, 11, 18}
    assert labelled(capture, one)[1].lines == [], "the licence is reported once"
    assert labelled(capture, None)[1].processed == [], "and its labels are kept by default"
    scene, callbacks = labelled(capture, two)
    assert len(callbacks.processed) == 9 and "unknown" in callbacks.lines[0]
    entry = json.loads((capture / "labels" / "made_by.json").read_text())["files"]["000.png"]
    assert entry["model"] == two and entry["revision"] is None and "unknown" in entry["licence"]


def test_relative_depth_is_made_and_read(capture, tmp_path):
    pytest.importorskip("transformers", reason="pip install .[perception]")
    from support import networks

    model = str(networks.save_depth_anything(tmp_path / "depth-anything-v2-small"))
    callbacks = Callbacks()
    scene = read_scene(capture)
    paths = prepare_depth(scene, model, callbacks.track, callbacks.say)
    assert len(callbacks.processed) == 9 and callbacks.lines == [f"Licence of {model}: Apache-2.0"]
    assert paths["000.png"] == capture / "depth_relative" / "000.npz"
    with np.load(paths["000.png"]) as data:
        assert data["inverse_depth"].shape == (24, 32)
    read = load_relative_depth(scene.views[0], scene)
    assert read is not None and read.shape == (24, 32) and np.isfinite(read).all()
    prepare_depth(scene, model, callbacks.track, callbacks.say)
    assert len(callbacks.processed) == 9
