"""The rotation of each pixel's sample set."""

import math

import pytest
import torch

from climatenerf.render.volume import pixel_rotation


def test_neighbouring_pixels_get_different_rotations():
    grid = torch.stack(torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij"), -1)
    rotation = pixel_rotation(grid.reshape(-1, 2)).reshape(64, 64)
    assert ((rotation >= 0) & (rotation < math.pi / 2)).all()
    assert (rotation[1:] - rotation[:-1]).abs().min() > 0.05
    assert rotation.mean().item() == pytest.approx(math.pi / 4, rel=0.02)
