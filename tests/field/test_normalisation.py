import numpy as np
import pytest

from climatenerf.field.normalisation import find_extent, focus_point


def pose_towards(eye, target):
    forward = np.asarray(target, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=-1)
    return c2w


def ring(radius=4.0, middle=(3.0, -1.0, 1.0), count=20):
    turn = np.arange(count) / count * 2 * np.pi
    eyes = np.stack([np.cos(turn), np.sin(turn), 0.3 + 0 * turn], -1) * radius + middle
    return np.stack([pose_towards(eye, middle) for eye in eyes])


def cloud(middle=(3.0, -1.0, 1.0), size=1.0, count=3000):
    return np.random.default_rng(0).normal(middle, size, (count, 3))


def drive(count=30):
    """Cameras 2 m apart on a line, all facing along it."""
    return np.stack([pose_towards(np.array([0, 2.0 * i, 1.6]), [0, 2.0 * i + 1, 1.6])
                     for i in range(count)])  # fmt: skip


def test_the_extent_of_a_ring_is_centred_on_its_object():
    extent = find_extent(ring(), cloud())
    assert np.linalg.norm(np.array(extent.centre) - (3, -1, 1)) < 1.0
    eyes = ring()[:, :3, 3]
    away = np.linalg.norm(eyes - extent.centre, axis=1) / extent.unit
    assert away.max() < 1.4 and extent.unit < 6
    nearest = np.linalg.norm(cloud()[:, None] - eyes[None], axis=-1).min()
    assert 0 < extent.near < max(nearest, 0.01 * extent.unit)


def test_the_extent_of_a_drive_contains_all_cameras():
    points = np.random.default_rng(1).uniform([-8, 0, 0], [8, 70, 5], (4000, 3))
    extent = find_extent(drive(), points)
    away = np.linalg.norm(drive()[:, :3, 3] - extent.centre, axis=1) / extent.unit
    assert away.max() < 1.4


@pytest.mark.parametrize("points", [True, False])
def test_the_extent_is_equivariant_to_translation_and_scale(points):
    poses, matter = ring(), cloud() if points else None
    a = find_extent(poses, matter)
    scaled = poses.copy()
    scaled[:, :3, 3] = poses[:, :3, 3] * 7 + (100, 5, -3)
    b = find_extent(scaled, None if matter is None else matter * 7 + (100, 5, -3))
    assert np.allclose(np.array(a.centre) * 7 + (100, 5, -3), b.centre, rtol=1e-6)
    assert np.isclose(b.unit, 7 * a.unit) and np.isclose(b.near, 7 * a.near)


def test_distant_points_do_not_enlarge_the_extent():
    background = np.random.default_rng(2).normal(0, 400, (600, 3))
    with_sky = find_extent(ring(), np.concatenate([cloud(), background]))
    assert with_sky.unit < 2 * find_extent(ring(), cloud()).unit


def test_without_points_the_centre_is_the_common_point_of_interest():
    extent = find_extent(ring(), None)
    assert np.allclose(extent.centre, (3, -1, 1), atol=0.3)
    assert extent.near == pytest.approx(0.1 * extent.unit)
    assert find_extent(ring(), cloud(count=20)) == extent, "too few points are ignored"


def test_the_focus_of_parallel_axes_lies_ahead_of_the_cameras():
    poses = drive()
    point = focus_point(poses)
    assert np.isfinite(point).all()
    assert point[1] > poses[:, 1, 3].mean()
    outward = ring()
    outward[:, :3, 2] *= -1  # a panorama: no common point of interest
    assert np.isfinite(focus_point(outward)).all()


def test_cameras_at_one_position_give_a_finite_extent():
    extent = find_extent(np.repeat(ring()[:1], 5, axis=0), None)
    assert np.isfinite([*extent.centre, extent.unit, extent.near]).all()
    assert extent.unit > 0 and extent.near > 0
