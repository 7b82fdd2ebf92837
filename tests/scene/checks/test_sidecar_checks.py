from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.textured_scene import CAMERA, depth_of, textured_scene

from climatenerf.scene.checks.sidecars import (
    depth_findings,
    label_findings,
    mask_findings,
    unused_findings,
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return textured_scene(tmp_path_factory.mktemp("yard"))


def codes(findings):
    return [each.code for each in findings]


def with_files(scene, folder, kind, values, suffix=".npy"):
    views = []
    for view in scene.views:
        path = folder / f"{view.name}{suffix}"
        array = values(view)
        np.save(path, array) if suffix == ".npy" else Image.fromarray(array).save(path)
        views.append(replace(view, **{kind: path}))
    return replace(scene, views=tuple(views))


ALONG_RAY = 1 / CAMERA.directions()[..., 2]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda depth: depth, []),
        (lambda depth: depth * 1.1, []),  # a network's metres
        (lambda depth: depth * 1000, ["depth-unit"]),
        (lambda depth: depth / 1000, ["depth-unit"]),
        (lambda depth: depth * ALONG_RAY, ["depth-ray-length"]),
        (lambda depth: 3 / depth, ["depth-inverse"]),
        (lambda depth: depth * (1 + 0.7 * np.sin(np.arange(320) / 9)), ["depth-disagrees"]),
        (lambda depth: np.where(depth > 9, np.nan, depth), []),
        (lambda depth: np.full_like(depth, np.nan), ["depth-empty"]),
    ],
)
def test_depth_files_are_compared_with_the_points(scene, tmp_path, change, expected):
    given = with_files(scene, tmp_path, "depth_path", lambda view: change(depth_of(view.c2w)))
    assert codes(depth_findings(given)) == expected


def test_saturated_depths_are_unknown(scene, tmp_path):
    def millimetres(view):
        depth = 1000 * depth_of(view.c2w)
        return np.where(depth > 9000, 65535, depth).astype(np.uint16)

    given = with_files(scene, tmp_path, "depth_path", millimetres, ".png")
    assert codes(depth_findings(given)) == ["depth-saturated"]


def test_masks_that_hide_all_or_nothing_or_the_wrong_part_are_found(scene, tmp_path):
    def masks(value):
        return lambda view: np.full((240, 320), value, np.uint8)

    given = with_files(scene, tmp_path, "mask_path", masks(0), ".png")
    (finding,) = mask_findings(given)
    assert finding.code == "mask-hides-all" and finding.severity == "error"
    given = with_files(scene, tmp_path, "mask_path", masks(1), ".png")
    assert codes(mask_findings(given)) == ["mask-hides-nothing"]

    def inverted(view):
        mask = np.zeros((240, 320), np.uint8)
        mask[:20] = 255
        return mask

    given = with_files(scene, tmp_path, "mask_path", inverted, ".png")
    assert codes(mask_findings(given)) == ["mask-inverted"]
    given = with_files(scene, tmp_path, "mask_path", lambda view: 255 - inverted(view), ".png")
    assert mask_findings(given) == []


def test_labels_of_another_numbering_are_found(scene, tmp_path):
    def labels(low, high):
        return lambda view: (
            np.where(np.arange(240)[:, None] < 5, low, high) * np.ones((1, 320), int)
        )

    def saved(low, high):
        values = labels(low, high)
        return with_files(
            scene, tmp_path, "label_path", lambda view: values(view).astype(np.uint8), ".png"
        )

    assert label_findings(saved(10, 0)) == []
    assert codes(label_findings(saved(2, 10))) == ["labels-disagree"]
    (finding,) = label_findings(saved(10, 150))
    assert finding.code == "labels-foreign" and finding.severity == "error"
    assert "--label-space" in finding.remedy


def test_photos_without_pose_and_sidecars_of_no_photo_are_noted(tmp_path):
    scene = textured_scene(tmp_path, 4)
    assert unused_findings(scene, scene.views) == []
    assert codes(unused_findings(scene, scene.views[:-1])) == ["photo-without-pose"]
    (tmp_path / "masks").mkdir()
    for name in ("000.png", "other.png"):
        Image.new("L", (8, 8)).save(tmp_path / "masks" / name)
    first = replace(scene.views[0], mask_path=tmp_path / "masks" / "000.png")
    scene = replace(scene, views=(first, *scene.views[1:]))
    assert codes(unused_findings(scene, scene.views)) == ["sidecar-unused"]
