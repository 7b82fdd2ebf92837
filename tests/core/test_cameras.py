import numpy as np
import pytest

from climatenerf.scene import Camera

PINHOLE = Camera(64, 48, 50.0, 52.0, 32.0, 24.0)
CASES = {
    "pinhole": PINHOLE,
    "radial": Camera(640, 480, 500.0, 505.0, 318.0, 242.0, k1=-0.3, k2=0.12, k3=-0.02),
    "barrel and tangential": Camera(
        270, 480, 343.9, 343.6, 138.6, 241.3, k1=0.058, k2=-0.081, p1=-9.8e-4, p2=1.6e-4
    ),
    "fisheye": Camera(
        800, 800, 300.0, 300.0, 401.0, 399.0, k1=0.03, k2=-0.01, k3=2e-3, k4=-2e-4, fisheye=True
    ),
}


@pytest.mark.parametrize("camera", CASES.values(), ids=CASES.keys())
def test_directions_invert_project(camera):
    rays = camera.directions()
    assert rays.dtype == np.float32 and rays.shape == (camera.height, camera.width, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-6)
    error = camera.project(rays * 7.5) - camera.pixel_centres()
    assert np.abs(error).max() < 1e-3


def test_first_pixel_centre_is_at_half():
    rays = PINHOLE.directions()
    x, y, z = rays[0, 0]
    assert x / z == pytest.approx((0.5 - 32) / 50, abs=1e-6)
    assert y / z == pytest.approx((0.5 - 24) / 52, abs=1e-6)
    np.testing.assert_allclose(PINHOLE.directions(np.array([32.0, 24.0])), [0, 0, 1])


def test_radial_tangential_known_value():
    # By hand from OpenCV's formula at x = 0.5, y = -0.25: r2 = 0.3125.
    camera = Camera(100, 100, 1.0, 1.0, 0.0, 0.0, k1=0.1, k2=0.02, k3=0.3, p1=0.01, p2=-0.02)
    radial = 1 + 0.1 * 0.3125 + 0.02 * 0.3125**2 + 0.3 * 0.3125**3
    x = 0.5 * radial + 2 * 0.01 * 0.5 * -0.25 - 0.02 * (0.3125 + 2 * 0.25)
    y = -0.25 * radial + 0.01 * (0.3125 + 2 * 0.0625) + 2 * -0.02 * 0.5 * -0.25
    np.testing.assert_allclose(camera.project(np.array([1.0, -0.5, 2.0])), [x, y], rtol=1e-12)


def test_fisheye_known_value_beyond_90_degrees():
    camera = Camera(100, 100, 10.0, 10.0, 50.0, 50.0, k1=0.01, fisheye=True)
    theta = np.radians(100)
    pixel = camera.project(np.array([np.sin(theta), 0.0, np.cos(theta)]))
    np.testing.assert_allclose(pixel, [50 + 10 * theta * (1 + 0.01 * theta**2), 50], rtol=1e-12)
    back = camera.directions(pixel)
    np.testing.assert_allclose(back, [np.sin(theta), 0, np.cos(theta)], atol=1e-6)
    np.testing.assert_allclose(camera.directions(np.array([50.0, 50.0])), [0, 0, 1])


def test_behind_a_perspective_camera_is_nan():
    assert np.isnan(PINHOLE.project(np.array([0.1, 0.1, -1.0]))).all()


def test_resized_keeps_directions():
    camera = CASES["barrel and tangential"]
    small = camera.resized(90, 160)
    pixels = np.array([[10.0, 20.0], [200.0, 400.0]])
    np.testing.assert_allclose(
        small.directions(pixels * (90 / 270, 160 / 480)), camera.directions(pixels), atol=1e-6
    )


def test_uninvertible_distortion_stays_finite():
    rays = Camera(64, 48, 20.0, 20.0, 32.0, 24.0, k1=-1.5).directions()
    assert np.isfinite(rays).all()
