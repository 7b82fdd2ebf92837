"""Label spaces: `load_labels` returns Cityscapes train ids for each of them."""

import json

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import names_of, ring, write_colmap, write_images

from climatenerf.cli import main
from climatenerf.core.errors import UserError
from climatenerf.scene import load_scene, read_scene, save_scene
from climatenerf.scene.images import load_labels

# From the table of the data set: id -> train id.
TRAIN_FROM_CITYSCAPES = {
    0: 255, 6: 255, 7: 0, 8: 1, 9: 255, 10: 255, 11: 2, 12: 3, 13: 4, 14: 255, 17: 5, 18: 255,
    19: 6, 20: 7, 21: 8, 22: 9, 23: 10, 24: 11, 25: 12, 26: 13, 27: 14, 28: 15, 29: 255, 30: 255,
    31: 16, 32: 17, 33: 18, 34: 2, 35: 4, 36: 255, 37: 5, 38: 255, 41: 255, 44: 255, 255: 255,
}  # fmt: skip
TRAIN_FROM_SEVEN = {0: 0, 1: 2, 2: 8, 3: 9, 4: 10, 5: 11, 6: 13, 255: 255}
TRAIN_FROM_TRAIN = {**{i: i for i in range(19)}, 255: 255}
SPACES = {
    "cityscapes-ids": TRAIN_FROM_CITYSCAPES,
    "seven": TRAIN_FROM_SEVEN,
    "cityscapes-train-ids": TRAIN_FROM_TRAIN,
}


def make(root, ids, points=()):
    write_images(root / "images", names_of(4))
    write_colmap(root / "sparse/0", ring(4), names_of(4), points=points)
    (root / "labels").mkdir()
    values = np.resize(np.array(list(ids), dtype=np.uint8), (24, 32))
    Image.fromarray(values).save(root / "labels/000.png")
    return values


@pytest.mark.parametrize("space", SPACES)
def test_load_labels_converts_to_train_ids(tmp_path, space):
    values = make(tmp_path, SPACES[space])
    scene = read_scene(tmp_path, label_space=space)
    found = load_labels(scene.views[0], scene)
    assert found is not None and found.dtype == np.uint8
    np.testing.assert_array_equal(found, np.vectorize(SPACES[space].get)(values))


def test_label_space_is_saved_with_the_scene(tmp_path):
    values = make(tmp_path, TRAIN_FROM_SEVEN)
    save_scene(read_scene(tmp_path, label_space="seven"), tmp_path / "scene")
    again = read_scene(tmp_path / "scene")
    assert load_scene(tmp_path / "scene").label_space == again.label_space == "seven"
    found = load_labels(again.views[0], again)
    np.testing.assert_array_equal(found, np.vectorize(TRAIN_FROM_SEVEN.get)(values))
    assert read_scene(tmp_path / "scene", metric_input=True).label_space == "seven"
    assert read_scene(tmp_path / "scene", camera_height=2.0).label_space == "seven"
    assert read_scene(tmp_path / "scene", label_space="cityscapes-ids").label_space != "seven"


def test_camera_height_and_label_space_together(tmp_path):
    x, y = np.mgrid[-6:6:40j, -6:6:40j]
    ground = np.stack([x, y, 0.01 * np.sin(9 * x + 7 * y)], axis=-1).reshape(-1, 3)
    make(tmp_path, [7], ground)
    before = read_scene(tmp_path)
    save_scene(before, tmp_path / "scene")
    scene = read_scene(tmp_path / "scene", camera_height=3.2, label_space="cityscapes-ids")
    assert scene.scale_source == "camera-height" and "camera-height-assumed" in scene.scale_report
    assert scene.label_space == "cityscapes-ids"


def test_scene_file_without_label_space_has_train_ids(tmp_path):
    make(tmp_path, TRAIN_FROM_TRAIN)
    path = save_scene(read_scene(tmp_path), tmp_path / "scene")
    data = json.loads(path.read_text())
    assert data.pop("label_space") == "cityscapes-train-ids"
    path.write_text(json.dumps(data))
    assert load_scene(tmp_path / "scene").label_space == "cityscapes-train-ids"
    path.write_text(json.dumps({**data, "label_space": "coco"}))
    with pytest.raises(UserError, match=r'label_space in .*scene\.json is "coco"; choose one of'):
        load_scene(tmp_path / "scene")


@pytest.mark.parametrize(
    ("space", "bad"), [("cityscapes-train-ids", 26), ("seven", 7), ("cityscapes-ids", 45)]
)
def test_undefined_ids_raise(tmp_path, space, bad):
    make(tmp_path, [0, 1, bad])
    scene = read_scene(tmp_path, label_space=space)
    with pytest.raises(UserError, match=rf"000\.png contain the id {bad}, which {space} does not"):
        load_labels(scene.views[0], scene)


def test_command_line_rejects_unknown_label_space_and_stray_frames(tmp_path, capsys):
    make(tmp_path, [0])
    command = ["fit", str(tmp_path), "-o", str(tmp_path / "run")]
    assert main([*command, "--label-space", "coco"]) == 2
    assert '--label-space is "coco"; choose one of' in " ".join(capsys.readouterr().err.split())
    assert main([*command, "--frames", "3:9"]) == 2
    assert "frames of a KITTI-360 drive" in " ".join(capsys.readouterr().err.split())
