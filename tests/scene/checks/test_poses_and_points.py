from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import OPENGL
from support.textured_scene import CAMERA, textured_scene

from climatenerf.scene.checks.check import corrected
from climatenerf.scene.checks.conventions import inverse
from climatenerf.scene.checks.matching import agreeing_fraction
from climatenerf.scene.checks.points import inside_fractions


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return textured_scene(tmp_path_factory.mktemp("yard"), 24)


def codes(scene):
    return [each.code for each in scene.findings]


def unrecorded(scene):
    return replace(scene, views=tuple(replace(view, seen=None) for view in scene.views))


def with_poses(scene, change):
    return replace(scene, views=tuple(replace(v, c2w=change(v.c2w)) for v in scene.views))


def same_poses(a, b):
    return all(np.allclose(x.c2w, y.c2w) for x, y in zip(a.views, b.views, strict=True))


@pytest.mark.parametrize("recorded", [True, False, "no points"])
def test_a_consistent_capture_has_no_finding(scene, recorded):
    given = scene if recorded is True else unrecorded(scene)
    if recorded == "no points":
        given = replace(given, points=None)
    found = corrected(given)
    assert codes(found) == [] and same_poses(found, given)


@pytest.mark.parametrize("recorded", [True, False, "no points"])
@pytest.mark.parametrize("change", ["axes", "inverse", "both"])
def test_poses_of_other_conventions_are_converted(scene, recorded, change):
    change = {
        "axes": lambda pose: pose @ OPENGL,
        "inverse": np.linalg.inv,
        "both": lambda pose: np.linalg.inv(pose @ OPENGL),
    }[change]
    given = scene if recorded is True else unrecorded(scene)
    if recorded == "no points":
        given = replace(given, points=None)
    found = corrected(with_poses(given, change))
    assert codes(found) == ["pose-axes"] and same_poses(found, given)


@pytest.mark.parametrize("ratio", [0.25, 0.5])
def test_intrinsics_of_smaller_photos_are_scaled_if_points_agree(scene, ratio):
    width, height = round(CAMERA.width * ratio), round(CAMERA.height * ratio)
    small = replace(CAMERA.resized(width, height), width=CAMERA.width, height=CAMERA.height)
    found = corrected(replace(scene, cameras=(small,)))
    assert codes(found) == ["intrinsics-resolution"]
    assert found.cameras[0].fx == pytest.approx(CAMERA.fx)


def test_a_crop_keeps_its_principal_point(scene):
    """The upper left quarter of the photos, with the points that are seen there."""
    crop = replace(CAMERA, width=640, height=480)
    found = corrected(replace(scene, cameras=(crop,)))
    assert found.cameras == (crop,) or codes(found) == ["intrinsics-resolution"]


def test_points_without_the_applied_transform_are_moved(scene):
    turn = np.eye(4)
    turn[:3, :3] = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
    turn[:3, 3] = 40.0
    moved = (scene.points - turn[:3, 3]) @ turn[:3, :3]
    found = corrected(replace(unrecorded(scene), points=moved), (turn,))
    assert codes(found) == ["points-frame"] and np.allclose(found.points, scene.points)


def test_points_of_another_place_are_reported(scene):
    found = corrected(replace(unrecorded(scene), points=scene.points + 1000.0))
    assert codes(found) == ["points-outside"]
    assert "0.0%" in str(found.findings[0])


def test_a_camera_far_away_is_left_out(scene):
    views = list(scene.views)
    pose = views[3].c2w.copy()
    pose[:3, 3] += 90_000.0
    views[3] = replace(views[3], c2w=pose)
    found = corrected(replace(scene, views=tuple(views)))
    assert codes(found) == ["pose-outlier"] and len(found.views) == len(scene.views) - 1
    assert "003.png" in str(found.findings[0])


