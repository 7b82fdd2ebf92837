"""Files are made once, kept beside the capture, and never in the place of the user's."""

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
    """White sky over noise, as a picture of 32 x 24."""
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


class Told:
    """What the user is told, and which photos are looked at."""

    def __init__(self, stop_after=None):
        self.lines, self.seen, self.stop_after = [], [], stop_after

    def say(self, line):
        self.lines.append(line)

    def track(self, title, views):
        for number, view in enumerate(views):
            if number == self.stop_after:
                raise KeyboardInterrupt
            self.seen.append(view.name)
            yield view


def labelled(capture, model, told=None, spare=None):
    told = told or Told()
    spare = spare or capture.parent / "run"
    return prepare_labels(read_scene(capture), model, spare, told.track, told.say), told


def test_sky_is_found_said_and_kept(capture):
    scene, told = labelled(capture, None)
    assert len(told.seen) == 9 and "--labels MODEL" in told.lines[0]
    assert all(view.label_path is not None for view in scene.views)
    found = load_labels(scene.views[0], scene)
    assert (found[:5] == 10).all() and (found[10:] == 255).all()
    again, told = labelled(capture, None)
    assert told.seen == []
    assert [v.label_path for v in again.views] == [v.label_path for v in scene.views]
    assert not (capture / "labels").exists()  # nobody said that the capture may be written into
    assert labelled(capture, "simple")[0].views[0].label_path == capture / "labels" / "000.png"
    record = json.loads((capture / "labels" / "made_by.json").read_text())
    assert record["schema_version"] == 1 and len(record["files"]) == 9
    assert record["files"]["000.png"]["model"] == "simple"


def test_a_changed_photo_is_looked_at_anew(capture):
    labelled(capture, None)
    photo(99).save(capture / "images" / "004.png")
    assert labelled(capture, None)[1].seen == ["004.png"]


def test_the_user_s_files_stay(capture):
    (capture / "labels").mkdir()
    own = capture / "labels" / "003.png"
    Image.new("L", (32, 24), 2).save(own)
    scene, told = labelled(capture, None)
    assert told.seen == [] and sum(v.label_path is not None for v in scene.views) == 1
    scene, told = labelled(capture, "simple")
    assert len(told.seen) == 8 and "1 files" in told.lines[0]
    assert (np.asarray(Image.open(own)) == 2).all()
    painted = capture / "labels" / "005.png"
    Image.new("L", (32, 24), 7).save(painted)  # over one that was made
    photo(99).save(capture / "images" / "005.png")
    assert labelled(capture, "simple")[1].seen == []
    assert (np.asarray(Image.open(painted)) == 7).all()


def test_stopped_work_goes_on(capture):
    with pytest.raises(KeyboardInterrupt):
        labelled(capture, "simple", Told(stop_after=4))
    assert not list((capture / "labels").glob(".*"))
    assert labelled(capture, None)[1].seen == [
        "004.png",
        "005.png",
        "006.png",
        "007.png",
        "008.png",
    ]


def test_none_and_no_sky(capture):
    labelled(capture, "simple")
    scene, told = labelled(capture, "none")
    assert all(view.label_path is None for view in scene.views) and told.lines == []
    for path in (capture / "labels").iterdir():
        path.unlink()
    for seed, path in enumerate(sorted((capture / "images").iterdir())):
        photo(seed, sky=False).save(path)
    scene, told = labelled(capture, None)
    assert told.seen == [] and "no sky" in told.lines[0]
    assert not list((capture / "labels").iterdir())


def test_a_capture_that_may_not_be_written(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(prepare.os, "access", lambda path, mode: False)
    scene, told = labelled(capture, None)
    assert len(told.seen) == 9 and not (capture / "labels").exists()
    assert scene.views[0].label_path == tmp_path / "run" / "labels" / "000.png"
    assert labelled(capture, None)[1].seen == []
    for model in ("owner/net",):
        with pytest.raises(UserError, match="may not be written.*copy the capture"):
            labelled(capture, model)
        with pytest.raises(UserError, match="may not be written"):
            prepare_depth(read_scene(capture), model, told.track, told.say)


def test_labels_of_two_numberings_do_not_mix(capture):
    (capture / "labels").mkdir()
    Image.new("L", (32, 24), 4).save(capture / "labels" / "003.png")
    told = Told()
    scene = read_scene(capture, label_space="seven")
    assert prepare_labels(scene, None, capture, told.track, told.say) is scene
    with pytest.raises(UserError, match="seven"):
        prepare_labels(scene, "simple", capture, told.track, told.say)


def test_a_damaged_record_is_refused(capture):
    (capture / "labels").mkdir()
    record = capture / "labels" / "made_by.json"
    record.write_text('{"schema_version": 1, "files": [1]}')
    with pytest.raises(UserError, match="damaged"):
        labelled(capture, None)
    record.write_text('{"schema_version": 2, "files": {}}')
    with pytest.raises(UserError, match="newer"):
        labelled(capture, None)


def test_photos_that_differ_by_suffix_alone_have_files_of_their_own(capture):
    for name in ("000.jpg", "001.jpg"):
        (capture / "images" / name).write_bytes(b"")
        photo(50).save(capture / "images" / name)
    names = [*names_of(9), "000.jpg", "001.jpg"]
    write_colmap(capture / "sparse" / "0", ring(11), names)
    scene, _ = labelled(capture, "simple")
    paths = [view.label_path for view in scene.views]
    assert len(set(paths)) == 11 and paths[0] == capture / "labels" / "000.jpg.png"
    assert [view.label_path for view in read_scene(capture).views] == paths


def test_a_network_takes_the_place_of_what_another_made(capture, tmp_path):
    pytest.importorskip("transformers", reason="pip install .[perception]")
    from support import networks

    one = str(networks.save_segformer(tmp_path / "segformer-tiny"))
    two = str(networks.save_segformer(tmp_path / "two", seed=1))
    labelled(capture, "simple")
    scene, told = labelled(capture, one)
    assert len(told.seen) == 9 and "non-commercial" in told.lines[0]
    assert set(np.unique(load_labels(scene.views[0], scene))) <= {0, 10, 8, 11, 18}
    assert labelled(capture, one)[1].lines == [], "the licence is said once"
    assert labelled(capture, None)[1].seen == [], "and stays when nothing is said"
    scene, told = labelled(capture, two)
    assert len(told.seen) == 9 and "not known" in told.lines[0]
    entry = json.loads((capture / "labels" / "made_by.json").read_text())["files"]["000.png"]
    assert entry["model"] == two and entry["revision"] is None and "not known" in entry["licence"]


def test_depth_is_made_and_read(capture, tmp_path):
    pytest.importorskip("transformers", reason="pip install .[perception]")
    from support import networks

    model = str(networks.save_depth_anything(tmp_path / "depth-anything-v2-small"))
    told = Told()
    scene = read_scene(capture)
    paths = prepare_depth(scene, model, told.track, told.say)
    assert len(told.seen) == 9 and told.lines == [f"Licence of {model}: Apache-2.0"]
    assert paths["000.png"] == capture / "depth_relative" / "000.npz"
    with np.load(paths["000.png"]) as data:
        assert data["inverse_depth"].shape == (24, 32)
    read = load_relative_depth(scene.views[0], scene)
    assert read is not None and read.shape == (24, 32) and np.isfinite(read).all()
    prepare_depth(scene, model, told.track, told.say)
    assert len(told.seen) == 9
