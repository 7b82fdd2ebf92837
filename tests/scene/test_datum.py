"""The ground datum follows the terrain of a fit where the two disagree."""

from pathlib import Path

import numpy as np
import pytest

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import ROAD
from climatenerf.scene import Scene
from climatenerf.scene.datum import with_datum
from climatenerf.scene.scene import View
from climatenerf.scene.terrain import Terrain


def walk(ground_z=0.0, shift=0.0):
    """A capture with five cameras along +x at y = 0."""
    views = []
    for i in range(5):
        pose = np.eye(4)
        pose[:3, 3] = (i + shift, 0.0, 1.6)
        views.append(View(f"{i}.jpg", Path(f"{i}.jpg"), 0, pose))
    camera = Camera(8, 6, 8.0, 8.0, 4.0, 3.0)
    return Scene(Path(), "test", (camera,), tuple(views), ground_z=ground_z, lowest_ground_z=-0.1)


def slope(height=0.0, error=0.02, rise=0.1, seen=5):
    """Terrain that rises along +x: `height` below the middle camera."""
    x = np.arange(-2.0, 7.0)
    z = np.broadcast_to((height + rise * (x - 2.0)).astype(np.float32), (5, len(x))).copy()
    flags = np.ones(z.shape, bool)
    label = np.full(z.shape, ROAD, np.uint8)
    spread = np.full(z.shape, error, np.float32)
    flags[:, 2 + seen :] = False  # below the first cameras alone
    return Terrain((-2.0, -2.0), 1.0, z, spread, label, flags, np.zeros_like(flags))


@pytest.mark.parametrize("height", [0.3, -0.3])
def test_the_datum_moves_to_the_median_height_below_the_cameras(height):
    moved = with_datum(walk(), slope(height))
    assert moved.ground_z == pytest.approx(height)
    assert moved.lowest_ground_z == pytest.approx(min(-0.1, height))


@pytest.mark.parametrize(
    ("height", "error"),
    [(0.13, 0.02), (-0.13, 0.02), (0.25, 0.09), (1.0, 0.11)],
    ids=["agrees", "agrees below", "within two errors", "badly known"],
)
def test_the_datum_stays_where_the_terrain_agrees_or_is_badly_known(height, error):
    assert with_datum(walk(), slope(height, error)).ground_z == 0.0


def test_only_cameras_above_ground_that_the_field_holds_count():
    assert with_datum(walk(), slope(0.3, seen=3)).ground_z == pytest.approx(0.3 - 0.1)
    assert with_datum(walk(), slope(0.3, seen=2)).ground_z == 0.0, "two of five are too few"
    assert with_datum(walk(shift=50.0), slope(0.3)).ground_z == 0.0
    assert with_datum(walk(ground_z=0.7), None).ground_z == 0.7
