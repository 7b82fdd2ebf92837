import numpy as np
import pytest
from support.scene_builders import angle, ring, street

from climatenerf.scene.alignment.ground_plane import find_ground, ground_plane


def test_ground_of_a_street_beside_a_channel():
    # Cameras above a street at 0, beside a channel 3 m deep and a hedge.
    random = np.random.default_rng(2)
    x, y = random.uniform(-10, 10, 6000), random.uniform(-3, 12, 6000)
    z = np.where(y > 4, -3.0, 0.0) + random.normal(0, 0.03, 6000)
    hedge = np.c_[
        random.uniform(-10, 10, 3000), random.uniform(-3, -2, 3000), random.uniform(0, 3, 3000)
    ]
    cameras = np.c_[np.linspace(-8, 8, 20), np.zeros(20), np.full(20, 1.7)]
    ground = find_ground(np.concatenate([np.c_[x, y, z], hedge]), cameras)
    assert ground is not None
    assert ground.under_path == pytest.approx(0, abs=0.1)
    assert ground.camera_height == pytest.approx(1.7, abs=0.1)
    assert ground.lowest == pytest.approx(-3, abs=0.1)


def test_ground_plane_of_a_slope_and_of_noise():
    random = np.random.default_rng(3)
    xy = random.uniform(-8, 8, (4000, 2))
    slope = np.tan(np.radians(6))
    points = np.c_[xy, xy[:, 0] * slope + random.normal(0, 0.02, 4000)]
    cameras = np.c_[np.linspace(-3, 3, 9), np.zeros(9), np.linspace(-3, 3, 9) * slope + 1.6]
    ground = find_ground(points, cameras)
    assert ground is not None and (plane := ground_plane(ground)) is not None
    assert angle(plane[0], np.array([-slope, 0, 1])) < 0.5 and plane[1] > 0.9
    noise = find_ground(random.uniform(-8, 0, (4000, 3)) * (1, 1, 1), cameras)
    assert noise is None or ground_plane(noise) is None


def test_ground_ignores_points_at_infinity():
    points, _ = street()
    far = np.array([[1e200, 0, -1e200], [3e15, 1e15, -1e15]])
    cameras = np.array([p[:3, 3] for p in ring(9)])
    ground = find_ground(np.concatenate([points, far]), cameras)
    assert ground is not None and ground.camera_height == pytest.approx(1.6, abs=0.06)


def test_no_ground_without_points_below():
    cameras = np.zeros((5, 3))
    assert find_ground(np.random.default_rng(0).uniform(1, 2, (100, 3)), cameras) is None
    assert find_ground(np.zeros((0, 3)), cameras) is None
