"""Appearance of a camera, interpolated from nearby photos."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.random_field import random_field

from climatenerf.evaluation.appearance import nearby_appearance


def pose(angle: float, x: float = 0.0) -> np.ndarray:
    """Pose at (x, 0, 0) m, rotated about z by an angle in rad."""
    c2w = np.eye(4)
    c2w[:3, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    c2w[0, 3] = x
    return c2w


def test_the_pose_of_a_photo_has_its_appearance():
    field = random_field()
    photos = np.stack([pose(0.4 * i, 0.3 * i) for i in range(5)])
    for i in range(5):
        found = nearby_appearance(field, photos, photos[i])
        assert torch.allclose(found, field.embeddings[[i]], atol=1e-4)


def test_the_middle_of_two_photos_has_their_mean_appearance():
    field = random_field()
    photos = np.stack([pose(a) for a in (0.0, 0.2, 2.2, 2.5, 2.8)])
    found = nearby_appearance(field, photos, pose(0.1))
    assert torch.allclose(found, field.embeddings[:2].mean(0, keepdim=True), atol=1e-3)


def test_a_distance_of_one_unit_equals_one_radian():
    field = random_field(images=2)
    photos = np.stack([pose(0.7), pose(0.0, 0.7 * field.unit)])
    found = nearby_appearance(field, photos, pose(0.0))
    assert torch.allclose(found, field.mean_embedding, atol=1e-5)
    # The weight is 1/q^4: twice the distance, a sixteenth of the weight.
    photos = np.stack([pose(0.35), pose(0.0, 0.7 * field.unit)])
    weight = torch.tensor([16.0, 1.0]) / 17
    found = nearby_appearance(field, photos, pose(0.0))
    assert torch.allclose(found, (weight @ field.embeddings)[None], atol=3e-3)


@pytest.mark.parametrize("seed", range(3))
def test_appearance_does_not_depend_on_the_frame_or_the_order(seed):
    field, random = random_field(), np.random.default_rng(seed)
    photos = np.tile(np.eye(4), (5, 1, 1))
    photos[:, :3, :3] = Rotation.from_rotvec(random.normal(size=(5, 3))).as_matrix()
    photos[:, :3, 3] = random.normal(size=(5, 3))
    camera, frame = pose(0.3), np.eye(4)
    frame[:3, :3] = Rotation.from_rotvec(random.normal(size=3)).as_matrix()
    frame[:3, 3] = random.normal(size=3)
    found = nearby_appearance(field, photos, camera)
    moved = nearby_appearance(field, frame @ photos, frame @ camera)
    assert torch.allclose(moved, found, atol=1e-5)
    field.embeddings.copy_(field.embeddings.flip(0))
    assert torch.allclose(nearby_appearance(field, photos[::-1], camera), found, atol=1e-5)
