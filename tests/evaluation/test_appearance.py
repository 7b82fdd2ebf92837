"""Whose exposure a camera would have had."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.random_field import random_field

from climatenerf.evaluation.appearance import nearby_appearance


def pose(angle: float, x: float = 0.0) -> np.ndarray:
    """Turned about z by an angle in rad, standing at x m."""
    c2w = np.eye(4)
    c2w[:3, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    c2w[0, 3] = x
    return c2w


def test_where_a_photo_was_taken_its_own_appearance_counts():
    field = random_field()
    photos = np.stack([pose(0.4 * i, 0.3 * i) for i in range(5)])
    for i in range(5):
        found = nearby_appearance(field, photos, photos[i])
        assert torch.allclose(found, field.embeddings[[i]], atol=1e-4)


def test_between_two_photos_alike_is_their_mean_and_others_are_far():
    field = random_field()
    photos = np.stack([pose(a) for a in (0.0, 0.2, 2.2, 2.5, 2.8)])
    found = nearby_appearance(field, photos, pose(0.1))
    assert torch.allclose(found, field.embeddings[:2].mean(0, keepdim=True), atol=1e-3)


def test_a_way_of_one_unit_counts_as_one_radian():
    field = random_field(images=2)
    photos = np.stack([pose(0.7), pose(0.0, 0.7 * field.unit)])
    found = nearby_appearance(field, photos, pose(0.0))
    assert torch.allclose(found, field.mean_embedding, atol=1e-5)
    # By 1/q^4: twice as far, a sixteenth.
    photos = np.stack([pose(0.35), pose(0.0, 0.7 * field.unit)])
    share = torch.tensor([16.0, 1.0]) / 17
    found = nearby_appearance(field, photos, pose(0.0))
    assert torch.allclose(found, (share @ field.embeddings)[None], atol=3e-3)


@pytest.mark.parametrize("seed", range(3))
def test_it_does_not_depend_on_the_frame_or_the_order(seed):
    field, random = random_field(), np.random.default_rng(seed)
    photos = np.tile(np.eye(4), (5, 1, 1))
    photos[:, :3, :3] = Rotation.from_rotvec(random.normal(size=(5, 3))).as_matrix()
    photos[:, :3, 3] = random.normal(size=(5, 3))
    asked, moved = pose(0.3), np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(random.normal(size=3)).as_matrix()
    moved[:3, 3] = random.normal(size=3)
    found = nearby_appearance(field, photos, asked)
    assert torch.allclose(nearby_appearance(field, moved @ photos, moved @ asked), found, atol=1e-5)
    field.embeddings.copy_(field.embeddings.flip(0))
    assert torch.allclose(nearby_appearance(field, photos[::-1], asked), found, atol=1e-5)
