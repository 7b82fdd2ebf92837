"""Photos, poses and points of captures that do not record which photos show a point."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.scene_builders import look_at
from support.textured_scene import CAMERA, textured_scene

from climatenerf.core.cameras import Camera
from climatenerf.scene.checks.appearance import appearance_findings
from climatenerf.scene.checks.check import corrected
from climatenerf.scene.checks.matching import matching_findings, suspects
from climatenerf.scene.checks.visibility import visible, with_visible_points
from climatenerf.scene.scene import View


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Photos with unequal steps: a shift of equal ones on a round would only turn the world."""
    found = textured_scene(tmp_path_factory.mktemp("yard"), 60, seen=False)
    steps = np.random.default_rng(0).integers(1, 4, 40).cumsum()
    return replace(found, views=tuple(found.views[i] for i in steps[steps < 60]))


@pytest.fixture(scope="module")
def even(tmp_path_factory):
    return textured_scene(tmp_path_factory.mktemp("round"), 30, seen=False)


def with_photos(scene, order):
    """The scene with the file of photo `order[i]` under the name of photo i."""
    paths = [view.path for view in scene.views]
    views = [replace(view, path=paths[o]) for view, o in zip(scene.views, order, strict=True)]
    return replace(scene, views=tuple(views))


def codes(found):
    return [each.code for each in found.findings]


def test_a_right_capture_is_not_odd(scene):
    assert codes(corrected(scene)) == []


@pytest.mark.parametrize("shift", [1, 2, 7, 15])
def test_shifted_names_are_found(scene, shift):
    found = corrected(with_photos(scene, np.roll(np.arange(len(scene.views)), shift)))
    assert set(codes(found)) & {"photo-exchanged", "matches-disagree"}


def test_an_exchanged_photo_is_named(scene):
    order = np.arange(len(scene.views))
    order[[0, 16]] = 16, 0
    (finding,) = corrected(with_photos(scene, order)).findings
    assert finding.code == "photo-exchanged" and scene.views[0].name in finding.message


def test_a_turned_pose_is_named(even):
    views = list(even.views)
    turn = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
    views[11] = replace(views[11], c2w=views[11].c2w @ turn)
    assert suspects(views) == [11]
    (finding,) = corrected(replace(even, views=tuple(views))).findings
    assert finding.code == "pose-disagrees" and f"({views[11].name})" in finding.message


def test_a_camera_that_stands_elsewhere_is_named(even):
    views = list(even.views)
    pose = views[11].c2w.copy()
    pose[:3, 3] += (30.0, -20.0, 4.0)
    views[11] = replace(views[11], c2w=pose)
    (finding,) = corrected(replace(even, views=tuple(views))).findings
    assert finding.code == "pose-disagrees" and f"({views[11].name})" in finding.message


def test_two_cameras_with_names_in_turn_are_no_suspects():
    eyes = [(0.1 * i, 2.0 * (i % 2), 1.6) for i in range(20)]
    poses = [look_at(eye, (eye[0], 9.0 - 18 * (i % 2), 1.0)) for i, eye in enumerate(eyes)]
    views = [View(f"{i:02}.png", Path(f"{i:02}.png"), 0, pose) for i, pose in enumerate(poses)]
    assert suspects(views) == []


def test_points_in_another_scale_are_told_from_wrong_poses(scene):
    (finding,) = corrected(replace(scene, points=0.1 * scene.points)).findings
    assert finding.code == "points-disagree" and "matches" in finding.message


@pytest.mark.parametrize("factor", [0.75, 1.3])
def test_a_wrong_focal_length_is_found(scene, factor):
    camera = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    assert codes(corrected(replace(scene, cameras=(camera,)))) == ["focal-disagrees"]


def test_distortion_that_the_photos_lack_is_found(scene):
    photos = range(0, len(scene.views), 2)
    curved = replace(scene, cameras=(replace(CAMERA, k1=0.5),))
    (finding,) = appearance_findings(with_visible_points(curved, photos), photos) or []
    assert finding.code == "distortion-disagrees"


def test_shifted_names_without_points_are_found(scene):
    bare = replace(scene, points=None)
    assert codes(corrected(bare)) == []
    assert codes(corrected(with_photos(bare, np.roll(np.arange(len(scene.views)), 7)))) == [
        "matches-disagree"
    ]


def test_at_most_24_photos_are_read(scene):
    views = list(scene.views)
    for i in (5, 12, 20):
        views[i] = replace(views[i], c2w=views[i].c2w @ np.diag([-1.0, 1, -1, 1]))
    assert len(matching_findings(replace(scene, views=tuple(views))).photos) <= 24
    assert len(matching_findings(scene).photos) <= 24


def test_points_behind_nearer_ones_are_hidden():
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21)), -1).reshape(-1, 2)
    wall = np.concatenate([grid, np.full((len(grid), 1), 4.0)], axis=1)
    behind = np.array([[0.0, 0.0, 8.0], [0.0, 0.0, -4.0], [4.0, 0.0, 8.0], [np.inf, 0, 1]])
    rows = visible(camera, np.eye(4), np.concatenate([wall, behind]))
    assert set(rows) == {*range(len(wall)), len(wall) + 2}, "the last is beside the wall"


def test_rows_refer_to_all_points(scene):
    many = np.repeat(scene.points, 10, axis=0)  # more than are projected
    found = with_visible_points(replace(scene, points=many), [3])
    seen = found.views[3].seen
    assert seen is not None and seen.max() > len(scene.points) and found.views[4].seen is None
