"""The four real captures, compared with the up directions and camera heights of their README."""

import numpy as np
import pytest
from support.scene_builders import angle

from climatenerf.scene import load_image, read_scene


@pytest.mark.parametrize(
    ("name", "views", "size", "up", "tolerance", "height"),
    [
        # Bounds of the camera height in input units.
        ("ditch", 48, (800, 450), (0, -0.99, -0.12), 7, (2.2, 4.2)),
        ("stone_sign", 83, (450, 800), (-0.11, -0.94, -0.31), 4, (1.6, 1.85)),
        ("kitti_drive", 54, (1000, 302), (0, 0, 1), 2, (1.55, 1.75)),
    ],
)
def test_colmap_captures(captures, name, views, size, up, tolerance, height):
    scene = read_scene(captures / name)
    assert scene.source == "colmap" and len(scene.views) == views
    assert {(c.width, c.height) for c in scene.cameras} == {size}
    assert [i for i, v in enumerate(scene.views) if v.split == "heldout"] == [*range(0, views, 8)]
    assert all(v.label_path is not None for v in scene.views)
    assert angle(scene.world_from_input[2, :3], np.array(up)) < tolerance
    assert height[0] < 1.6 / scene.scale < height[1]
    # A view in the middle shows a good part of the sparse points.
    view, points = scene.views[views // 2], scene.points
    assert points is not None
    w2c = np.linalg.inv(view.c2w)
    pixels = scene.cameras[view.camera].project(points @ w2c[:3, :3].T + w2c[:3, 3])
    inside = ((pixels > 0) & (pixels < size)).all(axis=-1)
    assert inside.mean() > 0.2
    assert load_image(view, scene, 2).shape == (size[1] // 2, size[0] // 2, 3)


def test_lowest_ground_of_ditch_is_its_bottom(captures):
    scene = read_scene(captures / "ditch")
    assert scene.lowest_ground_z < -1.5
    points = scene.points_world()
    assert points is not None and -5 < np.percentile(points[:, 2], 2) - scene.lowest_ground_z < 1


def test_metric_input_of_kitti_drive(captures):
    scene = read_scene(captures / "kitti_drive", metric_input=True)
    np.testing.assert_array_equal(scene.world_from_input, np.eye(4))
    z = np.median([scene.c2w_world(v)[2, 3] for v in scene.views])
    assert z - scene.ground_z == pytest.approx(1.65, abs=0.06)
    assert max(v for k, v in scene.up_report.items() if k != "used") < 3


def test_fox_capture(captures):
    scene = read_scene(captures / "fox")
    assert scene.source == "transforms" and len(scene.views) == 50
    assert any(w.startswith("17 of the 67") for w in scene.warnings)
    camera = scene.cameras[0]
    assert (camera.width, camera.height, camera.k1) == (270, 480, 0.0578421)
    assert len(scene.of_split("heldout")) == 7 and scene.views[0].name == "0001.jpg"
    assert angle(scene.world_from_input[2, :3], np.array([0, 0, 1.0])) < 12
    assert all(scene.c2w_world(v)[2, 3] > 0 for v in scene.views)
