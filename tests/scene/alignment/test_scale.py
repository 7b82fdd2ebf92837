from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import look_at

from climatenerf.scene import Camera, Scene, View, read_scene, save_scene
from climatenerf.scene.alignment.scale import (
    rescale_by_camera_height,
    rescaled,
    scale_findings,
    scale_from_depth_files,
    scale_summary,
    with_scale_evidence,
)

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)


@pytest.fixture
def scene(tmp_path):
    """Nine cameras 1.6 m above a plane of points."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-12, 12, (4000, 2)), np.zeros((4000, 1))], axis=1)
    views = []
    for i in range(9):
        path = tmp_path / f"{i}.png"
        Image.new("RGB", (64, 48)).save(path)
        pose = look_at((i - 4.0, -6.0, 1.6), (i - 4.0, 0.0, 0.0))
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        x, y = CAMERA.project(np.where(local[:, 2:] > 0.1, local, [0, 0, 1.0])).T
        inside = (local[:, 2] > 0.1) & (x > 0) & (y > 0) & (x < 64) & (y < 48)
        views.append(View(path.name, path, 0, pose, seen=np.flatnonzero(inside)))
    return Scene(
        tmp_path, "test", (CAMERA,), tuple(views), points, scale_source="gps", scale_error=0.02,
        lowest_ground_z=-1.0, scale_report={"camera-height-assumed": {"times": 1.2, "error": 0.3}},
    )  # fmt: skip


def test_rescaling_converts_the_scale_report(scene):
    out = rescaled(scene, 2.0, "known-length", 0.01)
    assert out.scale == pytest.approx(2) and out.lowest_ground_z == -2
    assert out.scale_report == {
        "camera-height-assumed": {"times": 0.6, "error": 0.3},
        "gps": {"times": 0.5, "error": 0.02},
    }
    back = rescaled(out, 0.5, "gps", 0.02)
    assert back.scale == pytest.approx(1) and "gps" not in back.scale_report
    assert back.scale_report["known-length"]["times"] == pytest.approx(2)
    summary = scale_summary(out)
    assert "known-length (+-1%)" in summary and "gps: 0.50 times that (+-2%)" in summary


def test_only_significant_differences_give_a_warning(scene):
    assert scale_findings(scene) == []
    warnings = list(map(str, scale_findings(with_scale_evidence(scene, "depth files", 1.3, 0.02))))
    assert warnings == ["The scale from depth files is 1.30 times the one from gps; check both."]


def test_rescaling_by_camera_height_keeps_heading_and_georeference(scene, tmp_path):
    rotation = np.eye(4)
    rotation[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    rotated = replace(scene, world_from_input=rotation, georeference={"latitude": 47.0})
    out = rescale_by_camera_height(rotated, 3.2)
    assert out is not None and out.scale == pytest.approx(2, rel=0.01)
    assert out.scale_source == "camera-height"
    assert out.scale_report["gps"]["times"] == pytest.approx(0.5, rel=0.01)
    np.testing.assert_allclose(
        out.world_from_input[:3, :3] / out.scale, rotation[:3, :3], atol=1e-9
    )
    assert rescale_by_camera_height(replace(scene, points=None), 3.2) is None
    # The same through `read_scene` of a saved scene.
    save_scene(rotated, tmp_path)
    again = read_scene(tmp_path, camera_height=3.2)
    assert again.georeference == {"latitude": 47.0}
    np.testing.assert_allclose(again.world_from_input, out.world_from_input, atol=1e-4)
    assert again.scale_report.keys() == out.scale_report.keys()


def with_depth_files(scene, folder, depth_from_z):
    """The scene with depth files that hold `depth_from_z(z)` at each observed point."""
    views = []
    for view in scene.views:
        local = (scene.points[view.seen] - view.c2w[:3, 3]) @ view.c2w[:3, :3]
        x, y = CAMERA.project(local).T.astype(int)
        depth = np.zeros((48, 64), np.float32)
        depth[y, x] = depth_from_z(local[:, 2])
        np.save(folder / f"{view.name}.npy", depth)
        views.append(replace(view, depth_path=folder / f"{view.name}.npy"))
    return replace(scene, views=tuple(views))


def test_scale_from_metric_depth_files(scene, tmp_path):
    found = scale_from_depth_files(with_depth_files(scene, tmp_path, lambda z: 1.3 * z))
    # 1 %: points that share a pixel have slightly different depths.
    assert found is not None and found[0] == pytest.approx(1.3, rel=0.01) and found[1] < 0.03


def test_relative_depth_files_give_no_scale(scene, tmp_path):
    assert scale_from_depth_files(with_depth_files(scene, tmp_path, lambda z: 8 / z)) is None
    assert scale_from_depth_files(scene) is None
