from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import (
    STREET_CAMERA,
    angle,
    look_at,
    ring,
    street,
    street_scene,
    tilted,
    up_of,
)

from climatenerf.scene import Scene
from climatenerf.scene.alignment.world_frame import align_scene


def test_alignment_recovers_up_scale_and_ground(tmp_path):
    points, posts = street()
    random = np.random.default_rng(5)
    poses = [tilted(p, *random.normal(0, 3, 2)) for p in ring(12)]
    scene, up = street_scene(tmp_path, poses, points, posts, seed=4, scale=0.37)
    out = align_scene(scene)
    assert angle(up_of(out), up) < 1
    assert set(out.up_report) == {"used", "cameras", "ground", "lines"}
    assert out.scale == pytest.approx(1 / 0.37, rel=0.03)
    assert out.scale_source == "camera-height-assumed" and out.scale_error == 0.3
    assert any("scale is assumed" in w for w in out.warnings)
    positions = np.array([out.c2w_world(v)[:3, 3] for v in out.views])
    np.testing.assert_allclose(positions.mean(axis=0)[:2], 0, atol=1e-9)
    assert np.median(positions[:, 2]) == pytest.approx(1.6, abs=0.05)
    assert out.ground_z == 0 and -0.2 < out.lowest_ground_z <= 0


def test_camera_height_sets_the_scale(tmp_path):
    points, posts = street()
    scene, _ = street_scene(tmp_path, ring(9), points, posts, scale=2.5)
    out = align_scene(scene, camera_height=3.2)
    assert out.scale == pytest.approx(2 / 2.5, rel=0.03)
    assert out.scale_source == "camera-height" and out.scale_error < 0.2
    assert not any("assumed" in w for w in out.warnings)


def test_metric_input_is_kept_exactly(tmp_path):
    points, posts = street()
    points = points + (0, 0, 42.0)
    posts = posts + (0, 0, 42.0)
    poses = [p.copy() for p in ring(9)]
    for p in poses:
        p[2, 3] += 42
    views = street_scene(tmp_path, poses, None, posts)[0].views
    views = tuple(replace(v, c2w=p) for v, p in zip(views, poses, strict=True))
    out = align_scene(Scene(tmp_path, "test", (STREET_CAMERA,), views, points), metric_input=True)
    np.testing.assert_array_equal(out.world_from_input, np.eye(4))
    assert out.ground_z == pytest.approx(42, abs=0.05)
    assert out.scale_source == "metric-input" and out.scale_error == 0
    assert max(v for k, v in out.up_report.items() if k != "used") < 4


def test_distant_map_coordinates_are_shifted_by_whole_kilometres(tmp_path):
    points, posts = street()
    offset = np.array([500_250.0, 4_999_800.0, 12.0])
    poses = [p.copy() for p in ring(9)]
    for p in poses:
        p[:3, 3] += offset
    views = street_scene(tmp_path, ring(9), None, posts)[0].views
    views = tuple(replace(v, c2w=p) for v, p in zip(views, poses, strict=True))
    out = align_scene(
        Scene(tmp_path, "test", (STREET_CAMERA,), views, points + offset), metric_input=True
    )
    centre = np.mean([out.c2w_world(v)[:3, 3] for v in out.views], axis=0)
    assert np.abs(centre[:2]).max() < 1001 and centre[2] > 10
    np.testing.assert_array_equal(out.world_from_input[:3, :3], np.eye(3))
    assert (out.world_from_input[:2, 3] % 1000 == 0).all()
    assert any("far from their origin" in str(each) for each in out.findings)


def test_metric_input_with_another_up_gives_a_warning(tmp_path):
    points, posts = street()
    scene, _ = street_scene(tmp_path, ring(9), points, posts, seed=2)
    out = align_scene(scene, metric_input=True)
    assert any("the input's z axis disagree" in w for w in out.warnings)


def test_ground_lies_below_all_cameras_without_points(tmp_path):
    poses = [*ring(6), look_at((4, 0, 0.4), (0, 0, 1.2)), look_at((0, 4, 3), (0, 0, 1.2))]
    scene, _ = street_scene(tmp_path, poses, None, [])
    out = align_scene(scene)
    heights = [out.c2w_world(v)[2, 3] for v in out.views]
    assert min(heights) > 0 and np.median(heights) == pytest.approx(1.6)
    assert out.scale_error == 0.5 and any("No ground" in w for w in out.warnings)


def test_portrait_photos_stored_in_landscape(tmp_path):
    points, posts = street()
    # Rotated by 90 degrees: the left side of the stored image is the displayed top (EXIF 6).
    poses = [tilted(p, 90, 0) for p in ring(12)]
    tags = Image.Exif()
    tags[0x0112] = 6
    scene, up = street_scene(tmp_path, poses, points, posts, exif=tags)
    c2w = scene.views[0].c2w[:3, :3]
    assert angle(-c2w[:, 0], up) < 20  # the test scene is as described
    assert angle(up_of(align_scene(scene)), up) < 1