@pytest.mark.parametrize(("count", "far"), [(8, 1), (5, 1), (12, 2), (12, 3), (24, 2)])
def test_far_cameras_of_small_captures_are_reported(scene, count, far):
    """One is left out of any capture, and of more at most a tenth."""
    views = list(scene.views[:: len(scene.views) // count][:count])
    for i in range(far):
        pose = views[3 + i].c2w.copy()
        pose[:3, 3] += 90_000.0 + 30_000.0 * i
        views[3 + i] = replace(views[3 + i], c2w=pose)
    found = corrected(replace(scene, views=tuple(views), points=None))
    assert "pose-outlier" in codes(found)
    left_out = far <= max(1, 0.1 * count)
    assert len(found.views) == count - far * left_out


@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("points", [True, False])
def test_a_focal_length_that_contradicts_the_photos_is_found(scene, factor, points):
    camera = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    given = unrecorded(replace(scene, cameras=(camera,)))
    found = corrected(given if points else replace(given, points=None))
    assert codes(found) == ["focal-disagrees"]
    assert "about 260 pixels" in str(found.findings[0])


def test_matches_that_meet_behind_the_cameras_do_not_agree():
    """Parallel cameras side by side: inverted poses keep the epipolar lines."""
    random = np.random.default_rng(0)
    points = random.uniform((-2, -2, 4), (2, 2, 8), (50, 3))
    first, second = np.eye(4), np.eye(4)
    second[0, 3] = 0.5
    rays = [points - pose[:3, 3] for pose in (first, second)]
    found = (*(each / np.linalg.norm(each, axis=1, keepdims=True) for each in rays), 1 / 300)
    assert agreeing_fraction(first, second, found) == 1
    assert agreeing_fraction(inverse(first), inverse(second), found) == 0


def test_photos_without_matches_are_noted(scene, tmp_path):
    views = []
    for view in unrecorded(scene).views:
        Image.new("RGB", (320, 240), (90, 90, 90)).save(tmp_path / view.name)
        views.append(replace(view, path=tmp_path / view.name))
    found = corrected(replace(scene, views=tuple(views), points=None))
    assert codes(found) == ["matches-few"] and found.findings[0].severity == "note"


def test_a_distant_camera_that_its_points_support_stays(scene):
    """A drone over the yard, 200 m up, whose points fall into its photo."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 400.0
    rows = np.flatnonzero(np.abs(scene.points[:, :2]).max(axis=1) < 11)
    far = replace(scene.views[0], name="drone.png", c2w=pose, seen=rows)
    found = corrected(replace(scene, views=(*scene.views, far)))
    assert "pose-outlier" not in codes(found) and len(found.views) == len(scene.views) + 1


def test_one_wrong_pose_among_right_ones_is_named(scene):
    views = list(scene.views)
    views[5] = replace(views[5], c2w=views[5].c2w @ OPENGL)
    found = corrected(replace(scene, views=tuple(views)))
    assert codes(found) == ["pose-disagrees"] and "005.png" in str(found.findings[0])


def test_equal_poses_are_reported(scene):
    views = list(scene.views)
    views[1] = replace(views[1], c2w=views[0].c2w, seen=views[0].seen)
    found = corrected(replace(scene, views=tuple(views)))
    assert codes(found) == ["pose-duplicate"]


def test_cameras_at_one_position_are_reported(scene):
    def at_origin(pose):
        out = pose.copy()
        out[:3, 3] = (0.0, 0.0, 1.6)
        return out

    found = corrected(with_poses(unrecorded(replace(scene, points=None)), at_origin))
    assert "pose-no-baseline" in codes(found)


def test_shares_count_points_in_front_and_inside(scene):
    fractions = inside_fractions(scene.cameras, scene.views, scene.points)
    assert fractions.recorded and (fractions.by_view == 1).all() and not fractions.doubtful
    turned = with_poses(scene, lambda pose: pose @ OPENGL)
    assert inside_fractions(turned.cameras, turned.views, turned.points).median == 0
