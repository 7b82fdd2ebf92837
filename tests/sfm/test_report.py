"""Coverage of ground and sky, and the text and plot of the report."""

import numpy as np
import pytest
from PIL import Image

from climatenerf.scene import Camera, Scene, View
from climatenerf.sfm.diagnose import Unposed
from climatenerf.sfm.exif import Exif
from climatenerf.sfm.photo_import import PhotoImport, Picture
from climatenerf.sfm.reconstruct import Model
from climatenerf.sfm.report import ground_coverage, sky_coverage, write_report


def look(direction, eye=(0.0, 0.0, 1.6)):
    forward = np.array(direction, float) / np.linalg.norm(direction)
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[2]) > 0.99 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, np.array(eye)], axis=-1)
    return pose


def scene_of(poses, tmp_path, focal=50.0):
    camera = Camera(100, 100, focal, focal, 50.0, 50.0)
    views = tuple(View(f"{i}.jpg", tmp_path / f"{i}.jpg", 0, p) for i, p in enumerate(poses))
    points = np.random.default_rng(0).normal(0, 3, (200, 3))
    return Scene(tmp_path, "test", (camera,), views, points, up_report={"used": "lines"})


def test_sky_coverage_is_a_solid_angle(tmp_path):
    # Straight up with half angle 45 degrees: 1 - cos of a square cone; bounds of its circles.
    seen = sky_coverage(scene_of([look((0, 0, 1))], tmp_path))
    total = 1 - np.sin(np.radians(10))
    inner, outer = 1 - np.cos(np.radians(45)), 1 - np.cos(np.arctan(np.sqrt(2)))
    assert inner / total < seen < outer / total
    # The square cone of half angle a: solid angle 4 asin(sin(a)^2), here of the cap's 2 pi total.
    assert seen == pytest.approx(4 * np.arcsin(0.5) / (2 * np.pi * total), abs=0.01)
    assert sky_coverage(scene_of([look((0, 0, -1))], tmp_path)) == 0


def test_ground_coverage_needs_three_views(tmp_path):
    down = [look((0, 0.01, -1), (x, 0, 1.6)) for x in (0, 0.1, 0.2)]
    # Each shows a square of 3.2 m; coverage is measured on a disc of radius 8 m.
    assert ground_coverage(scene_of(down, tmp_path)) == pytest.approx(
        3.2 * 3.0 / (np.pi * 8**2), rel=0.25
    )
    assert ground_coverage(scene_of(down[:2], tmp_path)) == 0
    assert ground_coverage(scene_of([look((0, 0.1, 1))] * 4, tmp_path)) == 0


def test_report_names_remedies(tmp_path):
    scene = scene_of([look((0, 1, -0.1), (x, 0, 1.6)) for x in range(5)], tmp_path)
    pictures = tuple(Picture(f"{i}.jpg", f"{i}.jpg", 100, 100, Exif(), 1.0, 0.5) for i in range(6))
    imported = PhotoImport(tmp_path, pictures, {"bad.png": "bad.png is empty"}, False)
    model = Model({}, tuple(v.name for v in scene.views), (5, 3), 0.71, 200)
    reason = "blurred (9% of the usual detail)"
    unposed = [Unposed("5.jpg", "5.jpg", reason, "take it again", (("4.jpg", 12),))]
    text, picture = write_report(tmp_path, scene, imported, model, unposed)
    report = text.read_text()
    assert "5 of 6" in report and "0.71 px" in report and "5, 3" in report
    row = "| 5.jpg | blurred (9% of the usual detail) | take it again | 4.jpg (12) |"
    assert row in report
    assert "bad.png is empty" in report
    pixels = np.asarray(Image.open(picture)).reshape(-1, 3)
    assert (pixels == (200, 40, 30)).all(-1).sum() > 50, "cameras are drawn"
