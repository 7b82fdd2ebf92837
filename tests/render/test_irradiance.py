"""Irradiance is estimated from the sky and from the ground that photos show."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, HalfSpace

from climatenerf.core.cameras import Camera
from climatenerf.core.colour import luma
from climatenerf.render.irradiance import GROUND_ALBEDO, scene_irradiance
from climatenerf.scene.scene import Scene, View

CAMERA = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)


def pitched(pitch: float) -> np.ndarray:
    """Pose 1.6 m above the ground that faces y, pitched up by `pitch` rad."""
    forward = np.array([0.0, math.cos(pitch), math.sin(pitch)])
    right = np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, [0.0, 0.0, 1.6]], -1)
    return pose


def irradiance(tmp_path, ground: float, pitch: float = -0.3) -> np.ndarray:
    field = AnalyticField([HalfSpace((0.0, 0.0, 1.0), 0.0, (ground,) * 3)])
    views = tuple(View(f"{i}.png", tmp_path / f"{i}.png", 0, pitched(pitch)) for i in range(3))
    return scene_irradiance(
        replace(field, near=0.1), Scene(tmp_path, "test", (CAMERA,), views)
    ).numpy()


def test_dark_ground_does_not_affect_irradiance(tmp_path):
    sky = AnalyticField([]).sky(torch.tensor([[0.0, 0.0, 1.0]]))[0].numpy()
    found = irradiance(tmp_path, ground=0.01 * GROUND_ALBEDO)
    assert found.mean() < 2 * math.pi * sky.max()
    assert irradiance(tmp_path, ground=0.02 * GROUND_ALBEDO) == pytest.approx(found, rel=1e-3)


def test_bright_ground_raises_irradiance_above_the_clipped_sky(tmp_path):
    dark = irradiance(tmp_path, ground=0.01 * GROUND_ALBEDO)
    bright = irradiance(tmp_path, ground=10.0)
    assert (bright > 1.2 * dark).all()
    assert luma(torch.from_numpy(bright)).item() == pytest.approx(math.pi), "clamped to white"


def test_ground_outside_all_photos_is_ignored(tmp_path):
    """Cameras pitched up: the colour of the ground below them has no effect."""
    bright = irradiance(tmp_path, ground=10.0, pitch=0.8)
    dark = irradiance(tmp_path, ground=0.01, pitch=0.8)
    assert bright == pytest.approx(dark, rel=1e-3)
