from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.textured_scene import CAMERA, depth_of, hits, textured_scene

from climatenerf.scene.checks.labels import label_findings
from climatenerf.scene.checks.sidecars import (
    depth_findings,
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
        (lambda depth: depth * 1.5, []),  # worse metres of a network
        (lambda depth: depth * 3.281, ["depth-unit"]),
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


def test_masks_and_labels_are_compared_with_points_that_no_file_records(scene, tmp_path):
    unrecorded = replace(scene, views=tuple(replace(view, seen=None) for view in scene.views))

    def constant(value):
        return lambda view: (
            np.where(np.arange(240)[:, None] < 20, value, 255 - value).astype(np.uint8)
            * np.ones((1, 320), np.uint8)
        )

    given = with_files(unrecorded, tmp_path, "mask_path", constant(255), ".png")
    assert codes(mask_findings(given)) == ["mask-inverted"]
    given = with_files(unrecorded, tmp_path, "mask_path", constant(0), ".png")
    assert mask_findings(given) == []
    sky = with_files(
        unrecorded, tmp_path, "label_path", lambda _: np.full((240, 320), 10, np.uint8), ".png"
    )
    assert codes(label_findings(sky)) == ["labels-disagree"]


def test_masks_that_show_an_object_alone_are_not_inverted(scene, tmp_path):
    """The points are dense on the object, which takes a small part of the photo."""
    views, rows = list(scene.views), np.arange(len(scene.points))
    for i, view in enumerate(views):
        views[i] = replace(view, seen=rows[i * 120 : i * 120 + 120])
    dense = replace(scene, views=tuple(views))

    def around_some_points(view):
        local = (dense.points[view.seen] - view.c2w[:3, 3]) @ view.c2w[:3, :3]
        mask = np.zeros((240, 320), np.uint8)
        for x, y in CAMERA.project(local).astype(int)[:20]:
            mask[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] = 255
        return mask

    given = with_files(dense, tmp_path, "mask_path", around_some_points, ".png")
    assert mask_findings(given) == []


CLASSES = {"sky": 10, "wall": 2, "ground": 0}


def labelled(scene, folder, numbers, change=lambda labels, view: labels):
    """The yard with labels: sky above the walls' upper part, walls, ground."""

    def labels(view):
        directions = CAMERA.directions().astype(float) @ view.c2w[:3, :3].T
        length, _, _ = hits(view.c2w[:3, 3], directions)
        z = view.c2w[2, 3] + length * directions[..., 2]
        name = np.where(z < 0.01, numbers["ground"], numbers["wall"])
        return change(np.where(z > 4.5, numbers["sky"], name).astype(np.uint8), view)

    low = scene.points[:, 2] < 4.4  # the sky has no points
    if scene.views[0].seen is None:
        scene = replace(scene, points=scene.points[low])
    else:
        views = [replace(v, seen=v.seen[low[v.seen]]) for v in scene.views]
        scene = replace(scene, views=tuple(views))
    return with_files(scene, folder, "label_path", labels, ".png")


def test_right_labels_are_not_odd(scene, tmp_path):
    assert label_findings(labelled(scene, tmp_path, CLASSES)) == []


def test_labels_that_are_wrong_in_every_second_photo_are_found(tmp_path):
    """Walls and ground are exchanged there; a point is both."""
    scene = textured_scene(tmp_path / "photos", 24, seen=False)
    assert label_findings(labelled(scene, tmp_path, CLASSES)) == []
    wrong = {view.name for view in scene.views[::2]}

    def exchanged(labels, view):
        numbers = np.arange(256, dtype=np.uint8)
        numbers[[CLASSES["wall"], CLASSES["ground"]]] = CLASSES["ground"], CLASSES["wall"]
        return numbers[labels] if view.name in wrong else labels

    (finding,) = label_findings(labelled(scene, tmp_path, CLASSES, exchanged))
    assert finding.code == "labels-disagree"
    of_one_class = labelled(scene, tmp_path, CLASSES, lambda labels, view: 0 * labels)
    assert label_findings(of_one_class) == []
    assert "differ from photo to photo" in finding.message


def test_labels_upside_down_are_found(scene, tmp_path):
    given = labelled(scene, tmp_path, CLASSES, lambda labels, view: labels[::-1])
    (finding,) = label_findings(given)
    assert finding.code == "labels-disagree" and "sky below the ground" in finding.message


def test_labels_of_seven_classes_are_found(scene, tmp_path):
    (finding,) = label_findings(labelled(scene, tmp_path, {"sky": 4, "wall": 1, "ground": 0}))
    assert finding.code == "labels-disagree" and "seven" in finding.message


def test_labels_without_a_class_are_found(scene, tmp_path):
    given = labelled(scene, tmp_path, CLASSES, lambda labels, view: np.full_like(labels, 255))
    assert codes(label_findings(given)) == ["labels-empty"]


def test_labels_of_other_photos_are_found(tmp_path):
    """Classes that depend on the place: the third part of the walls and of the ground."""
    yard = textured_scene(tmp_path / "photos", 60, seen=False)
    # Unequal steps: a shift of equal ones on a round would only turn the world.
    steps = np.random.default_rng(0).integers(1, 4, 40).cumsum()
    yard = replace(yard, views=tuple(yard.views[i] for i in steps[steps < 60][:24]))

    def by_place(scene, shift):
        poses = [view.c2w for view in scene.views]
        number = {view.name: i for i, view in enumerate(scene.views)}

        def labels(view):
            pose = poses[(number[view.name] + shift) % len(poses)]
            directions = CAMERA.directions().astype(float) @ pose[:3, :3].T
            length, _, _ = hits(pose[:3, 3], directions)
            at = pose[:3, 3] + length[..., None] * directions
            return (((at[..., 0] // 3 + at[..., 1] // 3) % 3) * 4).astype(np.uint8)

        folder = tmp_path / str(shift)
        folder.mkdir()
        return label_findings(with_files(scene, folder, "label_path", labels, ".png"))

    assert by_place(yard, 0) == []
    (finding,) = by_place(yard, 7)
    assert finding.code == "labels-disagree" and "other photos" in finding.message


@pytest.mark.parametrize(
    ("in_a_metre", "named"),
    [(1000, None), (100, "centimetres"), (256, "KITTI"), (5000, "TUM")],
)
def test_the_unit_of_integer_depths_is_named(scene, tmp_path, in_a_metre, named):
    def integers(view):
        return np.minimum(in_a_metre * depth_of(view.c2w), 65535).astype(np.uint16)

    found = depth_findings(with_files(scene, tmp_path, "depth_path", integers, ".png"))
    units = [str(each) for each in found if each.code == "depth-unit"]
    assert [named in each for each in units] == ([] if named is None else [True])


def test_depths_may_differ_as_much_as_the_scale_is_uncertain(scene, tmp_path):
    given = with_files(scene, tmp_path, "depth_path", lambda view: 2.2 * depth_of(view.c2w))
    assert codes(depth_findings(given)) == ["depth-unit"]
    assert depth_findings(replace(given, scale_error=0.5)) == []
