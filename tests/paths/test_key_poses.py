"""Camera paths through key poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from climatenerf.paths.key_poses import through


def key(angle, position):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", angle, degrees=True).as_matrix()
    pose[:3, 3] = position
    return pose


def test_a_path_passes_through_its_key_poses():
    keys = [key(0, (0, 0, 1)), key(30, (2, 1, 1.5)), key(80, (3, 4, 1)), key(60, (1, 5, 2))]
    poses, fovs = through(keys, [40, 50, 60, 50], between=10)
    assert poses.shape == (31, 4, 4)
    np.testing.assert_allclose(poses[::10], np.stack(keys), atol=1e-12)
    np.testing.assert_allclose(fovs[::10], [40, 50, 60, 50])
    np.testing.assert_allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1),
                               np.tile(np.eye(3), (31, 1, 1)), atol=1e-12)  # fmt: skip
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert np.abs(np.diff(steps)).max() < 0.2 * steps.mean(), "no jerks"


def test_rotations_turn_evenly_and_two_poses_make_a_line():
    poses, _ = through([key(0, (0, 0, 0)), key(90, (3, 0, 0))], [50, 50], between=9)
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("zyx", degrees=True)[:, 0]
    np.testing.assert_allclose(angles, np.linspace(0, 90, 10), atol=1e-9)
    np.testing.assert_allclose(poses[:, 0, 3], np.linspace(0, 3, 10), atol=1e-12)


def test_one_pose_is_a_path_of_one_frame():
    poses, fovs = through([key(10, (1, 2, 3))], [45])
    assert poses.shape == (1, 4, 4) and fovs == pytest.approx([45.0])
