"""Pictures warped by their depth, against the same scene from the other pose in closed form."""

import numpy as np
from support.study_yard import pose

from climatenerf.core.cameras import Camera
from climatenerf.viewer.warp import warped

CAMERA = Camera(160, 90, 120.0, 120.0, 80.0, 45.0)
HERE = pose((0.0, 1.0, -0.2))


def seen(camera, c2w):
    """Colours of level ground with a smooth pattern, and of a sky by direction; ray lengths."""
    d = camera.directions().astype(float) @ c2w[:3, :3].T
    t = np.where(d[..., 2] < -1e-3, -c2w[2, 3] / np.minimum(d[..., 2], -1e-3), np.inf)
    x = c2w[:3, 3] + np.where(np.isfinite(t), t, 0.0)[..., None] * d
    ground = 127 + 60 * np.sin(1.3 * x[..., :1] + np.array([0, 1, 2])) * np.cos(0.9 * x[..., 1:2])
    sky = 127 + 100 * d
    return np.where(np.isfinite(t)[..., None], ground, sky).astype(np.uint8), t


def test_the_same_pose_gives_the_same_picture():
    picture, depth = seen(CAMERA, HERE)
    assert np.array_equal(warped(picture, depth, CAMERA, HERE, CAMERA, HERE), picture)


def test_a_step_and_a_turn_give_what_is_seen_from_there():
    picture, depth = seen(CAMERA, HERE)
    there = pose((0.04, 1.0, -0.22), (0.3, 0.4, 1.5))
    found = warped(picture, depth, CAMERA, HERE, CAMERA, there)
    true, t = seen(CAMERA, there)
    inner = np.zeros(t.shape, bool)
    inner[8:-8, 12:-12] = True  # the borders were not seen before
    error = np.abs(found.astype(int) - true).mean(-1)
    unmoved = np.abs(picture.astype(int) - true).mean(-1)
    for low, high in ((2.0, 4.0), (7.0, 15.0)):
        ground = inner & (t > low) & (t < high)
        assert ground.sum() > 200
        assert np.median(error[ground]) < 3 and np.median(unmoved[ground]) > 5
    assert np.median(error[inner & np.isinf(t)]) < 2, "the sky turns and does not move"


def test_a_smaller_picture_fills_a_larger_one():
    small = CAMERA.resized(40, 23)
    picture, depth = seen(small, HERE)
    found = warped(picture, depth, small, HERE, CAMERA, HERE)
    true, t = seen(CAMERA, HERE)
    assert found.shape == true.shape
    assert np.median(np.abs(found.astype(int) - true)[t < 8]) < 8


def test_poses_behind_and_far_away_are_finite():
    picture, depth = seen(CAMERA, HERE)
    for there in (pose((0.0, -1.0, 0.0)), pose((0.0, 1.0, 0.0), (0.0, 500.0, 2.0))):
        assert warped(picture, depth, CAMERA, HERE, CAMERA, there).shape == picture.shape
