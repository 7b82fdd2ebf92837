"""Directions interpolated on the lattice, against the camera's."""

import numpy as np
import pytest
import torch

from climatenerf.core.cameras import Camera
from climatenerf.training.pixel_directions import Directions

PLAIN = Camera(50, 37, 40.0, 44.0, 20.0, 19.0)
BENT = Camera(81, 61, 70.0, 70.0, 41.0, 30.0, k1=-0.15, k2=0.03, p1=0.002)
FISH = Camera(64, 64, 20.0, 20.0, 32.0, 32.0, k1=0.02, fisheye=True)


def all_of(found, index, camera):
    row, column = np.mgrid[: camera.height, : camera.width]
    which = torch.full((row.size,), index)
    return found.of(which, torch.from_numpy(column.ravel()), torch.from_numpy(row.ravel()))


FOLD = Camera(80, 60, 50.0, 50.0, 40.0, 30.0, k1=-0.232)


@pytest.mark.parametrize(
    ("index", "camera", "pixels"),
    [(0, PLAIN, 1e-4), (1, BENT, 0.02), (2, FISH, 0.1), (3, FOLD, 1e-4)],
)
def test_interpolated_directions_match_the_camera(index, camera, pixels):
    """The error is below a number of pixels, with other cameras in the same lattice."""
    found = all_of(Directions([PLAIN, BENT, FISH, FOLD]), index, camera).numpy()
    real = camera.directions().reshape(-1, 3)
    assert np.allclose(np.linalg.norm(found, axis=-1), 1, atol=1e-6)
    assert np.linalg.norm(found - real, axis=-1).max() < pixels / camera.fx


def test_the_lattice_is_smaller_than_the_photo():
    camera = Camera(1000, 750, 800.0, 800.0, 500.0, 375.0)
    assert Directions([camera]).lattice.nbytes < 1000 * 750
