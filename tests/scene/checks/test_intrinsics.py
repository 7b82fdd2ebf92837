from dataclasses import replace

import pytest

from climatenerf.core.cameras import Camera
from climatenerf.scene.checks.intrinsics import camera_findings, corrected_camera, exif_findings

CAMERA = Camera(800, 450, 600.0, 602.0, 400.0, 225.0)


def codes(findings):
    return [each.code for each in findings]


def close(a: Camera, b: Camera):
    return all(
        getattr(a, name) == pytest.approx(getattr(b, name), rel=1e-6)
        for name in ("fx", "fy", "cx", "cy")
    )


def test_usual_cameras_are_unchanged():
    for camera in (
        CAMERA,
        replace(CAMERA, cx=310.0, cy=260.0),  # a shifted lens
        replace(CAMERA, fx=5000.0, fy=5000.0),  # a telephoto lens
        Camera(32, 24, 8.0, 8.0, 16.0, 12.0),  # a tiny photo
        Camera(640, 480, 180.0, 180.0, 320.0, 240.0, fisheye=True),
    ):
        assert corrected_camera(camera) == (camera, [])
        assert camera_findings(camera) == []


@pytest.mark.parametrize("by_width", [True, False])
@pytest.mark.parametrize("centre", [True, False])
def test_fractions_of_the_size_become_pixels(by_width, centre):
    side = CAMERA.width if by_width else CAMERA.height
    given = replace(CAMERA, fx=CAMERA.fx / CAMERA.width, fy=CAMERA.fy / side)
    if centre:
        given = replace(given, cx=0.5, cy=CAMERA.cy / side)
    camera, findings = corrected_camera(given)
    assert codes(findings) == ["intrinsics-fractions"] and close(camera, CAMERA)


@pytest.mark.parametrize("ratio", [2.0, 4.0, 3.3])
def test_intrinsics_of_larger_photos_are_scaled(ratio):
    given = CAMERA.resized(round(800 * ratio), round(450 * ratio))
    camera, findings = corrected_camera(replace(given, width=800, height=450))
    assert codes(findings) == ["intrinsics-resolution"] and close(camera, CAMERA)


def test_a_whole_ratio_is_taken_if_the_principal_point_is_off_centre():
    given = replace(CAMERA.resized(3200, 1800), width=800, height=450, cx=1650.0, cy=880.0)
    camera, _ = corrected_camera(given)
    assert camera.fx == pytest.approx(CAMERA.fx)


def test_a_negative_focal_length_becomes_positive():
    camera, findings = corrected_camera(replace(CAMERA, fy=-602.0))
    assert codes(findings) == ["focal-negative"] and camera == CAMERA


def test_unusual_fields_of_view_pixels_and_principal_points_are_found():
    assert codes(camera_findings(replace(CAMERA, fx=50.0, fy=50.0))) == ["focal-unusual"]
    assert codes(camera_findings(replace(CAMERA, fy=900.0))) == ["focal-unusual"]
    assert codes(camera_findings(replace(CAMERA, cx=20.0))) == ["principal-point"]


def test_exif_is_compared_along_the_diagonal():
    # 28 mm on the 43.27 mm diagonal of 36 x 24 mm: 594 pixels on a diagonal of 918.
    assert exif_findings(CAMERA, 28.0) == []
    assert codes(exif_findings(CAMERA, 50.0)) == ["focal-exif"]
